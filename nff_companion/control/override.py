"""Closing the loop from a telemetry sample to motor thrusts: what to follow, with which matrix, and why not."""

from __future__ import annotations

import math

import numpy as np

from nff_companion.allocation.within_bounds import constrain, desaturate
from nff_companion.control.law import Axes, ControlLaw, Knowledge, Memory, Reference, State
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import DEFAULT, LawTuning, OverrideTuning
from nff_companion.core.vehicle import Vehicle


class OverrideLoop:
    """Holds the reference and the integrals; ``blind`` says why the loop cannot be closed, empty when it is."""

    def __init__(
        self, vehicle: Vehicle, law: LawTuning = DEFAULT.law, tuning: OverrideTuning = DEFAULT.override
    ) -> None:
        self._law, self._tuning = ControlLaw(vehicle, law), tuning
        self._hold: Reference | None = None
        self._memory = Memory.empty()
        self.blind = ""

    def release(self) -> None:
        """What was followed is forgotten: the next sample starts anew."""
        self._hold, self._memory = None, Memory.empty()

    @property
    def desired(self) -> Axes | None:
        """Body axes wanted in the last answer, NED."""
        return self._memory.desired

    def answer(
        self, sample: Sample, matrix: np.ndarray, left: np.ndarray | None, knowledge: Knowledge, dt_s: float
    ) -> np.ndarray | None:
        """Motor thrusts (m,) by (6.18), None when the state is not known. ``matrix`` A (m, n); ``left`` B (n, m) of the
        motors left, None while all are believed to work."""
        q, position, velocity = sample.quaternion, sample.position_m, sample.velocity_m_s
        if q is None or position is None or velocity is None:
            self.blind = "override needs fresh attitude, position and velocity: allocating instead"
            return None
        if not (sample.moves_plausibly and math.isfinite(float(position.sum()))):
            self.blind = "override: attitude, velocity or position not those of a vehicle: allocating instead"
            return None
        if self._hold is None:
            yaw = float(np.arctan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2)))
            self._hold = Reference(position.copy(), np.zeros(3), yaw)
            self._memory = self._law.taken_over(q, sample.specific_force_m_s2, knowledge)
        state = State(position, velocity, q, sample.gyro_rad_s)
        reference = self._follow(sample, self._hold)
        demand, memory = self._law.demand(state, reference, self._memory, knowledge, dt_s)
        if left is None:
            thrust, served = desaturate(matrix, demand, self._tuning)
        else:
            thrust, served = constrain(matrix, left, demand, self._tuning)
        self._memory = memory.held_back(self._memory, np.abs(served - demand)[1:] > self._tuning.served_error)
        if not math.isfinite(float(thrust.sum())):
            self.blind = "override: outputs not finite: allocating instead"
            return None
        self.blind = ""
        return thrust

    def _follow(self, sample: Sample, hold: Reference) -> Reference:
        """The autopilot's target. When it stops: held where it last wanted to be, not where we began."""
        target = sample.target_position_m
        if target is None or not np.isfinite(target).all():
            return hold
        wanted = sample.target_yaw_rad
        yaw = hold.yaw_rad if wanted is None or not math.isfinite(wanted) else wanted
        self._hold = Reference(target, np.zeros(3), yaw)
        return Reference(target, _finite(sample.target_velocity_m_s), yaw, _finite(sample.target_acceleration_m_s2))


def _finite(value: np.ndarray | None) -> np.ndarray:
    return np.zeros(3) if value is None or not np.isfinite(value).all() else value
