"""Sudden losses: sums over windows that begin at each possible onset, weighted by how a loss would show.

A motor that stops at t0 loses its thrust by its lag, and the residual shows it through the filters. With
g(t - t0) that response, y = B0 diag(w) g(t - t0) e for t > t0: a matched filter for the final loss e, which needs
not wait until the rotor has stopped. All onsets are evaluated at once: a likelihood ratio over onset and motors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nff_companion.core.disturbance import CORRELATION_S
from nff_companion.core.filters import LowPass, loss_response
from nff_companion.core.residual import SMOOTHING_S
from nff_companion.core.vehicle import PITCH, ROLL, YAW

# Ages of the onsets compared, in s.
_AGES_S = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2)


# Errors of the model grow with the residual itself (inertia, arm, thrust): this share of it, on each axis, is not
# evidence. It keeps a large torque from drowning what the other axes say.
MODEL_ERROR_SHARE = 0.10
# So do errors with what the motors do beyond the steady part, which phi a has learnt. Of all together: inertia, thrust.
# Of each for itself: in forward flight one rotor flies in another's wake and gives a fifth less.
TOGETHER_ERROR_SHARE, SINGLE_ERROR_SHARE = 0.12, 0.12
YAW_ERROR_SHARE = 0.02  # yaw torque as a share of roll and pitch torque, besides the side drag
# Windows for a loss that is older than the memory: it has been there in full all along.
_STANDING_S = (0.1, 0.2)


@dataclass(slots=True)
class OnsetState:
    """The last samples, newest last."""

    outer: np.ndarray  # (L, m * m) w w'
    product: np.ndarray  # (L, n * m) y w'
    squared: np.ndarray  # (L, n) y^2
    doubtful: np.ndarray  # (L, n) variance by errors of the model that scale with what the motors do
    weight: np.ndarray  # (L, m) w
    residual: np.ndarray  # (L, n) y


@dataclass(frozen=True, slots=True)
class OnsetSums:
    """Statistics of each window: S (K, m, m), q (K, m), energy (K,), and its age (K,) in s."""

    matrix: np.ndarray
    vector: np.ndarray
    energy: np.ndarray
    age_s: np.ndarray


class OnsetBank:
    """Constants for one airframe (n axes, m motors) and sample time."""

    def __init__(
        self,
        axes: int,
        motors: int,
        inertia_kg_m2: np.ndarray,
        dt_s: float,
        lag_down_s: float,
        low_pass: LowPass | None,
        joint: float = 0.0,
    ) -> None:
        """``joint``: 0, y - phi a is taken as it is; else phi a may be off by so many deviations of the residual, and
        is estimated together with the losses."""
        counts = sorted({max(round(age / dt_s), 2) for age in _AGES_S})
        self._axes, self._motors, self._joint = axes, motors, joint
        self.length, self._dt = counts[-1], dt_s
        standing = [max(round(age / dt_s), 2) for age in _STANDING_S]
        response = loss_response(dt_s, self.length, lag_down_s, low_pass, SMOOTHING_S)
        rows = len(counts) + len(standing)
        self._response = np.zeros((rows, self.length))
        self._inside = np.zeros((rows, self.length))
        for row, count in enumerate(counts):
            self._response[row, self.length - count :] = response[:count]
            self._inside[row, self.length - count :] = 1.0
        for row, count in enumerate(standing, start=len(counts)):
            self._response[row, self.length - count :] = 1.0
            self._inside[row, self.length - count :] = 1.0
        self._squared = self._response**2
        self._counts = np.array(counts + standing)
        self.age_s = self._counts * dt_s
        self._error = MODEL_ERROR_SHARE**2 * np.eye(self._axes)
        self._yaw_share = (inertia_kg_m2[:2] / inertia_kg_m2[2]) ** 2

    def start(self) -> OnsetState:
        """Empty history."""
        length, n, m = self.length, self._axes, self._motors
        outer, product = np.zeros((length, m * m)), np.zeros((length, n * m))
        squared, doubtful, residual = (np.zeros((length, n)) for _ in range(3))
        return OnsetState(outer, product, squared, doubtful, np.zeros((length, m)), residual)

    def push(
        self, state: OnsetState, weight: np.ndarray, residual: np.ndarray, effectiveness: np.ndarray, steady: np.ndarray
    ) -> OnsetState:
        """Append one sample: w (m,) and y (n,); ``effectiveness`` (n, m) in accelerations, ``steady`` (m,) slow part of
        w. The state's arrays are moved in place."""
        for history in (
            state.outer,
            state.product,
            state.squared,
            state.doubtful,
            state.weight,
            state.residual,
        ):
            history[:-1] = history[1:]
        np.multiply(weight[:, None], weight, out=state.outer[-1].reshape(self._motors, -1))
        np.multiply(residual[:, None], weight, out=state.product[-1].reshape(self._axes, -1))
        np.multiply(residual, residual, out=state.squared[-1])
        beyond = effectiveness * (weight - steady)
        together, single = beyond.sum(axis=1), (beyond * beyond).sum(axis=1)
        state.weight[-1], state.residual[-1] = weight, residual
        state.doubtful[-1] = TOGETHER_ERROR_SHARE**2 * together * together + SINGLE_ERROR_SHARE**2 * single
        return state

    def sums(self, state: OnsetState, effectiveness: np.ndarray, variance: np.ndarray, yaw_error: float) -> OnsetSums:
        """Statistics of all windows; ``effectiveness`` (n, m) in accelerations, ``variance`` (n,) of y in steady
        flight; ``yaw_error``: yaw torque not modelled, as a share of roll and pitch torque."""
        error = self._error.copy()
        error[YAW, ROLL : PITCH + 1] = self._yaw_share * (YAW_ERROR_SHARE**2 + yaw_error**2)
        n, m, b = self._axes, self._motors, effectiveness
        energy = self._inside @ state.squared  # (K, n)
        # One weight for all windows: their improvements are then likelihoods of the same data.
        doubtful = ((self._inside @ state.doubtful) / self._counts[:, None]).max(axis=0)
        total = variance + error @ (energy / self._counts[:, None]).max(axis=0) + doubtful
        weight = self._dt / (CORRELATION_S * total)  # (n,)
        gram = (b.T * weight) @ b
        outer = (self._squared @ state.outer).reshape(-1, m, m)
        product = (self._response @ state.product).reshape(-1, n, m)
        matrix, vector = gram * outer, np.einsum("ai,kai->ki", weight[:, None] * b, product)
        evidence = energy @ weight
        if self._joint:
            # phi a may be wrong by a constant in the window, of the residual's own variance: integrated out.
            shift = self._joint**2 * variance
            share = weight * shift * weight / (1.0 + self._counts[:, None] * weight * shift)  # (K, n)
            moment = b * (self._response @ state.weight)[:, None, :]  # (K, n, m)
            total_y = self._inside @ state.residual  # (K, n)
            matrix = matrix - np.einsum("ka,kai,kaj->kij", share, moment, moment)
            vector = vector - np.einsum("ka,kai,ka->ki", share, moment, total_y)
            evidence = evidence - (share * total_y * total_y).sum(axis=1)
        return OnsetSums(matrix, vector, evidence, self.age_s)
