"""The control law (6.18): u = (B0 Hhat)^R (-K e + x_d' - f - a), cascaded over position, attitude and rate.

Position and velocity errors give an acceleration, that a thrust and an attitude, the attitude error a rate, the rate
error a torque. ``a`` is the slow residual that the estimator learnt (phi = I), so no other integrator is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nff_companion.vehicle import GRAVITY_M_S2, Vehicle

_TILT_MAX_RAD = math.radians(30.0)
_POSITION_ERROR_MAX_M = 4.0
_VERTICAL_MAX_M_S2 = 4.0
_INTEGRAL_PER_S = 0.35
_INTEGRAL_MAX_M_S2 = 3.0
_LINK_AND_FILTER_S = 0.03  # delays of the loop besides the motors' lag
_YAW_SHARE = 0.5  # yaw is slower than roll and pitch
_MIN_THRUST_SHARE = 0.15  # of hover: the vehicle stays controllable while it falls


@dataclass(frozen=True, slots=True)
class Reference:
    """Where to be: NED position in m, velocity in m/s, heading in rad."""

    position_m: np.ndarray
    velocity_m_s: np.ndarray
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Gains:
    """Loop gains in 1/s, from the lag that the loop has to live with."""

    position: float
    velocity: float
    attitude: float
    rate: float

    @staticmethod
    def of(vehicle: Vehicle) -> Gains:
        """Rate loop with about 60 degrees of phase left; each outer loop slower than the one inside."""
        rate = 0.6 / (vehicle.motor.time_constant_up_s + _LINK_AND_FILTER_S)
        attitude = rate / 2.5
        velocity = attitude / 2.5
        return Gains(velocity / 2.5, velocity, attitude, rate)


@dataclass(frozen=True, slots=True)
class State:
    """What the law is told: NED position and velocity, body-to-NED quaternion, body rates."""

    position_m: np.ndarray
    velocity_m_s: np.ndarray
    quaternion: np.ndarray
    rate_rad_s: np.ndarray


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """(3, 3) body to NED of the quaternion (w, x, y, z)."""
    w, x, y, z = (float(v) for v in q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class ControlLaw:
    """Constants of one airframe; ``step`` takes and returns the integral of the position loop."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self.gains = Gains.of(vehicle)
        self._inertia = vehicle.inertia_kg_m2
        self._scale = 1.0 / vehicle.row_scale

    def demand(
        self, state: State, reference: Reference, integral: np.ndarray, disturbance: np.ndarray, dt_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Demand (n,) in normalised units, and the new integral (3,) m/s^2 NED.

        ``disturbance`` (n,): slow residual, upward specific force m/s^2 and angular accelerations rad/s^2.
        """
        g = self.gains
        matrix = rotation_matrix(state.quaternion)
        error = reference.position_m - state.position_m
        size = math.sqrt(float(error @ error))
        if size > _POSITION_ERROR_MAX_M:
            error = error * (_POSITION_ERROR_MAX_M / size)
        wanted = g.velocity * (g.position * error + reference.velocity_m_s - state.velocity_m_s) + integral
        if size < _POSITION_ERROR_MAX_M:
            integral = integral + dt_s * _INTEGRAL_PER_S * g.velocity * g.position * error
            integral = np.minimum(np.maximum(integral, -_INTEGRAL_MAX_M_S2), _INTEGRAL_MAX_M_S2)
        wanted[2] = min(max(float(wanted[2]), -_VERTICAL_MAX_M_S2), _VERTICAL_MAX_M_S2)
        lateral = math.hypot(wanted[0], wanted[1])
        lateral_max = (GRAVITY_M_S2 - wanted[2]) * math.tan(_TILT_MAX_RAD)
        if lateral > lateral_max:
            wanted[:2] *= lateral_max / lateral
        push = np.array([wanted[0], wanted[1], wanted[2] - GRAVITY_M_S2])  # specific force wanted, NED
        length = math.sqrt(float(push @ push))
        up = matrix[:, 2] * -1.0
        specific = max(float(push @ up), _MIN_THRUST_SHARE * GRAVITY_M_S2) - float(disturbance[0])

        down = -push / length
        heading = np.array([math.cos(reference.yaw_rad), math.sin(reference.yaw_rad), 0.0])
        right = _cross(down, heading)
        right /= math.sqrt(float(right @ right))
        desired = np.column_stack([_cross(right, down), right, down])
        relative = matrix.T @ desired
        skew = 0.5 * (relative - relative.T)
        axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        sine = math.sqrt(float(axis @ axis))
        angle = math.atan2(sine, 0.5 * (float(np.trace(relative)) - 1.0))
        if sine > 1e-9:
            axis *= angle / sine
        rate = g.attitude * axis
        rate[2] *= _YAW_SHARE
        limit = np.array([4.0, 4.0, 1.0])
        rate = np.minimum(np.maximum(rate, -limit), limit)
        angular = g.rate * (rate - state.rate_rad_s) - disturbance[1:4]
        angular[2] *= _YAW_SHARE
        j, w = self._inertia, state.rate_rad_s
        torque = j * angular + _cross(w, j * w)
        return np.concatenate([[self._vehicle.mass_kg * specific], torque]) * self._scale, integral


def saturate(matrix: np.ndarray, demand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motor thrusts (m,) in 0..1 for ``demand`` (n,): yaw is cut first, then thrust moves, then roll and pitch.

    Returns the thrusts and the demand that was served.
    """
    served = demand.copy()
    thrust = matrix[:, 0] * served[0]
    attitude = matrix[:, 1:3] @ served[1:3]
    yaw = matrix[:, 3] * served[3]
    base = thrust + attitude
    share = 1.0
    for value, part in ((base, yaw),):
        rising, falling = part > 1e-12, part < -1e-12
        if rising.any():
            share = min(share, float(((1.0 - value[rising]) / part[rising]).min()))
        if falling.any():
            share = min(share, float((value[falling] / -part[falling]).min()))
    served[3] *= max(share, 0.0)
    out = base + max(share, 0.0) * yaw
    span = float(attitude.max() - attitude.min())
    if out.max() > 1.0 or out.min() < 0.0:
        if span > 1.0:
            served[1:3] /= span
            attitude = attitude / span
        low, high = float((thrust + attitude).min()), float((thrust + attitude).max())
        collective = matrix[:, 0]
        lift = collective[collective > 1e-6]
        if high > 1.0 and len(lift):
            served[0] -= (high - 1.0) / float(lift.max())
        elif low < 0.0 and len(lift):
            served[0] += min(-low / float(lift.max()), 0.3 * demand[0])
        out = matrix[:, 0] * served[0] + attitude
    return np.minimum(np.maximum(out, 0.0), 1.0), served
