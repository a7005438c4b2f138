"""What the airframe file says wrongly of the whole vehicle, and flight shows: how much the motors lift, where the
centre of mass is, and how much the motors' differences turn.

A vehicle that is lifted beside its centre of mass is turned by its lift: in roll and pitch its effectiveness has a
share of the thrust row, B = B0 + s B0[thrust], one share s an axis; of thrust it is mass and full thrust, of yaw motors
that are not upright or not alike. The share is learnt with a prior, one Kalman filter an axis.

How many times the file's the vehicle turns about an axis (inertia, arms, torque over thrust) is a factor of that row,
which the monitor of the file measures (core/fit_monitor.py); it is followed slowly.

A disturbance that is learnt as a constant explains the same in hover, but not what is left when a motor stops, and it
may not grow so large (core/disturbance.py). Pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import BalanceTuning
from nff_companion.core.vehicle import GRAVITY_M_S2, PITCH, ROLL, THRUST, YAW, Vehicle


@dataclass(slots=True)
class BalanceState:
    """``share`` s (n,) in m/s^2 or rad/s^2 per m/s^2 of lift, its ``variance`` (n,), ``gain`` (n,) of the rows (None:
    the file's), and the effectiveness ``matrix`` (n, m) in accelerations with both; when it was last learnt."""

    share: NDArray[np.float64]
    variance: NDArray[np.float64]
    gain: NDArray[np.float64] | None
    matrix: NDArray[np.float64]
    learnt_s: float


def of_vehicle(share: NDArray[np.float64], vehicle: Vehicle) -> tuple[float, tuple[float, float]]:
    """What ``share`` (n,) says: lift over the file's, and the centre of mass (forward, right) in m from where the file
    has it."""
    lift = 1.0 + float(share[THRUST])
    arm_m = share[[ROLL, PITCH]] * vehicle.inertia_kg_m2[:2] / (vehicle.mass_kg * lift)
    return lift, (-float(arm_m[1]), float(arm_m[0]))


class Balance:
    """Constants of one airframe; states are replaced."""

    def __init__(self, vehicle: Vehicle, tuning: BalanceTuning, correlation_s: float) -> None:
        """``correlation_s`` of the residual: samples closer than this are not independent."""
        self._correlation_s = correlation_s
        self._nominal = effectiveness = vehicle.acceleration_effectiveness
        self._lift = effectiveness[THRUST]
        arm_m = float(np.hypot(vehicle.position_m[:, 0], vehicle.position_m[:, 1]).max())
        inertia = vehicle.inertia_kg_m2
        deviation = np.zeros(vehicle.axes)
        deviation[THRUST] = tuning.lift_deviation
        deviation[[ROLL, PITCH]] = tuning.centre_deviation * arm_m * vehicle.mass_kg / inertia[:2]
        one = np.abs(effectiveness[YAW]).mean() * vehicle.hover  # what one motor turns
        deviation[YAW] = tuning.yaw_deviation * one / GRAVITY_M_S2
        self._prior, self._quickest_s = deviation**2, tuning.quickest_s
        self._limit = tuning.deviations_max * deviation
        self._drift = self._prior / tuning.drift_s
        self._gain_rate = tuning.gain_per_s

    def start(self, time_s: float) -> BalanceState:
        """As the file says."""
        return BalanceState(np.zeros(len(self._prior)), self._prior, None, self._nominal, time_s)

    def lift_m_s2(self, thrust: NDArray[np.float64]) -> float:
        """Of thrust fractions (m,), as the file says."""
        return float(self._lift.dot(thrust))

    def turned(self, state: BalanceState, thrust: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """What thrust fractions (m,) turn (n,) beyond the file, by the gains of its rows."""
        return 0.0 if state.gain is None else (state.gain - 1.0) * self._nominal.dot(thrust)

    def due(self, state: BalanceState, time_s: float) -> bool:
        """Whether a sample at ``time_s`` says anything beyond what the last one has said."""
        return time_s - state.learnt_s >= self._correlation_s

    def learn(
        self,
        state: BalanceState,
        time_s: float,
        residual: NDArray[np.float64],
        lift_m_s2: float,
        variance: NDArray[np.float64],
        gains: NDArray[np.float64] | None = None,
    ) -> BalanceState:
        """One sample: ``residual`` (n,) with the present share, its ``variance`` (n,) in steady flight; ``gains`` (n,)
        of the rows as the flight shows them by now."""
        prior = np.minimum(state.variance + self._drift * (time_s - state.learnt_s), self._prior)
        # No quicker than a failure is named: what comes within a tenth of a second is one.
        passed_s = min(time_s - state.learnt_s, 2.0 * self._correlation_s)  # after a pause no more than without
        most = passed_s / self._quickest_s / max(lift_m_s2, 1.0)
        gain = np.minimum(prior * lift_m_s2 / (lift_m_s2 * lift_m_s2 * prior + variance), most)
        share = np.minimum(np.maximum(state.share + gain * residual, -self._limit), self._limit)
        rows, nominal = state.gain, self._nominal
        if gains is not None:
            before = np.ones(len(gains)) if rows is None else rows
            step = self._gain_rate * passed_s
            rows = before + np.minimum(np.maximum(gains - before, -step), step)
        if rows is not None:
            nominal = rows[:, None] * nominal
        matrix = nominal + share[:, None] * self._lift
        left = (1.0 - gain * lift_m_s2) ** 2 * prior + gain * gain * variance
        return BalanceState(share, left, rows, matrix, time_s)
