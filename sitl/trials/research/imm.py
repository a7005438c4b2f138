"""The peer: an interacting multiple model filter (filterpy) over "healthy" and each single motor failed.

Each model is a Kalman filter of the slow disturbance d (n,), measurement y = d + B0 diag(w) (eta_j - 1) + noise; they
differ in the motor that they hold dead. After a declaration the models are built anew around the motors left.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Measurement
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import MissingExtra
from sitl.trials.research.peer import Look, PeerEstimator

_PROBABILITY = 0.95
_STAY_PER_S = 0.05  # rate of leaving a model: a failure every 20 s, so that the filter stays awake
_WANDER_PER_S = 0.5  # of the disturbance, in deviations of the residual


class ImmEstimator(PeerEstimator):
    """``memory`` is the bank of filters."""

    confirm_s = 0.01

    def __init__(self, vehicle: Vehicle, dt_s: float) -> None:
        try:
            from filterpy.kalman import IMMEstimator, KalmanFilter
        except ImportError as error:
            raise MissingExtra("the detector imm needs filterpy: pip install nff-companion[sim]") from error
        super().__init__(vehicle, dt_s)
        self._imm = IMMEstimator
        self._wander = np.diag(self._variance) * (_WANDER_PER_S**2 * dt_s)

        class Hypothesis(KalmanFilter):
            """Kalman filter whose measurement has a known part."""

            known = np.zeros((vehicle.axes, 1))

            def update(self, z: Any, R: Any = None, H: Any = None) -> None:
                super().update(None if z is None else z - self.known, R, H)

        self._hypothesis = Hypothesis

    def memory(self) -> Any:
        """A filter for each model."""
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

    def look(
        self,
        memory: Any,
        residual: NDArray[np.float64],
        thrust: NDArray[np.float64],
        measurement: Measurement,
        failed: NDArray[np.bool_],
    ) -> Look:
        """The likeliest model names its motor."""
        for index, one in enumerate(memory.filters):
            loss = np.zeros(self.vehicle.axes) if index == 0 else -self._matrix[:, index - 1] * thrust[index - 1]
            one.known = loss[:, None]
        memory.predict()
        memory.update(residual[:, None])
        probability = np.asarray(memory.mu, float)
        best = int(probability.argmax())
        named = best - 1 if probability[best] > _PROBABILITY else -1
        return Look(memory, named, float(probability[best]), 1.0 - probability[1:], np.asarray(memory.x, float).ravel())
