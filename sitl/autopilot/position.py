"""Position, velocity and vertical acceleration loops, after AC_PosControl (Copter 4.7 defaults)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2
from sitl.autopilot.shaping import PID, Gains, clip, filter_share, limit_length, pid, reset, square_root_controller
from sitl.compiled import flat, part
from sitl.rotation import Quaternion, Vector, put, vector

_LEAN_MAX_RAD = math.radians(30.0)
_LEAN_MAX_M_S2 = GRAVITY_M_S2 * math.tan(_LEAN_MAX_RAD)
_ACCELERATION_XY = 2.5  # shaped path, WPNAV_ACCEL
_ACCELERATION_Z = 1.0
_CORRECTION_XY = 2.5
_CORRECTION_Z = 2.5
_JERK = 5.0
_VELOCITY_XY = Gains(p=2.0, i=1.0, d=0.25, integral_limit=10.0, target_hz=0.0, error_hz=5.0, derivative_hz=5.0)
_VELOCITY_Z = Gains(p=5.0, i=0.0, d=0.0, integral_limit=10.0, target_hz=0.0, error_hz=5.0, derivative_hz=5.0)
_ACCELERATION = Gains(p=0.05, i=0.1, d=0.0, integral_limit=0.8, target_hz=0.0, error_hz=20.0, derivative_hz=20.0)
_THROTTLE_HZ = 2.0  # motors' throttle filter under position control
_HOVER_TIME_S = 10.0
_NORTH, _EAST, _DOWN, _UP_ACCELERATION = range(4)  # loops


class PositionArrays(NamedTuple):
    """Arrays of ``PositionControl``."""

    goal: NDArray[np.float64]
    goal_velocity: NDArray[np.float64]
    goal_yaw: NDArray[np.float64]
    goal_yaw_rate: NDArray[np.float64]
    speed_xy: NDArray[np.float64]
    speed_z: NDArray[np.float64]
    path: NDArray[np.float64]
    path_velocity: NDArray[np.float64]
    path_acceleration: NDArray[np.float64]
    hover_throttle: NDArray[np.float64]
    throttle: NDArray[np.float64]
    loops: NDArray[np.void]  # (N, 4) of PID
    limited_xy: NDArray[np.bool_]  # (N,)


@part
def reset_position(n: int, position: PositionArrays, measured: Vector, throttle: float) -> None:
    """Take the present position as path and goal, at rest."""
    put(position.goal, n, measured)
    put(position.path, n, measured)
    put(position.path_velocity, n, (0.0, 0.0, 0.0))
    put(position.path_acceleration, n, (0.0, 0.0, 0.0))
    for k in range(4):
        reset(position.loops[n, k])
    position.throttle[n] = throttle
    position.loops[n, _UP_ACCELERATION].integral = throttle - position.hover_throttle[n]


@part
def _shape_path(n: int, position: PositionArrays, dt_s: float) -> None:
    """Move the path towards the goal within speed, acceleration and jerk."""
    path = vector(position.path, n)
    x, y, z = rotation.add_scaled(vector(position.goal, n), -1.0, path)
    distance = math.sqrt(x * x + y * y)
    speed = min(square_root_controller(distance, 1.0, _ACCELERATION_XY, dt_s), position.speed_xy[n])
    most_z = position.speed_z[n]
    climb = clip(square_root_controller(z, 1.0, _ACCELERATION_Z, dt_s), -most_z, most_z)
    scale = speed / max(distance, 1e-6)
    north, east, down = vector(position.goal_velocity, n)
    velocity = vector(position.path_velocity, n)
    asked_x, asked_y = limit_length(
        4.0 * ((north if math.isfinite(north) else scale * x) - velocity[0]),
        4.0 * ((east if math.isfinite(east) else scale * y) - velocity[1]),
        _ACCELERATION_XY,
    )
    asked_z = 4.0 * ((down if math.isfinite(down) else climb) - velocity[2])
    asked = (asked_x, asked_y, clip(asked_z, -_ACCELERATION_Z, _ACCELERATION_Z))
    step = 4.0 * _JERK * dt_s
    for k in range(3):
        position.path_acceleration[n, k] += clip(asked[k] - position.path_acceleration[n, k], -step, step)
        position.path_velocity[n, k] += dt_s * position.path_acceleration[n, k]
        position.path[n, k] += dt_s * position.path_velocity[n, k]


@part
def _follow_path(n: int, position: PositionArrays, place: Vector, velocity: Vector, dt_s: float) -> Vector:
    """Acceleration north and east m/s^2, within the lean, and upwards."""
    x, y, z = rotation.add_scaled(vector(position.path, n), -1.0, place)
    distance = math.sqrt(x * x + y * y)
    scale = square_root_controller(distance, 1.0, _CORRECTION_XY, dt_s) / max(distance, 1e-6)
    climb = square_root_controller(z, 1.0, _CORRECTION_Z, dt_s)
    ahead, along = vector(position.path_velocity, n), vector(position.path_acceleration, n)
    loops, limited = position.loops, position.limited_xy[n]
    north = pid(_VELOCITY_XY, loops[n, _NORTH], scale * x + ahead[0], velocity[0], limited, dt_s) + along[0]
    east = pid(_VELOCITY_XY, loops[n, _EAST], scale * y + ahead[1], velocity[1], limited, dt_s) + along[1]
    short_north, short_east = limit_length(north, east, _LEAN_MAX_M_S2)
    position.limited_xy[n] = short_north != north or short_east != east
    up = -pid(_VELOCITY_Z, loops[n, _DOWN], climb + ahead[2], velocity[2], False, dt_s) - along[2]
    return short_north, short_east, up


@part
def _attitude_for(north: float, east: float, yaw_rad: float) -> Quaternion:
    """Attitude whose thrust gives the horizontal acceleration m/s^2 NED, heading ``yaw_rad``."""
    length = math.sqrt(north * north + east * east + GRAVITY_M_S2 * GRAVITY_M_S2)
    x, y, z = north / length, east / length, -GRAVITY_M_S2 / length
    # Rotation that takes the world's up (0, 0, -1) to (x, y, z).
    sine = math.sqrt(x * x + y * y)
    scale = math.atan2(sine, -z) / sine if sine > 1e-9 else 0.0
    return rotation.multiply(rotation.from_rotation_vector((scale * y, -scale * x, 0.0)), rotation.level(yaw_rad))


@part
def _upright(q: Quaternion) -> float:
    """Cosine of the tilt."""
    return 1 - 2 * (q[1] * q[1] + q[2] * q[2])


@part
def position_step(
    n: int,
    position: PositionArrays,
    place: Vector,
    velocity: Vector,
    attitude: Quaternion,
    up: tuple[float, bool],
    dt_s: float,
) -> Quaternion:
    """One cycle: the desired attitude; the throttle is in ``position``.

    ``place``, ``velocity`` and ``attitude`` as measured; ``up``: acceleration without gravity m/s^2, and whether the
    mixer could not give the throttle asked for.
    """
    _shape_path(n, position, dt_s)
    north, east, up_target = _follow_path(n, position, place, velocity, dt_s)
    vertical = position.loops[n, _UP_ACCELERATION]
    throttle = pid(_ACCELERATION, vertical, up_target, up[0], up[1], dt_s) + position.hover_throttle[n]
    position.goal_yaw[n] += dt_s * position.goal_yaw_rate[n]
    desired = _attitude_for(north, east, position.goal_yaw[n])
    cosine = _upright(attitude)
    boosted = throttle * clip(10.0 * cosine, 0.0, 1.0) / clip(_upright(desired), 0.1, 1.0)
    position.throttle[n] += filter_share(_THROTTLE_HZ, dt_s) * (boosted - position.throttle[n])
    if abs(velocity[2]) < 0.6 and cosine > 0.98 and abs(position.path_velocity[n, 2]) < 0.05:
        moved = dt_s / _HOVER_TIME_S * (clip(position.throttle[n], 0.1, 0.9) - position.hover_throttle[n])
        position.hover_throttle[n] += moved
        position.loops[n, _UP_ACCELERATION].integral -= moved
    return desired


class PositionControl:
    """Goals in NED, which others may set or replace, and the path to them, shaped by acceleration.

    What a cycle changes, but ``goal``, is a new array in each.
    """

    def __init__(self, vehicles: int, hover_throttle: NDArray[np.float64]) -> None:
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
        self.throttle = hover_throttle.copy()
        self._loops = np.zeros((vehicles, 4), PID)
        self._limited_xy = np.zeros(vehicles, bool)

    def renewed(self) -> PositionArrays:
        """Its arrays after those that others see were replaced by copies, to be written."""
        self.goal = flat(self.goal)
        self.goal_yaw, self.path = flat(self.goal_yaw).copy(), flat(self.path).copy()
        self.path_velocity, self.path_acceleration = self.path_velocity.copy(), self.path_acceleration.copy()
        self.hover_throttle, self.throttle = self.hover_throttle.copy(), self.throttle.copy()
        return PositionArrays(
            self.goal,
            flat(self.goal_velocity),
            self.goal_yaw,
            flat(self.goal_yaw_rate),
            flat(self.speed_xy),
            flat(self.speed_z),
            self.path,
            self.path_velocity,
            self.path_acceleration,
            self.hover_throttle,
            self.throttle,
            self._loops,
            self._limited_xy,
        )
