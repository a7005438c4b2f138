"""What the autopilot flew before the applet's mixer: read from its parameters, and kept on the card by the scripts.

With the applet's mixer FRAME_CLASS no longer says where the motors are. What it said is the one word on that which is
not the airframe file's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nff_companion.autopilots.ardupilot import checks
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError
from nff_companion.frames import ardupilot, parameter_file
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.comparison import frame_of
from nff_companion.frames.parameter_file import Parameters
from nff_companion.frames.servo_functions import SERVOS, function_of

KEPT = "nff_mixer_before.parm"
_KEPT = (
    "FLIGHT_OPTIONS",
    "MOT_PWM_MIN",
    "MOT_PWM_MAX",
    *(f"SERVO{output}_FUNCTION" for output in range(1, SERVOS + 1)),
)


@dataclass(frozen=True, slots=True)
class Before:
    """``values``: the autopilot's parameters, with the frame before the applet's mixer; ``number``: that frame as
    checks.FRAME_BEFORE; ``kept``: text of the file on the card."""

    values: Mapping[str, float]
    number: int
    kept: str

    def contradictions(self, vehicle: Vehicle) -> list[str]:
        """What would make a mixer of this airframe another one than was flown, in words."""
        missing = [
            f"{name} is missing: save all parameters, not the changed ones alone"
            for name in (f"SERVO{motor}_FUNCTION" for motor in range(1, vehicle.motors + 1))
            if name not in self.values
        ]
        return checks.contradictions(self.values, vehicle) + missing[:1]


def of_parameters(parameters: Parameters, named: Frame | None, card: Path, vehicle: Vehicle) -> Before:
    """Of an autopilot as it is now. Where the frame is the applet's already, what is kept on the ``card`` (its scripts
    directory) counts, and where nothing is, the owner's word, ``named``. Raises ConfigError where it stays open, or is
    contradicted."""
    if parameter_file.autopilot(parameters) != "ardupilot":
        raise parameters.error("its parameters are PX4's: give those of this ArduPilot")
    frame_class = parameters.whole("FRAME_CLASS")
    if frame_class is None:
        raise parameters.error("FRAME_CLASS is missing: save all parameters of the autopilot as it is now")
    for name in (*checks.names(vehicle), "RCMAP_THROTTLE"):  # what is no number would agree with everything
        parameters.get(name)
    for name in checks.further(parameters.values):
        parameters.get(name)
    path = card / KEPT
    if frame_class == checks.FRAME_CLASS_SCRIPTED and path.exists():
        kept = parameter_file.read(path)
        numbers, _ = _numbers(kept, named)
        return _made(parameters.values, numbers, path.read_text(encoding="utf-8"))
    if frame_class in ardupilot.SCRIPTED and named is None:
        raise parameters.error(
            f"FRAME_CLASS = {frame_class} is a frame made by a script, and what was flown before is not kept in {path}:"
            " name that frame with --frame NAME (`nff airframe list` names them)"
        )
    numbers, found = _numbers(parameters, named)
    scripted = frame_class in ardupilot.SCRIPTED
    said = "by the owner's word, --frame" if scripted else f"by {_one_line(parameters.origin)}"
    return _made(parameters.values, numbers, _text(parameters.values, numbers, found, said))


def of_trial(vehicle: Vehicle) -> Before:
    """Of an emulated vehicle, which is what its airframe file says: the catalogue's frame that this is, or none."""
    values: dict[str, float] = {f"SERVO{m}_FUNCTION": function_of(m) for m in range(1, vehicle.motors + 1)}
    frame = frame_of(vehicle)
    if frame is None or not frame.ardupilot:
        return Before(values, 0, f"# an emulated vehicle, {vehicle.name}: a frame of its own\n")
    numbers = _first_of(frame)
    return _made(values, numbers, _text(values, numbers, frame, f"of an emulated vehicle, {vehicle.name}"))


def _numbers(parameters: Parameters, named: Frame | None) -> tuple[tuple[int, int], Frame]:
    """FRAME_CLASS and FRAME_TYPE, and the frame. Raises ConfigError."""
    found = ardupilot.frame_of(parameters, named)
    if not found.ardupilot:
        raise ConfigError(f"--frame {found.name}: it is no frame of ArduPilot (`nff airframe list` names them)")
    frame_class, frame_type = parameters.whole("FRAME_CLASS"), parameters.whole("FRAME_TYPE")
    if frame_class is None or frame_class in ardupilot.SCRIPTED or frame_type is None:
        return _first_of(found), found
    return (frame_class, frame_type), found


def _one_line(text: str) -> str:
    """For a comment: a path may have any character in it."""
    return " ".join(text.encode("ascii", "replace").decode().split())


def _first_of(frame: Frame) -> tuple[int, int]:
    frame_class, frame_type = frame.ardupilot[0]
    return frame_class, max(frame_type, 0)


def _made(values: Mapping[str, float], numbers: tuple[int, int], kept: str) -> Before:
    frame = {"FRAME_CLASS": float(numbers[0]), "FRAME_TYPE": float(numbers[1])}
    return Before({**values, **frame}, checks.frame_number(*numbers), kept)


def _text(values: Mapping[str, float], numbers: tuple[int, int], frame: Frame, said: str) -> str:
    """A parameter file: to be read again by an installation, and loaded by who wants to fly as before."""
    keep = {"FRAME_CLASS": numbers[0], "FRAME_TYPE": numbers[1]} | {n: values[n] for n in _KEPT if n in values}
    lines = [
        f"# What flew before the applet's mixer, {said}: {checks.called(*numbers, frame)}.",
        "# Kept by `nff ardupilot install`, which compares airframe files with it. Leave it here.",
    ]
    return "\n".join([*lines, *(f"{name} {value:g}" for name, value in keep.items()), ""])
