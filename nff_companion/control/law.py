"""The control law (6.18): u = (B0 Hhat)^R (-K e + x_d' - f - phi a), cascaded over position, attitude and rate.

Position and velocity errors give an acceleration, that a thrust and an attitude, the attitude error a rate, the rate
error a torque. Position and attitude have integrals; what the estimator knows of the residual is fed forward, so that
they have little to do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core.filters import lag_share
from nff_companion.core.tuning import DEFAULT, LawTuning
from nff_companion.core.vehicle import GRAVITY_M_S2, Vehicle

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]


@dataclass(frozen=True, slots=True)
class Reference:
    """Where to be: NED position in m, velocity in m/s, heading in rad."""

    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]
    yaw_rad: float
    acceleration_m_s2: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class Knowledge:
    """What is known of the residual and fed forward.

    ``residual`` (n,): phi a, upward specific force m/s^2 and angular accelerations rad/s^2; ``push_m_s2`` (2,):
    specific force along x and y of the body, as measured: the drag.
    """

    residual: NDArray[np.float64]
    push_m_s2: NDArray[np.float64]

    @staticmethod
    def none(axes: int) -> Knowledge:
        """Nothing is known."""
        return Knowledge(np.zeros(axes), np.zeros(2))


class Memory(msgspec.Struct, frozen=True, eq=False):
    """What the law remembers between samples; (3,) each.

    Integrals of the position loop, m/s^2 NED, and of the attitude loop, rad/s^2 body; the last body rates and their
    derivative; the body axes wanted last (NED) and the rate at which they turn; the tracking error s (n,) of the last
    sample, actual - reference: upward velocity in m/s, body rates in rad/s.
    """

    push_m_s2: NDArray[np.float64]
    turn_rad_s2: NDArray[np.float64]
    rate_rad_s: Vector | None = None
    acceleration_rad_s2: Vector = (0.0, 0.0, 0.0)
    desired: Axes | None = None
    turning_rad_s: Vector = (0.0, 0.0, 0.0)
    tracking_error: tuple[float, ...] = ()

    def held_back(self, before: Memory, limited: NDArray[np.bool_]) -> Memory:
        """With the attitude integrals of axes that are ``limited`` (3,) bool by saturation grown no further."""
        if not limited.any():
            return self
        grown = limited & (np.abs(self.turn_rad_s2) > np.abs(before.turn_rad_s2))
        return replace(self, turn_rad_s2=np.where(grown, before.turn_rad_s2, self.turn_rad_s2))

    @staticmethod
    def empty() -> Memory:
        """Nothing gathered."""
        return Memory(np.zeros(3), np.zeros(3))


@dataclass(frozen=True, slots=True)
class Gains:
    """Loop gains in 1/s, from the lag that the loop has to live with."""

    position: float
    velocity: float
    attitude: float
    rate: float
    lead_s: float

    @staticmethod
    def of(vehicle: Vehicle, tuning: LawTuning = DEFAULT.law) -> Gains:
        """Sensitivity of the attitude loop at most about 1.75 with the lag and 30 ms of delay; each outer loop slower
        than the one inside."""
        lag, _ = vehicle.lag_s
        rate = tuning.rate_gain / (lag + tuning.link_and_filter_s)
        attitude = rate / tuning.attitude_ratio
        velocity = attitude / tuning.velocity_ratio
        return Gains(velocity / tuning.position_ratio, velocity, attitude, rate, tuning.lead_share * lag)


@dataclass(frozen=True, slots=True)
class State:
    """What the law is told: NED position and velocity, body-to-NED quaternion, body rates."""

    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    rate_rad_s: NDArray[np.float64]


def _axes(q: NDArray[np.float64]) -> Axes:
    """The body's axes in NED (columns of the rotation matrix) of the quaternion (w, x, y, z)."""
    w, x, y, z = q.tolist()
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _scaled(a: Vector, k: float) -> Vector:
    return a[0] * k, a[1] * k, a[2] * k


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def attitude_error(body: Axes, desired: Axes) -> Vector:
    """Rotation vector in the body frame, rad, from the ``body`` axes to the ``desired`` ones."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = body
    (dx, dy, dz), (ex, ey, ez), (fx, fy, fz) = desired
    # Half the sum of the cross products of each axis with where it should be: the sine of the angle, along the axis.
    x = 0.5 * (ay * dz - az * dy + by * ez - bz * ey + cy * fz - cz * fy)
    y = 0.5 * (az * dx - ax * dz + bz * ex - bx * ez + cz * fx - cx * fz)
    z = 0.5 * (ax * dy - ay * dx + bx * ey - by * ex + cx * fy - cy * fx)
    trace = ax * dx + ay * dy + az * dz + bx * ex + by * ey + bz * ez + cx * fx + cy * fy + cz * fz
    sine = math.sqrt(x * x + y * y + z * z)
    scale = math.atan2(sine, 0.5 * (trace - 1.0)) / sine if sine > 1e-9 else 1.0
    return (
        scale * (ax * x + ay * y + az * z),
        scale * (bx * x + by * y + bz * z),
        scale * (cx * x + cy * y + cz * z),
    )


def steady_push(
    quaternion: NDArray[np.float64],
    specific_force_m_s2: NDArray[np.float64],
    most_m_s2: float = DEFAULT.law.integral_max_m_s2,
) -> NDArray[np.float64]:
    """Horizontal push of the thrust now (3,) m/s^2 NED, at most ``most_m_s2``: in a steady hover, what the
    wind asks for.

    The integral begins with it, so that taking over does not let the vehicle drift off first.
    """
    down = _axes(quaternion)[2]
    force = float(specific_force_m_s2[2])
    return np.array([_clip(down[0] * force, most_m_s2), _clip(down[1] * force, most_m_s2), 0.0])


class ControlLaw:
    """Constants of one airframe; ``demand`` takes and returns its memory."""

    def __init__(self, vehicle: Vehicle, tuning: LawTuning = DEFAULT.law) -> None:
        self._vehicle, self._tuning = vehicle, tuning
        self.gains = Gains.of(vehicle, tuning)
        self._turn_shares = np.array([1.0, 1.0, tuning.yaw_share])
        self._inertia: list[float] = vehicle.inertia_kg_m2.tolist()
        self._scale = 1.0 / vehicle.row_scale

    def taken_over(
        self, quaternion: NDArray[np.float64], specific_force_m_s2: NDArray[np.float64], knowledge: Knowledge
    ) -> Memory:
        """Memory to begin with; where the drag is fed forward, it is not counted twice."""
        if knowledge.push_m_s2.any():
            return Memory.empty()
        return Memory(steady_push(quaternion, specific_force_m_s2, self._tuning.integral_max_m_s2), np.zeros(3))

    def demand(
        self, state: State, reference: Reference, memory: Memory, knowledge: Knowledge, dt_s: float
    ) -> tuple[NDArray[np.float64], Memory]:
        """Demand (n,) in normalised units, and the new memory."""
        tuning = self._tuning
        body = _axes(state.quaternion)
        push, gathered = self._push(state, reference, memory.push_m_s2, dt_s)
        dx, dy = [_clip(value, tuning.drag_max_m_s2) for value in knowledge.push_m_s2.tolist()]
        drag = [body[0][k] * dx + body[1][k] * dy for k in range(3)]
        push = _within_tilt((push[0] - drag[0], push[1] - drag[1], push[2] - drag[2]), tuning)
        # The floor is on what the motors give, after phi a is taken off: nobody asks a motor for less than nothing.
        specific = max(-_dot(push, body[2]) - float(knowledge.residual[0]), tuning.min_thrust_share * GRAVITY_M_S2)

        down = _scaled(push, -1.0 / math.sqrt(_dot(push, push)))
        heading = (math.cos(reference.yaw_rad), math.sin(reference.yaw_rad), 0.0)
        right = _cross(down, heading)
        right = _scaled(right, 1.0 / math.sqrt(_dot(right, right)))
        desired = (_cross(right, down), right, down)
        turning = self._turning(memory, desired, dt_s)
        w, j = state.rate_rad_s.tolist(), self._inertia
        angular, turned = self._turn(attitude_error(body, desired), turning, w, memory, knowledge, dt_s)
        gyroscopic = _cross((w[0], w[1], w[2]), (j[0] * w[0], j[1] * w[1], j[2] * w[2]))
        torque = [j[k] * angular[k] + gyroscopic[k] for k in range(3)]
        demand = np.array([self._vehicle.mass_kg * specific, *torque])
        sinking = float(state.velocity_m_s[2] - reference.velocity_m_s[2])
        error = (-sinking, *turned.tracking_error)
        return demand * self._scale, replace(turned, push_m_s2=gathered, desired=desired, tracking_error=error)

    def _turn(
        self,
        axis: Vector,
        turning: Vector,
        w: list[float],
        memory: Memory,
        knowledge: Knowledge,
        dt_s: float,
    ) -> tuple[list[float], Memory]:
        """Angular acceleration (3,) asked for, and what the attitude loop remembers."""
        g, t = self.gains, self._tuning
        share = lag_share(dt_s, t.lead_s)
        before = memory.rate_rad_s or (w[0], w[1], w[2])
        old = memory.acceleration_rad_s2
        acceleration = [old[k] + share * ((w[k] - before[k]) / dt_s - old[k]) for k in range(3)]
        integral, known = memory.turn_rad_s2.tolist(), knowledge.residual.tolist()
        out, error = [], []
        for k in range(3):
            slow, most = (t.yaw_share, t.yaw_rate_max_rad_s) if k == 2 else (1.0, t.rate_max_rad_s)
            rate = _clip(slow * g.attitude * axis[k], most) + turning[k]
            error.append(w[k] - rate)
            back = g.rate * (rate - w[k] - g.lead_s * acceleration[k])
            out.append(slow * (back + integral[k]) - known[k + 1])
            step = dt_s * t.torque_integral_per_s * g.rate * g.attitude * axis[k] * slow
            integral[k] = _clip(integral[k] + step, t.torque_integral_max_rad_s2)
        return out, Memory(
            push_m_s2=memory.push_m_s2,
            turn_rad_s2=np.array(integral),
            rate_rad_s=(w[0], w[1], w[2]),
            acceleration_rad_s2=(acceleration[0], acceleration[1], acceleration[2]),
            turning_rad_s=turning,
            tracking_error=tuple(error),
        )

    def _turning(self, memory: Memory, desired: Axes, dt_s: float) -> Vector:
        """Rate (3,) rad/s, body, at which the attitude wanted turns, smoothed."""
        if memory.desired is None:
            return 0.0, 0.0, 0.0
        step = attitude_error(memory.desired, desired)
        share, old = lag_share(dt_s, self._tuning.turning_s), memory.turning_rad_s
        new = [old[k] + share * (_clip(step[k] / dt_s, self._tuning.turning_max_rad_s) - old[k]) for k in range(3)]
        return new[0], new[1], new[2]

    def _push(
        self, state: State, reference: Reference, integral: NDArray[np.float64], dt_s: float
    ) -> tuple[Vector, NDArray[np.float64]]:
        """Acceleration wanted less gravity, NED, and the integral (3,) of the position loop."""
        g, t = self.gains, self._tuning
        error: list[float] = (reference.position_m - state.position_m).tolist()
        size = math.sqrt(error[0] * error[0] + error[1] * error[1] + error[2] * error[2])
        if size > t.position_error_max_m:
            error = [e * (t.position_error_max_m / size) for e in error]
        before: list[float] = integral.tolist()
        slower: list[float] = (reference.velocity_m_s - state.velocity_m_s).tolist()
        north, east, down = (
            g.velocity * (g.position * e + v) + i + a
            for e, v, i, a in zip(error, slower, before, reference.acceleration_m_s2.tolist(), strict=True)
        )
        if size < t.position_error_max_m:
            step, most = dt_s * t.integral_per_s * g.velocity * g.position, t.integral_max_m_s2
            integral = np.array([_clip(i + step * e, most) for i, e in zip(before, error, strict=True)])
        return (north, east, _clip(down, t.vertical_max_m_s2) - GRAVITY_M_S2), integral


def _within_tilt(push: Vector, tuning: LawTuning) -> Vector:
    """Specific force (3,) NED, upward whatever was asked for, its horizontal part cut to the largest tilt."""
    north, east, vertical = push
    vertical = min(vertical, tuning.vertical_max_m_s2 - GRAVITY_M_S2)
    lateral = math.hypot(north, east)
    lateral_max = -vertical * math.tan(math.radians(tuning.tilt_max_deg))
    if lateral > lateral_max:
        north, east = north * lateral_max / lateral, east * lateral_max / lateral
    return north, east, vertical
