"""Frames that ArduPilot and PX4 know, by name: how motors are numbered, where they are and how they turn.

Sources: ArduPilot, libraries/AP_Motors/AP_MotorsMatrix.cpp; PX4, ROMFS/px4fmu_common/init.d/airframes. Frames with
fewer than four rotors, or with servos that steer, are no frames here: the companion's model has upright rotors alone.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning.span import shown
from nff_companion.errors import ConfigError

ANY_TYPE = -1  # FRAME_TYPE: every one that no other frame of the class has
SPINS: dict[str, int] = {"ccw": 1, "cw": -1, "-": 0}
SPIN_NAMES: dict[int, str] = {number: name for name, number in SPINS.items()}
_SAME_PLACE = 1e-3  # of the farthest motor's arm

Autopilot = Literal["ardupilot", "px4"]


class _Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of catalogue.toml."""

    motors: list[str]
    ardupilot: list[tuple[int, int]] = []
    px4: list[int] = []
    without: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Motors in their order: ``place`` (m, 2) forward and right over the farthest one's arm, ``spin`` (m,) +1 ccw,
    -1 cw, 0 a motor whose drag does not yaw."""

    name: str
    place: NDArray[np.float64]
    spin: NDArray[np.float64]
    ardupilot: tuple[tuple[int, int], ...] = ()  # FRAME_CLASS, FRAME_TYPE
    px4: tuple[int, ...] = ()  # SYS_AUTOSTART
    without: str = ""  # why the companion has no model of it

    @property
    def motors(self) -> int:
        """m."""
        return len(self.spin)

    def sites(self) -> list[list[int]]:
        """Indices of the motors at each place, coaxial ones together, in the order of their first."""
        out: list[list[int]] = []
        for motor in range(self.motors):
            here = [s for s in out if math.dist(self.place[s[0]], self.place[motor]) < _SAME_PLACE]
            if here:
                here[0].append(motor)
            else:
                out.append([motor])
        return out


def scaled(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """``place`` (m, 2), the farthest from the origin at 1. Raises ConfigError when all are at the origin."""
    arm = float(np.hypot(*place.T).max(initial=0.0))
    if arm == 0.0:
        raise ConfigError("all motors are at the centre: give their places")
    out: NDArray[np.float64] = place / arm
    return out


def _motor(text: str) -> tuple[float, float, int]:
    *numbers, spin = text.split()
    if len(numbers) == 1:
        angle = math.radians(float(numbers[0]))
        return math.cos(angle), math.sin(angle), SPINS[spin]
    forward, right = map(float, numbers)
    return forward, right, SPINS[spin]


@cache
def frames() -> dict[str, Frame]:
    """All frames by name, in the catalogue's order."""
    text = (resources.files("nff_companion") / "frames" / "catalogue.toml").read_bytes()
    out: dict[str, Frame] = {}
    for name, entry in msgspec.toml.decode(text, type=dict[str, _Entry]).items():
        rows = np.array([_motor(motor) for motor in entry.motors])
        place, spin = scaled(rows[:, :2]), rows[:, 2].copy()
        place.flags.writeable = spin.flags.writeable = False
        out[name] = Frame(name, place, spin, tuple(entry.ardupilot), tuple(entry.px4), entry.without)
    return out


def by_name(name: str) -> Frame:
    """Raises ConfigError, which names the frames that are like it, when there is none of this name."""
    known = frames()
    if name not in known:
        near = difflib.get_close_matches(name, known, n=4, cutoff=0.5)
        like = f"did you mean {' or '.join(near)}? " if near else ""
        raise ConfigError(f"frame {shown(name)} is unknown: {like}`nff airframe list` names all {len(known)}")
    return known[name]


def of_ardupilot(frame_class: int, frame_type: int) -> Frame | None:
    """The frame of FRAME_CLASS and FRAME_TYPE; None: not one of these."""
    for wanted in (frame_type, ANY_TYPE):
        for frame in frames().values():
            if (frame_class, wanted) in frame.ardupilot:
                return frame
    return None


def motors_of_ardupilot(frame_class: int) -> int | None:
    """How many motors the frames of FRAME_CLASS have; None: they are not of these."""
    return next((f.motors for f in frames().values() if any(frame_class == known for known, _ in f.ardupilot)), None)


def of_px4(autostart: int) -> Frame | None:
    """The frame of SYS_AUTOSTART; None: not one of these."""
    return next((frame for frame in frames().values() if autostart in frame.px4), None)


def alike(place: NDArray[np.float64], spin: NDArray[np.float64], tolerance: float = 0.03) -> Frame | None:
    """The frame whose motors are at ``place`` (m, 2), of any scale, and turn as ``spin`` (m,); None: no one's."""
    unit = scaled(place)
    for frame in frames().values():
        same = frame.motors == len(spin) and (frame.spin == spin).all()
        if same and np.hypot(*(frame.place - unit).T).max() < tolerance:
            return frame
    return None
