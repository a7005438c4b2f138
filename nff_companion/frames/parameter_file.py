"""Parameter files of autopilots: a table of numbers, whichever program wrote it.

Known forms, a parameter a line: ``NAME,VALUE`` (Mission Planner), ``NAME VALUE`` (MAVProxy, ArduPilot's own), and
QGroundControl's ``SYSTEM COMPONENT NAME VALUE TYPE`` between tabs, for either autopilot. ``#`` begins a comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from nff_companion.core.tuning.span import shown
from nff_companion.errors import ConfigError
from nff_companion.frames.catalogue import Autopilot

_BYTES_MAX = 4_000_000  # thirty times the largest of either firmware
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,15}")  # MAVLink carries 16 characters
_NUMBER = re.compile(r"[+-]?(\d{1,40}\.?\d{0,40}|\.\d{1,40})([eE][+-]?\d{1,4})?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
_AUTOPILOT = "1"  # component; a camera's or a gimbal's parameters may stand in the same file


class Parameters:
    """Values by name and where they come from, for messages. NaN and infinity are refused where they are used."""

    def __init__(self, values: Mapping[str, float], origin: str) -> None:
        """``origin``: what messages begin with, ``parameter file x.param``."""
        self.values, self.origin = dict(values), origin

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def get(self, name: str) -> float | None:
        """None when it is not there. Raises ConfigError when it is no finite number."""
        value = self.values.get(name)
        if value is not None and not math.isfinite(value):
            raise self.error(f"{name} = {value}: give a finite number")
        return value

    def require(self, name: str, why: str) -> float:
        """Raises ConfigError when it is not there; ``why`` it is needed, or what to do."""
        value = self.get(name)
        if value is None:
            raise self.error(f"{name} is missing: {why}")
        return value

    def whole(self, name: str) -> int | None:
        """A whole number, as of an enumeration. Raises ConfigError for another."""
        value = self.get(name)
        if value is not None and (value != round(value) or abs(value) > 2**31):
            raise self.error(f"{name} = {value:g}: give a whole number")
        return None if value is None else round(value)

    def error(self, what: str) -> ConfigError:
        """With where it comes from."""
        return ConfigError(f"{self.origin}: {what}")


def read(path: Path) -> Parameters:
    """Raises ConfigError naming file and line when it cannot be read or is no such file."""
    origin = f"parameter file {path}"
    text = _text(path, origin)
    values: dict[str, float] = {}
    lines: dict[str, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        entry = _entry(line)
        if entry is None:
            continue
        if isinstance(entry, str):
            raise ConfigError(f"{origin}, line {number}: {entry}")
        name, value = entry
        if name in values and values[name] != value:
            raise ConfigError(
                f"{origin}, line {number}: {name} = {value:g}, but line {lines[name]} says {values[name]:g}: keep one"
            )
        values[name], lines[name] = value, number
    if not values:
        raise ConfigError(f"{origin} has no parameters: save them with your ground station")
    return Parameters(values, origin)


def autopilot(parameters: Parameters) -> Autopilot:
    """Whose they are, by the names. Raises ConfigError when they are nobody's."""
    ours = {name.split("_")[0] for name in parameters.values}
    px4, ardupilot = bool({"CA", "SYS", "MPC", "COM"} & ours), bool({"FRAME", "MOT", "ATC", "INS"} & ours)
    if px4 == ardupilot:
        which = "neither ArduPilot's nor PX4's" if not px4 else "ArduPilot's and PX4's at once"
        raise parameters.error(f"its parameters are {which}: save them with your ground station")
    return "px4" if px4 else "ardupilot"


def _text(path: Path, origin: str) -> str:
    try:
        regular = path.is_file() or not path.exists()  # a pipe would be waited for, without end
        data = b""
        if regular:
            with path.open("rb") as file:
                data = file.read(_BYTES_MAX + 1)
    except OSError as error:
        raise ConfigError(f"{origin} cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a path with a NUL byte
        raise ConfigError(f"parameter file {str(path)!r} cannot be read: {error}") from error
    if not regular:
        raise ConfigError(f"{origin} cannot be read: it is no file")
    if len(data) > _BYTES_MAX:
        raise ConfigError(f"{origin} has more than {_BYTES_MAX} bytes: it is no parameter file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{origin} cannot be read: byte {error.start + 1} is not UTF-8 text") from error


def _entry(line: str) -> tuple[str, float] | str | None:
    """Name and value of a line; None where there is nothing for us; or what is wrong with it."""
    line = line.split("#", 1)[0].strip()
    if not line:
        return None
    parts = [part for part in re.split(r"[\s,]+", line) if part]
    if len(parts) == 5 and parts[0].isdigit() and parts[1].isdigit():
        if parts[1] != _AUTOPILOT:
            return None
        parts = parts[2:4]
    if len(parts) != 2 or not _NAME.fullmatch(parts[0]):
        return f"{shown(line)} is not understood: give a name and a number"
    if not _NUMBER.fullmatch(parts[1]):
        return f"{parts[0]} = {shown(parts[1])}: give a number"
    return parts[0], float(parts[1])
