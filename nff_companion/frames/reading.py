"""What somebody's parameters say of a vehicle, and what nobody has said."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.airframe_file import CommandTable, TelemetryTable
from nff_companion.core.tuning.span import fields
from nff_companion.frames.catalogue import Autopilot, Frame
from nff_companion.frames.parameter_file import Parameters

GUESSED = "guessed"
_FIELDS = {field.path[-1]: field for table in (CommandTable, TelemetryTable) for field in fields(table)}
_HOVER = (0.06, 0.9)  # thrust fraction: what an airframe file admits, less what its rounding needs


@dataclass(frozen=True, slots=True)
class Known:
    """A number and who says so: a parameter's name, an option, ``GUESSED``, or a firmware's default."""

    value: float
    origin: str

    @property
    def guessed(self) -> bool:
        """Nobody has said it of this vehicle."""
        return self.origin.startswith(GUESSED)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """``place`` (m, 2) forward and right over the farthest motor's arm, ``spin`` (m,) +1 ccw, -1 cw."""

    autopilot: Autopilot
    title: str  # of the frame, for people
    frame: Frame | None  # None: one of the owner's own
    place: NDArray[np.float64]
    spin: NDArray[np.float64]
    thrust_expo: Known
    spin_min: Known
    spin_max: Known
    pwm_min: Known
    pwm_max: Known
    gyro_filter_hz: Known
    accelerometer_filter_hz: Known
    hover: Known | None = None  # thrust fraction
    drag_per_arm: Known | None = None  # torque over thrust over the farthest motor's arm
    notes: list[str] = field(default_factory=list)  # what the owner should know, in sentences

    @property
    def motors(self) -> int:
        """m."""
        return len(self.spin)


def known(parameters: Parameters, name: str, key: str, otherwise: Known) -> Known:
    """Parameter ``name`` as ``key`` of an airframe file, or ``otherwise``. Raises ConfigError out of its range."""
    value = parameters.get(name)
    if value is None:
        return otherwise
    if not _FIELDS[key].admits(value):
        raise parameters.error(f"{name} = {value:g} is not allowed: give {_FIELDS[key].allowed}")
    return Known(value, name)


def hover(parameters: Parameters, name: str) -> Known | None:
    """Parameter ``name`` as the thrust fraction of hover; None: not there. Raises ConfigError out of its range."""
    value = parameters.get(name)
    if value is None:
        return None
    if not _HOVER[0] <= value <= _HOVER[1]:
        raise parameters.error(f"{name} = {value:g}: no vehicle hovers so; give {_HOVER[0]} to {_HOVER[1]}")
    return Known(value, name)
