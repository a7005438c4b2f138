"""The right inverse of an adapted effectiveness matrix: the law B (6.16)."""

from __future__ import annotations

import numpy as np

from nff_companion.core.estimator import Estimate
from nff_companion.core.full_matrix import FullMatrix, FullMatrixOptions
from nff_companion.core.tuning import DEFAULT
from nff_companion.core.vehicle import Vehicle


class AdaptedMatrix:
    """Bhat of one flight, in normalised units."""

    def __init__(
        self, vehicle: Vehicle, options: FullMatrixOptions, gain_max: float = DEFAULT.planner.gain_max
    ) -> None:
        self._gain_max = gain_max
        self._nominal = vehicle.effectiveness
        self._unit = vehicle.normalised_per_acceleration
        self._adaptation = FullMatrix(vehicle.axes, vehicle.motors, options)
        self.restart()

    def restart(self) -> None:
        """Nothing learnt."""
        self._state = self._adaptation.start()
        self._last: np.ndarray | None = None

    def step(self, estimate: Estimate, dt_s: float) -> None:
        """One sample."""
        self._state = self._adaptation.step(self._state, estimate.weight, estimate.raw * self._unit, dt_s)

    def allocation(self, fallback: np.ndarray) -> np.ndarray:
        """Bhat^R (m, n) by pseudo-inverse; the last good one, or ``fallback``, where Bhat has lost an axis."""
        matrix = self._nominal + self._state.matrix
        try:
            inverse = np.linalg.pinv(matrix)
        except np.linalg.LinAlgError:
            inverse = np.full_like(fallback, np.nan)
        if np.isfinite(inverse).all() and float(np.abs(inverse).max()) <= self._gain_max:
            self._last = inverse
        return fallback if self._last is None else self._last
