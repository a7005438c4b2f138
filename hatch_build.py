"""Build hook: generates the MAVLink dialect module before the package is built or installed."""

import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class DialectHook(BuildHookInterface):
    """Generates ``nff_companion/mavlink/dialect/nff.py``."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Generate before anything is packed."""
        sys.path.insert(0, str(Path(self.root) / "mavlink_dialect"))
        import generate

        build_data["artifacts"].append("nff_companion/mavlink/dialect/nff.py")
        generate.generate()
