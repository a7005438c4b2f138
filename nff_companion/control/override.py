"""Closing the loop from a telemetry sample to motor thrusts: what to follow, with which matrix, and why not. Pure."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.within_bounds import constrain, desaturate
from nff_companion.condition import Reason, Statement
from nff_companion.control.law import ControlLaw, Knowledge, Memory, Reference, State
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import DEFAULT, LawTuning, OverrideTuning
from nff_companion.core.vehicle import Vehicle


class OverrideState(msgspec.Struct, frozen=True, eq=False):
    """The reference held, None: nothing is followed yet; and what the law remembers."""

    hold: Reference | None = None
    memory: Memory = msgspec.field(default_factory=Memory)


class OverrideLoop:
    """Constants of one vehicle; ``answer`` takes and returns the state."""

    def __init__(
        self, vehicle: Vehicle, law: LawTuning = DEFAULT.law, tuning: OverrideTuning = DEFAULT.override
    ) -> None:
        self._law, self._tuning = ControlLaw(vehicle, law), tuning

    def answer(
        self,
        state: OverrideState,
        sample: Sample,
        matrix: NDArray[np.float64],
        left: NDArray[np.float64] | None,
        knowledge: Knowledge,
        dt_s: float,
    ) -> tuple[OverrideState, NDArray[np.float64] | Statement]:
        """Motor thrusts (m,) by (6.18), or why there are none. ``matrix`` A (m, n); ``left`` B (n, m) of the motors
        left, None while all are believed to work."""
        q, position, velocity = sample.quaternion, sample.position_m, sample.velocity_m_s
        if q is None or position is None or velocity is None:
            return state, Statement(Reason.STATE_UNKNOWN)
        if not (sample.moves_plausibly and math.isfinite(sum(position.tolist()))):
            return state, Statement(Reason.STATE_IMPLAUSIBLE)
        hold, memory = state.hold, state.memory
        if hold is None:
            yaw = float(np.arctan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2)))
            hold = Reference(position.copy(), np.zeros(3), yaw)
            memory = self._law.taken_over(q, sample.specific_force_m_s2, knowledge)
        reference, hold = _followed(sample, hold)
        now = State(position, velocity, q, sample.gyro_rad_s)
        demand, after = self._law.demand(now, reference, memory, knowledge, dt_s)
        if left is None:
            thrust, served = desaturate(matrix, demand, self._tuning)
        else:
            thrust, served = constrain(matrix, left, demand, self._tuning)
        if served is not demand:
            after = after.held_back(memory, np.abs(served - demand)[1:] > self._tuning.served_error)
        if not math.isfinite(sum(thrust.tolist())):
            return OverrideState(hold, memory), Statement(Reason.OUTPUTS_NOT_FINITE)
        return OverrideState(hold, after), thrust


def _followed(sample: Sample, hold: Reference) -> tuple[Reference, Reference]:
    """The autopilot's target, and what to hold when it stops: where it last wanted to be, not where we began."""
    target = sample.target_position_m
    if target is None or not math.isfinite(sum(target.tolist())):
        return hold, hold
    wanted = sample.target_yaw_rad
    yaw = hold.yaw_rad if wanted is None or not math.isfinite(wanted) else wanted
    reference = Reference(target, _finite(sample.target_velocity_m_s), yaw, _finite(sample.target_acceleration_m_s2))
    return reference, Reference(target, np.zeros(3), yaw)


def _finite(value: NDArray[np.float64] | None) -> NDArray[np.float64]:
    return np.zeros(3) if value is None or not math.isfinite(sum(value.tolist())) else value
