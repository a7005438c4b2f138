"""How well phi a foretells the residual, one step ahead, beside a constant phi with the same adaptation."""

from __future__ import annotations

import msgspec
import numpy as np

from nff_companion.estimation.disturbance import Disturbance
from nff_companion.estimation.neural_fly import AdaptationOptions
from nff_companion.learning.dataset import RATE_HZ, Condition, Dataset
from nff_companion.learning.phi import Basis
from nff_companion.vehicle import AXES, Vehicle

_WARM_UP_S = 3.0  # of each flight not counted: a is being found
# An axis is covered when phi a explains so much of it, and leaves at most so much of the constant's error.
EXPLAINED_MIN, ERROR_OVER_CONSTANT_MAX = 0.80, 0.50


class Score(msgspec.Struct, frozen=True):
    """One-step-ahead prediction on flights that were not trained on; one value an axis."""

    explained: list[float]  # share of the residual's variance explained by phi a
    constant_explained: list[float]  # by a constant phi with the same adaptation
    error_over_constant: list[float]  # root mean square of y - phi a over that of the constant phi
    residual_rms: list[float]  # of y about its mean, SI
    error_rms: list[float]  # of y - phi a, SI
    minutes: float

    @property
    def covered(self) -> list[str]:
        """Axes that the network may claim to cover."""
        shares = zip(AXES, self.explained, self.error_over_constant, strict=True)
        return [axis for axis, share, ratio in shares if share >= EXPLAINED_MIN and ratio <= ERROR_OVER_CONSTANT_MAX]


def prediction_errors(disturbance: Disturbance, condition: Condition) -> np.ndarray:
    """y_k - phi_k a_(k-1) (L, n), SI, adapting from row to row."""
    state = disturbance.start()
    errors = np.empty_like(condition.residual)
    for k, (features, residual) in enumerate(zip(condition.features, condition.residual, strict=True)):
        basis = disturbance.basis(state, features)
        errors[k] = residual - disturbance.predict(state, basis)
        state = disturbance.step(state, basis, residual, 1.0 / RATE_HZ)
    return errors


def score(vehicle: Vehicle, basis: Basis, data: Dataset, options: AdaptationOptions | None = None) -> Score:
    """Figures over all conditions; the variance is that within each flight."""
    network = Disturbance(vehicle, basis, options)
    constant = Disturbance(vehicle, None, options)
    skip = round(_WARM_UP_S * RATE_HZ)
    ours, theirs, spread = [], [], []
    for condition in data.conditions:
        ours.append(prediction_errors(network, condition)[skip:] ** 2)
        theirs.append(prediction_errors(constant, condition)[skip:] ** 2)
        y = condition.residual[skip:]
        spread.append((y - y.mean(axis=0)) ** 2)
    error, other, variance = (np.concatenate(rows).mean(axis=0) for rows in (ours, theirs, spread))

    def listed(values: np.ndarray) -> list[float]:
        return [round(float(v), 4) for v in values]

    return Score(
        explained=listed(1.0 - error / variance),
        constant_explained=listed(1.0 - other / variance),
        error_over_constant=listed(np.sqrt(error / other)),
        residual_rms=listed(np.sqrt(variance)),
        error_rms=listed(np.sqrt(error)),
        minutes=round(data.minutes, 1),
    )
