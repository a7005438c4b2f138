"""Attitude and rate loops, after AC_AttitudeControl and AC_AttitudeControl_Multi (Copter 4.7 defaults)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.autopilot.shaping import PID, Gains, clip, pid, reset, square_root_controller
from sitl.compiled import flat, part
from sitl.rotation import Quaternion, Vector

_ANGLE_P = 4.5
_INPUT_TIME_S = 0.15  # ATC_INPUT_TC
_ACCELERATION_MAX = (math.radians(1100.0), math.radians(1100.0), math.radians(270.0))  # ATC_ACCEL_R_MAX, P, Y
_CORRECTION_MAX = (math.radians(550.0), math.radians(550.0), math.radians(120.0))  # half, within the firmware's bounds
_YAW_ERROR_MAX = math.radians(45.0)
_THRUST_ERROR = math.radians(30.0)  # beyond it heading gives way
_YAW_SLEW_MAX = math.radians(60.0)
_TILT_RATE = Gains(p=0.135, i=0.135, d=0.0036, integral_limit=0.5, target_hz=20.0, error_hz=0.0, derivative_hz=20.0)
_YAW_RATE = Gains(p=0.3, i=0.02, d=0.0, integral_limit=0.5, target_hz=20.0, error_hz=2.5, derivative_hz=20.0)


class AttitudeArrays(NamedTuple):
    """Arrays of ``AttitudeControl``."""

    target: NDArray[np.float64]
    target_rate: NDArray[np.float64]
    rates: NDArray[np.void]  # (N, 3) of PID


@part
def reset_attitude(n: int, attitude: AttitudeArrays, measured: Quaternion) -> None:
    """Start from the present heading, level, at rest."""
    rotation.put_quaternion(attitude.target, n, rotation.level(rotation.yaw(measured)))
    rotation.put(attitude.target_rate, n, (0.0, 0.0, 0.0))
    for axis in range(3):
        reset(attitude.rates[n, axis])


@part
def _shape_target(n: int, attitude: AttitudeArrays, desired: Quaternion, dt_s: float) -> None:
    """Turn the target towards ``desired`` within rate and angular acceleration."""
    target = rotation.quaternion(attitude.target, n)
    wanted = rotation.swing_and_twist(rotation.multiply(rotation.conjugate(target), desired))
    for axis in range(3):
        most = _ACCELERATION_MAX[axis]
        rate = square_root_controller(wanted[axis], 1.0 / _INPUT_TIME_S, most, dt_s)
        if axis == 2:
            rate = clip(rate, -_YAW_SLEW_MAX, _YAW_SLEW_MAX)
        attitude.target_rate[n, axis] += clip(rate - attitude.target_rate[n, axis], -most * dt_s, most * dt_s)
    rate_now = rotation.vector(attitude.target_rate, n)
    rotation.put_quaternion(attitude.target, n, rotation.turned(target, rotation.scaled(dt_s, rate_now)))


@part
def attitude_step(
    n: int,
    attitude: AttitudeArrays,
    desired: Quaternion,
    measured: Quaternion,
    gyro: Vector,
    limited: NDArray[np.bool_],
    dt_s: float,
) -> Vector:
    """Target attitude with input shaping, quaternion error, rate demand, rate PID: normalised torque in -1..1.

    ``limited`` (3,) from the mixer.
    """
    _shape_target(n, attitude, desired, dt_s)
    target = rotation.quaternion(attitude.target, n)
    relative = rotation.multiply(rotation.conjugate(measured), target)
    roll, pitch, yaw = rotation.swing_and_twist(relative)
    # The target's heading is dragged along with a vehicle that cannot hold its own.
    excess = clip(yaw, -_YAW_ERROR_MAX, _YAW_ERROR_MAX) - yaw
    if excess != 0.0:
        dragged = rotation.multiply(target, rotation.from_rotation_vector((0.0, 0.0, excess)))
        rotation.put_quaternion(attitude.target, n, dragged)
        yaw += excess
    forward = rotation.to_ned(rotation.matrix(relative), rotation.vector(attitude.target_rate, n))
    share = clip(2.0 - math.sqrt(roll * roll + pitch * pitch) / _THRUST_ERROR, 0.0, 1.0)
    asked_roll = square_root_controller(roll, _ANGLE_P, _CORRECTION_MAX[0], dt_s) + share * forward[0]
    asked_pitch = square_root_controller(pitch, _ANGLE_P, _CORRECTION_MAX[1], dt_s) + share * forward[1]
    asked_yaw = square_root_controller(yaw, _ANGLE_P, _CORRECTION_MAX[2], dt_s) + forward[2]
    asked_yaw = (1 - share) * gyro[2] + share * asked_yaw
    return (
        clip(pid(_TILT_RATE, attitude.rates[n, 0], asked_roll, gyro[0], limited[0], dt_s), -1.0, 1.0),
        clip(pid(_TILT_RATE, attitude.rates[n, 1], asked_pitch, gyro[1], limited[1], dt_s), -1.0, 1.0),
        clip(pid(_YAW_RATE, attitude.rates[n, 2], asked_yaw, gyro[2], limited[2], dt_s), -1.0, 1.0),
    )


class AttitudeControl:
    """``target`` (N, 4) and its rate (N, 3) rad/s: new arrays in each cycle."""

    def __init__(self, vehicles: int) -> None:
        self.target = np.tile([1.0, 0.0, 0.0, 0.0], (vehicles, 1))
        self.target_rate = np.zeros((vehicles, 3))
        self._rates = np.zeros((vehicles, 3), PID)

    def renewed(self) -> AttitudeArrays:
        """Its arrays after those that others see were replaced by copies, to be written."""
        self.target, self.target_rate = flat(self.target).copy(), flat(self.target_rate).copy()
        return AttitudeArrays(self.target, self.target_rate, self._rates)
