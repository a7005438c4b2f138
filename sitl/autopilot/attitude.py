"""Attitude and rate loops, after AC_AttitudeControl and AC_AttitudeControl_Multi (Copter 4.7 defaults)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.autopilot.shaping import Gains, Pid, clip, square_root_controller

_ANGLE_P = 4.5
_INPUT_TIME_S = 0.15  # ATC_INPUT_TC
_ACCELERATION_MAX = np.radians([1100.0, 1100.0, 270.0])  # ATC_ACCEL_R_MAX, P, Y
_CORRECTION_MAX = np.radians([550.0, 550.0, 120.0])  # half of it, within the firmware's bounds
_YAW_ERROR_MAX = math.radians(45.0)
_THRUST_ERROR = math.radians(30.0)  # beyond it heading gives way
_YAW_SLEW_MAX = math.radians(60.0)
_RATES = [
    Gains(p=0.135, i=0.135, d=0.0036, integral_limit=0.5, target_hz=20.0, derivative_hz=20.0),
    Gains(p=0.135, i=0.135, d=0.0036, integral_limit=0.5, target_hz=20.0, derivative_hz=20.0),
    Gains(p=0.3, i=0.02, d=0.0, integral_limit=0.5, target_hz=20.0, error_hz=2.5, derivative_hz=20.0),
]


class AttitudeControl:
    """Target attitude with input shaping, quaternion error, rate demand, rate PID: normalised torque (N, 3)."""

    def __init__(self, vehicles: int, dt_s: float) -> None:
        self._dt = dt_s
        self.target = np.tile([1.0, 0.0, 0.0, 0.0], (vehicles, 1))
        self.target_rate = np.zeros((vehicles, 3))
        self.rates = Pid(_RATES, vehicles, dt_s)

    def reset(self, mask: NDArray[np.bool_], quaternion: NDArray[np.float64]) -> None:
        """Start from the present heading, level, at rest, for vehicles in ``mask`` (N,)."""
        if mask.any():
            self.target[mask] = rotation.from_yaw(rotation.yaw_of(quaternion[mask]))
            self.target_rate[mask] = 0.0
            self.rates.reset(mask)

    def step(
        self,
        desired: NDArray[np.float64],
        quaternion: NDArray[np.float64],
        gyro: NDArray[np.float64],
        limited: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """``desired`` (N, 4) attitude; ``limited`` (N, 3) from the mixer. Returns demand (N, 3) in -1..1."""
        wanted = rotation.swing_and_twist(rotation.multiply(rotation.conjugate(self.target), desired))
        rate = square_root_controller(wanted, 1.0 / _INPUT_TIME_S, _ACCELERATION_MAX, self._dt)
        rate[:, 2] = clip(rate[:, 2], -_YAW_SLEW_MAX, _YAW_SLEW_MAX)
        step = _ACCELERATION_MAX * self._dt
        self.target_rate = self.target_rate + clip(rate - self.target_rate, -step, step)
        self.target = rotation.normalise(
            rotation.multiply(self.target, rotation.from_rotation_vector(self.target_rate * self._dt))
        )

        relative = rotation.multiply(rotation.conjugate(quaternion), self.target)
        error = rotation.swing_and_twist(relative)
        # The target's heading is dragged along with a vehicle that cannot hold its own.
        excess = clip(error[:, 2], -_YAW_ERROR_MAX, _YAW_ERROR_MAX) - error[:, 2]
        if excess.any():
            twist = np.zeros_like(error)
            twist[:, 2] = excess
            self.target = rotation.multiply(self.target, rotation.from_rotation_vector(twist))
            error[:, 2] += excess
        demand = square_root_controller(error, _ANGLE_P, _CORRECTION_MAX, self._dt)
        forward = np.matvec(rotation.to_matrix(relative), self.target_rate)
        tilt_error = np.hypot(error[:, 0], error[:, 1])
        share = clip(2.0 - tilt_error / _THRUST_ERROR, 0.0, 1.0)[:, None]
        demand[:, :2] += share * forward[:, :2]
        demand[:, 2] = (1 - share[:, 0]) * gyro[:, 2] + share[:, 0] * (demand[:, 2] + forward[:, 2])
        return clip(self.rates.step(demand, gyro, limited), -1.0, 1.0)
