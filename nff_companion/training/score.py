"""How well phi a foretells the residual, one step ahead, beside a constant phi with the same adaptation."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.basis_network import Basis
from nff_companion.core.disturbance import Disturbance
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import AXES, Vehicle
from nff_companion.training.dataset import Condition, Dataset

_WARM_UP_S = 3.0  # of each flight not counted: a is being found
# An axis is covered when phi a explains so much of it, and leaves at most so much of the constant's error.
EXPLAINED_MIN, ERROR_OVER_CONSTANT_MAX = 0.80, 0.50


class Score(msgspec.Struct, frozen=True):
    """One-step-ahead prediction on flights that were not trained on; one value an axis."""

    explained: list[float]  # share of the residual's variance explained by phi a
    constant_explained: list[float]  # by a constant phi with the same adaptation
    error_over_constant: list[float]  # root mean square of y - phi a over that of the constant phi
    error_over_fast_constant: list[float]  # over that of a constant that follows as fast as phi a does as a whole
    fast_constant_follow_s: float
    prior_explained: list[float]  # by phi a0: nothing is adapted but the mean of each flight, which is taken off
    residual_rms: list[float]  # of y about its mean, SI
    error_rms: list[float]  # of y - phi a, SI
    minutes: float

    @property
    def covered(self) -> list[str]:
        """Axes that the network may claim to cover."""
        shares = zip(AXES, self.explained, self.error_over_constant, strict=True)
        return [axis for axis, share, ratio in shares if share >= EXPLAINED_MIN and ratio <= ERROR_OVER_CONSTANT_MAX]


def prediction_errors(disturbance: Disturbance, condition: Condition) -> NDArray[np.float64]:
    """y_k - phi_k a_(k-1) (L, n), SI, adapting from row to row."""
    state, dt_s = disturbance.start(), 1.0 / condition.rate_hz
    errors = np.empty_like(condition.residual)
    for k, (features, residual) in enumerate(zip(condition.features, condition.residual, strict=True)):
        basis = disturbance.basis(state, features, dt_s)
        errors[k] = residual - disturbance.predict(state, basis)
        state = disturbance.step(state, basis, residual, dt_s)
    return errors


def _speed_per_s(disturbance: Disturbance, data: Dataset) -> float:
    """Median of phi P phi^T over the flights: the rate at which phi a as a whole follows y."""
    rates = []
    for condition in data.conditions:
        state, dt_s = disturbance.start(), 1.0 / condition.rate_hz
        for features, residual in zip(condition.features, condition.residual, strict=True):
            basis = disturbance.basis(state, features, dt_s)
            state = disturbance.step(state, basis, residual, dt_s)
            rates.append(float(basis @ state.adaptation.covariance @ basis))
    return float(np.median(rates))


def score(vehicle: Vehicle, basis: Basis, data: Dataset, tuning: Tuning | None = None) -> Score:
    """Figures over all conditions; the variance is that within each flight."""
    # Unbounded, all of them: what a motor's place is does not matter here.
    network = Disturbance(vehicle, basis, tuning, bounded=False)
    constant = Disturbance(vehicle, None, tuning, bounded=False)
    follow_s = 1.0 / _speed_per_s(network, data)
    fast = Disturbance(vehicle, None, Tuning().having("adaptation", follow_s=follow_s), bounded=False)

    def skip(condition: Condition) -> int:
        return round(_WARM_UP_S * condition.rate_hz)

    def squares(disturbance: Disturbance) -> NDArray[np.float64]:
        rows = [prediction_errors(disturbance, condition)[skip(condition) :] ** 2 for condition in data.conditions]
        return np.asarray(np.concatenate(rows).mean(axis=0))

    def within(rows: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        return np.asarray(np.concatenate([(y - y.mean(axis=0)) ** 2 for y in rows]).mean(axis=0))

    error, other, faster = squares(network), squares(constant), squares(fast)
    variance = within([c.residual[skip(c) :] for c in data.conditions])
    state = network.start()
    left = within(
        [
            c.residual[skip(c) :] - np.array([network.predict(state, basis(f)) for f in c.features[skip(c) :]])
            for c in data.conditions
        ]
    )

    def listed(values: NDArray[np.float64]) -> list[float]:
        return [round(float(v), 4) for v in values]

    return Score(
        explained=listed(1.0 - error / variance),
        constant_explained=listed(1.0 - other / variance),
        error_over_constant=listed(np.sqrt(error / other)),
        error_over_fast_constant=listed(np.sqrt(error / faster)),
        fast_constant_follow_s=round(follow_s, 2),
        prior_explained=listed(1.0 - left / variance),
        residual_rms=listed(np.sqrt(variance)),
        error_rms=listed(np.sqrt(error)),
        minutes=round(data.minutes, 1),
    )
