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

from nff_companion.control.cascade import (
    NOUGHT,
    Axes,
    Vector,
    attitude_error,
    axes_along,
    axes_of,
    clip,
    dot,
    followed,
    gyroscopic,
    scaled,
    within_tilt,
)
from nff_companion.core.tuning import DEFAULT, LawTuning
from nff_companion.core.vehicle import GRAVITY_M_S2, Vehicle


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
    """What the law remembers between samples.

    Integrals of the position loop, m/s^2 NED, and of the attitude loop, rad/s^2 body; the last body rates and their
    derivative; the body axes wanted last (NED) and the rate at which they turn; the tracking error s (n,) of the last
    sample, actual - reference: upward velocity in m/s, body rates in rad/s.
    """

    push_m_s2: Vector = NOUGHT
    turn_rad_s2: Vector = NOUGHT
    rate_rad_s: Vector | None = None
    acceleration_rad_s2: Vector = NOUGHT
    desired: Axes | None = None
    turning_rad_s: Vector = NOUGHT
    tracking_error: tuple[float, ...] = ()

    def held_back(self, before: Memory, limited: NDArray[np.bool_]) -> Memory:
        """With the attitude integrals of axes that are ``limited`` (3,) bool by saturation grown no further."""
        if not limited.any():
            return self
        x, y, z = [
            old if stop and abs(new) > abs(old) else new
            for new, old, stop in zip(self.turn_rad_s2, before.turn_rad_s2, limited.tolist(), strict=True)
        ]
        return replace(self, turn_rad_s2=(x, y, z))


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


def steady_push(
    quaternion: NDArray[np.float64],
    specific_force_m_s2: NDArray[np.float64],
    most_m_s2: float = DEFAULT.law.integral_max_m_s2,
) -> Vector:
    """Horizontal push of the thrust now, m/s^2 NED, at most ``most_m_s2``: in a steady hover, what the wind asks for.

    The integral begins with it, so that taking over does not let the vehicle drift off first.
    """
    down = axes_of(*quaternion.tolist())[2]
    force = float(specific_force_m_s2[2])
    return clip(down[0] * force, most_m_s2), clip(down[1] * force, most_m_s2), 0.0


class ControlLaw:
    """Constants of one airframe; ``demand`` takes and returns its memory."""

    def __init__(self, vehicle: Vehicle, tuning: LawTuning = DEFAULT.law) -> None:
        self._tuning = tuning
        self.gains = g = Gains.of(vehicle, tuning)
        self._mass_kg = vehicle.mass_kg
        x, y, z = vehicle.inertia_kg_m2.tolist()
        self._inertia: Vector = (x, y, z)
        self._scale: list[float] = (1.0 / vehicle.row_scale).tolist()
        self._tangent = math.tan(math.radians(tuning.tilt_max_deg))
        self._least_m_s2 = tuning.min_thrust_share * GRAVITY_M_S2
        self._push_step = tuning.integral_per_s * g.velocity * g.position
        turn_step = tuning.torque_integral_per_s * g.rate * g.attitude
        slow = tuning.yaw_share
        # Of roll, pitch and yaw: share of the gains, attitude gain, largest rate, step of the integral.
        self._turns = (
            (1.0, g.attitude, tuning.rate_max_rad_s, turn_step),
            (1.0, g.attitude, tuning.rate_max_rad_s, turn_step),
            (slow, slow * g.attitude, tuning.yaw_rate_max_rad_s, slow * turn_step),
        )

    def taken_over(
        self, quaternion: NDArray[np.float64], specific_force_m_s2: NDArray[np.float64], knowledge: Knowledge
    ) -> Memory:
        """Memory to begin with; where the drag is fed forward, it is not counted twice."""
        if knowledge.push_m_s2.any():
            return Memory()
        return Memory(steady_push(quaternion, specific_force_m_s2, self._tuning.integral_max_m_s2))

    def demand(
        self, state: State, reference: Reference, memory: Memory, knowledge: Knowledge, dt_s: float
    ) -> tuple[NDArray[np.float64], Memory]:
        """Demand (n,) in normalised units, and the new memory."""
        t = self._tuning
        body = axes_of(*state.quaternion.tolist())
        vx, vy, vz = state.velocity_m_s.tolist()
        wanted_x, wanted_y, wanted_z = reference.velocity_m_s.tolist()
        slower = (wanted_x - vx, wanted_y - vy, wanted_z - vz)
        (north, east, down), gathered = self._push(state, reference, slower, memory.push_m_s2, dt_s)
        dx, dy = knowledge.push_m_s2.tolist()
        dx, dy = clip(dx, t.drag_max_m_s2), clip(dy, t.drag_max_m_s2)
        (ax, ay, az), (bx, by, bz), body_down = body
        against_drag = (north - (ax * dx + bx * dy), east - (ay * dx + by * dy), down - (az * dx + bz * dy))
        push = within_tilt(against_drag, self._tangent, t.vertical_max_m_s2 - GRAVITY_M_S2)
        known: list[float] = knowledge.residual.tolist()
        # The floor is on what the motors give, after phi a is taken off: nobody asks a motor for less than nothing.
        specific = max(-dot(push, body_down) - known[0], self._least_m_s2)

        desired = axes_along(push, reference.yaw_rad)
        turning = NOUGHT
        if memory.desired is not None:  # the rate at which the attitude wanted turns, smoothed
            x, y, z = scaled(attitude_error(memory.desired, desired), 1.0 / dt_s)
            most = t.turning_max_rad_s
            step = clip(x, most), clip(y, most), clip(z, most)
            turning = followed(memory.turning_rad_s, step, dt_s, t.turning_s)
        wx, wy, wz = state.rate_rad_s.tolist()
        rate = (wx, wy, wz)
        before = memory.rate_rad_s or rate
        sharpness = ((wx - before[0]) / dt_s, (wy - before[1]) / dt_s, (wz - before[2]) / dt_s)
        acceleration = followed(memory.acceleration_rad_s2, sharpness, dt_s, t.lead_s)
        angular, integral, error = self._turn(
            attitude_error(body, desired), turning, rate, acceleration, memory.turn_rad_s2, dt_s
        )
        swirl, inertia, scale = gyroscopic(rate, self._inertia), self._inertia, self._scale
        demand = [self._mass_kg * specific * scale[0]]
        demand += [(inertia[k] * (angular[k] - known[k + 1]) + swirl[k]) * scale[k + 1] for k in (0, 1, 2)]
        return np.array(demand), Memory(
            push_m_s2=gathered,
            turn_rad_s2=integral,
            rate_rad_s=rate,
            acceleration_rad_s2=acceleration,
            desired=desired,
            turning_rad_s=turning,
            tracking_error=(slower[2], *error),
        )

    def _turn(
        self, axis: Vector, turning: Vector, rate: Vector, acceleration: Vector, integral: Vector, dt_s: float
    ) -> tuple[list[float], Vector, list[float]]:
        """Angular acceleration (3,) asked for, the integral after it, and the rate's error (3,)."""
        gain, lead_s, limit = self.gains.rate, self.gains.lead_s, self._tuning.torque_integral_max_rad_s2
        out, grown, errors = [], [], []
        for k in (0, 1, 2):
            slow, attitude, most, step = self._turns[k]
            error = rate[k] - (clip(attitude * axis[k], most) + turning[k])
            errors.append(error)
            out.append(slow * (gain * (-error - lead_s * acceleration[k]) + integral[k]))
            grown.append(clip(integral[k] + dt_s * step * axis[k], limit))
        return out, (grown[0], grown[1], grown[2]), errors

    def _push(
        self, state: State, reference: Reference, slower: Vector, integral: Vector, dt_s: float
    ) -> tuple[Vector, Vector]:
        """Acceleration wanted less gravity, NED, and the integral of the position loop; ``slower`` than that, m/s."""
        g, t = self.gains, self._tuning
        px, py, pz = state.position_m.tolist()
        x, y, z = reference.position_m.tolist()
        x, y, z = x - px, y - py, z - pz
        size, most = math.sqrt(x * x + y * y + z * z), t.position_error_max_m
        near = size < most
        if size > most:
            x, y, z = x * (most / size), y * (most / size), z * (most / size)
        i, j, k = integral
        forward, sideways, sinking = reference.acceleration_m_s2.tolist()
        push = (
            g.velocity * (g.position * x + slower[0]) + i + forward,
            g.velocity * (g.position * y + slower[1]) + j + sideways,
            clip(g.velocity * (g.position * z + slower[2]) + k + sinking, t.vertical_max_m_s2) - GRAVITY_M_S2,
        )
        if near:
            step, most = dt_s * self._push_step, t.integral_max_m_s2
            integral = (clip(i + step * x, most), clip(j + step * y, most), clip(k + step * z, most))
        return push, integral
