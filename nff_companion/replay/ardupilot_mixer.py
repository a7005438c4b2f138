"""ArduPilot's mixer: from the demands of its rate loops and its throttle to the outputs of the motors.

Sources: libraries/AP_Motors of ArduPilot, AP_MotorsMatrix.cpp (normalise_rpy_factors, output_armed_stabilizing),
AP_Motors_Thrust_Linearization.cpp (thrust_to_actuator, actuator_to_thrust).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import NotJudged
from nff_companion.frames import catalogue

Array = NDArray[np.float64]
_SCRIPTED = (15, 17)
_OWN_YAW = ("quad-v", "coax-v8")  # whose motors ahead yaw by less than those behind
_LARGEST = 0.5  # factor of an axis
_BEST_THROTTLE = 0.5
# Parameters, and what they are in a firmware that has not been told.
_EXPO, _SPIN_MIN, _SPIN_MAX, _HEADROOM = 0.65, 0.15, 0.95, 200.0
_SLEW = ("MOT_SLEW_UP_TIME", "MOT_SLEW_DN_TIME")


@dataclass(frozen=True, eq=False)
class Battery:
    """What the firmware makes up for, of K samples: ``lift`` (K,) full thrust over that of a full battery, ``voltage``
    (K,) over a full battery's. Ones: nothing."""

    lift: Array
    voltage: Array


@dataclass(frozen=True, eq=False)
class Mixer:
    """``factors`` (m, 3) of roll, pitch and yaw; ``headroom`` the share of thrust that yaw always has."""

    factors: Array
    headroom: float
    expo: float
    spin_min: float
    spin_max: float

    def thrusts(self, demand: Array, average_max: Array) -> Array:
        """(K, m) thrusts 0..1 by ``demand`` (K, 4) roll, pitch, yaw, throttle, with all compensations in it, where
        the mean thrust may be raised to ``average_max`` (K,) for roll, pitch and yaw: output_armed_stabilizing, without
        a lost motor."""
        throttle, own_yaw = demand[:, 3], self.factors[:, 2]
        throttle = np.maximum(throttle, 0.0)
        average_max = np.maximum(average_max, throttle)
        turning = demand[:, :2] @ self.factors[:, :2].T
        level = np.minimum(_BEST_THROTTLE, average_max)[:, None] + turning
        room = np.where(demand[:, 2, None] * own_yaw > 0.0, 1.0 - level, level)
        yaws = own_yaw != 0.0
        allowed = (np.maximum(room[:, yaws], 0.0) / np.abs(own_yaw[yaws])).min(axis=1, initial=1.0)
        allowed = np.maximum(allowed, self.headroom)
        turning = turning + np.clip(demand[:, 2], -allowed, allowed)[:, None] * own_yaw
        low, high = turning.min(axis=1), turning.max(axis=1)
        scale = 1.0 / np.maximum(high - low, 1.0)
        short = average_max + low < 0.0
        scale[short] = np.minimum(scale[short], -average_max[short] / low[short])
        low, high = scale * low, scale * high
        spare = np.clip(throttle + low, 0.0, np.maximum(1.0 - (high - low), 0.0))
        mean = np.where(scale < 1.0, -low, spare - low)
        return np.asarray(mean[:, None] + scale[:, None] * turning)

    def outputs(self, thrusts: Array, battery: Battery) -> Array:
        """(K, m) outputs 0..1 for thrusts (K, m): thrust_to_actuator."""
        lifted = battery.lift[:, None] * np.clip(thrusts, 0.0, 1.0)
        e = self.expo
        ratio = lifted if e == 0.0 else (np.sqrt((1.0 - e) ** 2 + 4.0 * e * lifted) - (1.0 - e)) / (2.0 * e)
        return self.spin_min + (self.spin_max - self.spin_min) * np.clip(ratio / battery.voltage[:, None], 0.0, 1.0)

    def thrusts_of(self, outputs: Array, battery: Battery) -> Array:
        """(K, m) thrusts 0..1 of outputs (K, m): actuator_to_thrust."""
        ratio = (outputs - self.spin_min) / (self.spin_max - self.spin_min) * battery.voltage[:, None]
        ratio = np.maximum(ratio, 0.0)
        return np.asarray(np.clip(ratio * (1.0 - self.expo + self.expo * ratio) / battery.lift[:, None], 0.0, 1.0))


def mixer_of(values: Mapping[str, float]) -> Mixer:
    """The mixer of the frame and the motors that parameters tell of. Raises NotJudged where they tell of none."""
    frame_class, frame_type = values.get("FRAME_CLASS"), values.get("FRAME_TYPE")
    if frame_class in _SCRIPTED:
        raise NotJudged(f"FRAME_CLASS {frame_class:.0f} is a mixer of a script")
    if frame_class is None or frame_type is None:
        raise NotJudged("FRAME_CLASS and FRAME_TYPE are not in the log")
    frame = catalogue.of_ardupilot(round(frame_class), round(frame_type))
    if frame is None or frame.without or frame.name in _OWN_YAW:
        name = "" if frame is None else f" ({frame.name})"
        raise NotJudged(f"the mixer of FRAME_CLASS {frame_class:.0f}, FRAME_TYPE {frame_type:.0f}{name} is not known")
    slow = next((name for name in _SLEW if values.get(name, 0.0) > 0.0), "")
    if slow:
        raise NotJudged(f"{slow} is set: outputs follow the demands late")
    axes = np.column_stack([-frame.place[:, 1], frame.place[:, 0], frame.spin])
    return Mixer(
        factors=_LARGEST * axes / np.abs(axes).max(axis=0),
        headroom=1e-3 * values.get("MOT_YAW_HEADROOM", _HEADROOM),
        expo=float(np.clip(values.get("MOT_THST_EXPO", _EXPO), -1.0, 1.0)),
        spin_min=values.get("MOT_SPIN_MIN", _SPIN_MIN),
        spin_max=values.get("MOT_SPIN_MAX", _SPIN_MAX),
    )
