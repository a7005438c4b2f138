"""The right inverse of an adapted effectiveness matrix: the law B (6.16)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import DEFAULT
from nff_companion.core.vehicle import Vehicle
from sitl.trials.research.full_matrix import FullMatrix, FullMatrixOptions, FullMatrixState


@dataclass(frozen=True)
class AdaptedState:
    """Bhat of one flight, and its last good right inverse (m, n)."""

    matrix: FullMatrixState
    last: NDArray[np.float64] | None = None


class AdaptedMatrix:
    """Constants of one vehicle, in normalised units."""

    def __init__(self, vehicle: Vehicle, options: FullMatrixOptions | None = None) -> None:
        self._nominal, self._gain_max = vehicle.effectiveness, DEFAULT.planner.gain_max
        self._unit = vehicle.normalised_per_acceleration
        self._adaptation = FullMatrix(vehicle.axes, vehicle.motors, options or FullMatrixOptions())

    def start(self) -> AdaptedState:
        """Nothing learnt."""
        return AdaptedState(self._adaptation.start())

    def step(self, state: AdaptedState, estimate: Estimate, dt_s: float) -> AdaptedState:
        """One sample."""
        matrix = self._adaptation.step(state.matrix, estimate.thrust_shown, estimate.raw * self._unit, dt_s)
        return AdaptedState(matrix, state.last)

    def allocation(
        self, state: AdaptedState, fallback: NDArray[np.float64]
    ) -> tuple[AdaptedState, NDArray[np.float64]]:
        """Bhat^R (m, n) by pseudo-inverse; the last good one, or ``fallback``, where Bhat has lost an axis."""
        matrix = self._nominal + state.matrix.matrix
        try:
            inverse = cast("NDArray[np.float64]", np.linalg.pinv(matrix))
        except np.linalg.LinAlgError:
            inverse = np.full_like(fallback, np.nan)
        if np.isfinite(inverse).all() and float(np.abs(inverse).max()) <= self._gain_max:
            state = AdaptedState(state.matrix, inverse)
        return state, fallback if state.last is None else state.last
