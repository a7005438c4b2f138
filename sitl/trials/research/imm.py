"""The peer: an interacting multiple model filter (filterpy) over "healthy" and each single motor failed.

Each model is a Kalman filter of the slow disturbance d (n,), measurement y = d + B0 diag(w) (eta_j - 1) + noise; they
differ in the motor that they hold dead. Fed with the same filtered accelerations and thrusts as ours, on the
same flights. After a declaration the models are built anew around the motors left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.decision import DecisionState, Event
from nff_companion.core.disturbance import Disturbance
from nff_companion.core.estimate import Estimate, Measurement
from nff_companion.core.residual import ResidualFilter, ResidualState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import MissingExtra

_PROBABILITY = 0.95
_CONFIRM_S = 0.01
_STAY_PER_S = 0.05  # rate of leaving a model: a failure every 20 s, so that the filter stays awake
_WANDER_PER_S = 0.5  # of the disturbance, in deviations of the residual


@dataclass(slots=True)
class ImmState:
    """The filter bank and what has been declared."""

    residual: ResidualState
    decision: DecisionState
    bank: Any
    since_s: float | None
    candidate: int


class ImmEstimator:
    """Same interface as our estimator."""

    def __init__(self, vehicle: Vehicle, dt_s: float) -> None:
        try:
            from filterpy.kalman import IMMEstimator, KalmanFilter
        except ImportError as error:
            raise MissingExtra("the detector imm needs filterpy: pip install nff-companion[sim]") from error
        self._imm = IMMEstimator
        self.vehicle, self.dt_s = vehicle, dt_s
        self._filter = ResidualFilter(vehicle, dt_s)
        self._matrix = vehicle.acceleration_effectiveness
        self._noise = np.diag(Disturbance(vehicle).floor ** 2) * (Tuning().disturbance.correlation_s / dt_s)
        self._wander = np.diag(Disturbance(vehicle).floor ** 2) * (_WANDER_PER_S**2 * dt_s)

        class Hypothesis(KalmanFilter):
            """Kalman filter whose measurement has a known part."""

            known = np.zeros((vehicle.axes, 1))

            def update(self, z: Any, R: Any = None, H: Any = None) -> None:
                super().update(None if z is None else z - self.known, R, H)

        self._hypothesis = Hypothesis

    def _bank(self) -> Any:
        n, models = self.vehicle.axes, self.vehicle.motors + 1
        filters = []
        for _ in range(models):
            one = self._hypothesis(dim_x=n, dim_z=n)
            one.F, one.H, one.Q, one.R = np.eye(n), np.eye(n), self._wander.copy(), self._noise.copy()
            one.P = np.diag(np.diagonal(self._noise)).copy()
            filters.append(one)
        leave = 1.0 - math.exp(-_STAY_PER_S * self.dt_s)
        transition = np.full((models, models), leave / (models - 1))
        np.fill_diagonal(transition, 1.0 - leave)
        start = np.full(models, 0.01 / (models - 1))
        start[0] = 0.99
        return self._imm(filters, start, transition)

    def start(
        self,
        time_s: float,
        gyro: NDArray[np.float64],
        specific_force: NDArray[np.float64],
        command: NDArray[np.float64],
        failed: NDArray[np.bool_] | None = None,
        *,
        takes_off: bool = False,
    ) -> ImmState:
        """State at the first sample."""
        decision = DecisionState.start(self.vehicle.motors)
        if failed is not None:
            decision.failed = failed.copy()
        return ImmState(self._filter.start(gyro, specific_force, command), decision, self._bank(), None, 0)

    def step(self, state: ImmState, measurement: Measurement) -> tuple[ImmState, Estimate]:
        """One sample."""
        time_s, command = measurement.time_s, measurement.command
        filtered = self._filter.step(
            state.residual, measurement.gyro, measurement.specific_force, command, measurement.dt_s
        )
        failed = state.decision.failed if measurement.failed is None else measurement.failed
        weight = np.where(failed, 0.0, filtered.thrust_shown)
        residual = filtered.measured - self._matrix @ weight
        for index, one in enumerate(state.bank.filters):
            loss = np.zeros(self.vehicle.axes) if index == 0 else -self._matrix[:, index - 1] * weight[index - 1]
            one.known = loss[:, None]
        state.bank.predict()
        state.bank.update(residual[:, None])
        probability = np.asarray(state.bank.mu, float)
        best = int(probability.argmax())
        events: list[Event] = []
        since, bank = state.since_s, state.bank
        usable = best > 0 and probability[best] > _PROBABILITY and not failed[best - 1]
        since = (since if since is not None and best == state.candidate else time_s) if usable else None
        if since is not None and time_s - since >= _CONFIRM_S - 1e-9 and failed.sum() < self.vehicle.motors - 4:
            failed = failed.copy()
            failed[best - 1] = True
            state.decision.failed = failed
            events.append(Event(time_s, best, True, 0.0, float(probability[best])))
            since, bank = None, self._bank()
        eta = 1.0 - np.where(failed, 1.0, probability[1:])
        new = ImmState(filtered, state.decision, bank, since, best)
        slow = np.asarray(bank.x, float).ravel()
        return new, Estimate(
            effectiveness=eta,
            deviation=np.full(len(eta), 0.1),
            failed=failed,
            raw=residual,
            residual=residual - slow,
            disturbance=slow,
            features=None,
            thrust_shown=filtered.thrust_shown,
            lateral_m_s2=filtered.lateral_slow_m_s2,
            best=None,
            events=events,
        )
