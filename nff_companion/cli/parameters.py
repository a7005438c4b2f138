"""The autopilot's parameters as a command is given them: a file, or a live link."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nff_companion.errors import ConfigError

if TYPE_CHECKING:
    from nff_companion.frames.parameter_file import Parameters


def given(file: Path | None, url: str, timeout_s: float) -> Parameters | None:
    """Of ``--parameters`` or ``--from``; None: of neither. Raises ConfigError, EndpointError."""
    from nff_companion.frames import parameter_file

    if url and file is not None:
        raise ConfigError(f"--from {url} and --parameters {file}: give one of them")
    if url:
        from nff_companion.daemon import live_parameters

        return parameter_file.Parameters(live_parameters.read(url, timeout_s), f"autopilot at {url}")
    return None if file is None else parameter_file.read(file)
