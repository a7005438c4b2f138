"""What all commands share: JSON alone on standard output, everything else on standard error."""

from __future__ import annotations

import json
import logging
import sys
from typing import Any

from rich.console import Console

console = Console(stderr=True)


def setup_logging(level: int = logging.INFO) -> None:
    """Plain lines on standard error."""
    logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(name)s: %(message)s")


def print_json(document: dict[str, Any]) -> None:
    """One document on standard output."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    sys.stdout.flush()
