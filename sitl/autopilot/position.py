"""Position, velocity and vertical acceleration loops, after AC_PosControl (Copter 4.7 defaults)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2
from sitl.autopilot.shaping import Gains, Pid, clip, filter_share, limit_length, square_root_controller

_LEAN_MAX_RAD = math.radians(30.0)
_ACCELERATION_XY = 2.5  # shaped path, WPNAV_ACCEL
_ACCELERATION_Z = 1.0
_CORRECTION_XY = 2.5
_CORRECTION_Z = 2.5
_JERK = 5.0
_VELOCITY = [Gains(p=2.0, i=1.0, d=0.25, integral_limit=10.0, error_hz=5.0, derivative_hz=5.0)] * 2
_VELOCITY_Z = [Gains(p=5.0, i=0.0, d=0.0, integral_limit=10.0, error_hz=5.0, derivative_hz=5.0)]
_ACCELERATION_LOOP_Z = [Gains(p=0.05, i=0.1, d=0.0, integral_limit=0.8, error_hz=20.0)]
_THROTTLE_HZ = 2.0  # motors' throttle filter under position control
_HOVER_TIME_S = 10.0


class PositionControl:
    """Desired attitude (N, 4) and throttle (N,) from a goal in NED; the path to it is shaped by acceleration."""

    def __init__(self, vehicles: int, dt_s: float, hover_throttle: NDArray[np.float64]) -> None:
        self._dt = dt_s
        self.goal = np.zeros((vehicles, 3))
        self.goal_velocity = np.full((vehicles, 3), np.nan)  # finite: fly this velocity instead
        self.goal_yaw = np.zeros(vehicles)
        self.goal_yaw_rate = np.zeros(vehicles)
        self.speed_xy = np.full(vehicles, 5.0)
        self.speed_z = np.full(vehicles, 1.5)
        self.path = np.zeros((vehicles, 3))
        self.path_velocity = np.zeros((vehicles, 3))
        self.path_acceleration = np.zeros((vehicles, 3))
        self.hover_throttle = hover_throttle.copy()
        self._velocity = Pid(_VELOCITY, vehicles, dt_s)
        self._velocity_z = Pid(_VELOCITY_Z, vehicles, dt_s)
        self._acceleration_z = Pid(_ACCELERATION_LOOP_Z, vehicles, dt_s)
        self._throttle = hover_throttle.copy()
        self._throttle_share = filter_share(_THROTTLE_HZ, dt_s)
        self._limited_xy = np.zeros((vehicles, 2), bool)

    def reset(
        self, mask: NDArray[np.bool_], position: NDArray[np.float64], velocity: NDArray[np.float64], throttle: float
    ) -> None:
        """Take the present position as path and goal for vehicles in ``mask`` (N,)."""
        if not mask.any():
            return
        self.goal[mask] = self.path[mask] = position[mask]
        self.path_velocity[mask] = velocity[mask]
        self.path_acceleration[mask] = 0.0
        for loop in (self._velocity, self._velocity_z, self._acceleration_z):
            loop.reset(mask)
        self._throttle[mask] = throttle
        self._acceleration_z.integral[mask] = throttle - self.hover_throttle[mask, None]

    def _shape_path(self) -> None:
        """Move the path towards the goal within speed, acceleration and jerk."""
        wanted = np.empty_like(self.path)
        error = self.goal - self.path
        distance = np.hypot(error[:, 0], error[:, 1])
        speed = np.minimum(square_root_controller(distance, 1.0, _ACCELERATION_XY, self._dt), self.speed_xy)
        wanted[:, :2] = error[:, :2] * (speed / np.maximum(distance, 1e-6))[:, None]
        wanted[:, 2] = clip(
            square_root_controller(error[:, 2], 1.0, _ACCELERATION_Z, self._dt), -self.speed_z, self.speed_z
        )
        wanted = np.where(np.isfinite(self.goal_velocity), self.goal_velocity, wanted)
        asked = 4.0 * (wanted - self.path_velocity)
        asked[:, :2] = limit_length(asked[:, :2], _ACCELERATION_XY)
        asked[:, 2] = clip(asked[:, 2], -_ACCELERATION_Z, _ACCELERATION_Z)
        step = 4.0 * _JERK * self._dt
        self.path_acceleration = self.path_acceleration + clip(asked - self.path_acceleration, -step, step)
        self.path_velocity = self.path_velocity + self._dt * self.path_acceleration
        self.path = self.path + self._dt * self.path_velocity

    def step(
        self,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        acceleration_up: NDArray[np.float64],
        quaternion: NDArray[np.float64],
        throttle_limited: NDArray[np.bool_],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One cycle. ``acceleration_up`` (N,) without gravity; ``throttle_limited`` (N,) from the mixer."""
        self._shape_path()
        error = self.path - position
        target = np.empty_like(error)
        distance = np.hypot(error[:, 0], error[:, 1])
        speed = square_root_controller(distance, 1.0, _CORRECTION_XY, self._dt)
        target[:, :2] = error[:, :2] * (speed / np.maximum(distance, 1e-6))[:, None]
        target[:, 2] = square_root_controller(error[:, 2], 1.0, _CORRECTION_Z, self._dt)
        target += self.path_velocity

        acceleration = self._velocity.step(target[:, :2], velocity[:, :2], self._limited_xy)
        acceleration = acceleration + self.path_acceleration[:, :2]
        limited = limit_length(acceleration, GRAVITY_M_S2 * math.tan(_LEAN_MAX_RAD))
        self._limited_xy[:] = (limited != acceleration).any(axis=1)[:, None]

        none = np.zeros((len(distance), 1), bool)
        up_target = -self._velocity_z.step(target[:, 2:], velocity[:, 2:], none)
        up_target = up_target - self.path_acceleration[:, 2:]
        throttle = (
            self._acceleration_z.step(up_target, acceleration_up[:, None], throttle_limited[:, None])[:, 0]
            + self.hover_throttle
        )

        self.goal_yaw = self.goal_yaw + self._dt * self.goal_yaw_rate
        desired = _attitude_for(limited, self.goal_yaw)
        cosine_target = 1 - 2 * (desired[:, 1] ** 2 + desired[:, 2] ** 2)
        cosine = 1 - 2 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
        boosted = throttle * clip(10.0 * cosine, 0.0, 1.0) / clip(cosine_target, 0.1, 1.0)
        self._throttle = self._throttle + self._throttle_share * (boosted - self._throttle)
        steady = (np.abs(velocity[:, 2]) < 0.6) & (cosine > 0.98) & (np.abs(self.path_velocity[:, 2]) < 0.05)
        learn = np.where(steady, self._dt / _HOVER_TIME_S, 0.0)
        moved = learn * (clip(self._throttle, 0.1, 0.9) - self.hover_throttle)
        self.hover_throttle = self.hover_throttle + moved
        self._acceleration_z.integral -= moved[:, None]
        return desired, self._throttle


def _attitude_for(acceleration: NDArray[np.float64], yaw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Attitude (N, 4) whose thrust gives the horizontal ``acceleration`` (N, 2) m/s^2 NED, heading ``yaw``."""
    up = np.empty((len(yaw), 3))
    up[:, :2], up[:, 2] = acceleration, -GRAVITY_M_S2
    up /= np.sqrt(np.vecdot(up, up))[:, None]
    # Rotation that takes the world's up (0, 0, -1) to ``up``.
    axis = np.zeros_like(up)
    axis[:, 0], axis[:, 1] = up[:, 1], -up[:, 0]
    sine = np.hypot(up[:, 0], up[:, 1])
    angle = np.arctan2(sine, -up[:, 2])
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 0.0)
    return rotation.multiply(rotation.from_rotation_vector(axis * scale[:, None]), rotation.from_yaw(yaw))
