"""Sudden losses: sums over windows that begin at each possible onset, weighted by how a loss would show.

A motor that stops at t0 loses its thrust by its lag, and the residual shows it through the filters. With
g(t - t0) that response, y = B0 diag(w) g(t - t0) e for t > t0: a matched filter for the final loss e, which needs
not wait until the rotor has stopped. All onsets are evaluated at once (a likelihood ratio over onset and motors,
THEORY 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nff_companion.estimation.filters import LowPass, loss_response
from nff_companion.estimation.residual import SMOOTHING_S

# Ages of the onsets compared, in s.
_AGES_S = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1, 0.13, 0.16, 0.2)


@dataclass(slots=True)
class OnsetState:
    """The last samples, newest last."""

    outer: np.ndarray  # (L, m * m) w w'
    projected: np.ndarray  # (L, m) w * B0' W y
    energy: np.ndarray  # (L,) y' W y


@dataclass(frozen=True, slots=True)
class OnsetSums:
    """Statistics of each window: S (K, m, m), q (K, m), energy (K,), and its age (K,) in s."""

    matrix: np.ndarray
    vector: np.ndarray
    energy: np.ndarray
    age_s: np.ndarray


class OnsetBank:
    """Constants for one airframe and sample time."""

    def __init__(self, motors: int, dt_s: float, lag_down_s: float, low_pass: LowPass | None) -> None:
        counts = sorted({max(round(age / dt_s), 2) for age in _AGES_S})
        self.length, self._motors, self._dt = counts[-1], motors, dt_s
        response = loss_response(dt_s, self.length, lag_down_s, low_pass, SMOOTHING_S)
        self._response = np.zeros((len(counts), self.length))
        self._inside = np.zeros((len(counts), self.length))
        for row, count in enumerate(counts):
            self._response[row, self.length - count :] = response[:count]
            self._inside[row, self.length - count :] = 1.0
        self._squared = self._response**2
        self.age_s = np.array(counts) * dt_s

    def start(self) -> OnsetState:
        """Empty history."""
        length, m = self.length, self._motors
        return OnsetState(np.zeros((length, m * m)), np.zeros((length, m)), np.zeros(length))

    def push(
        self, state: OnsetState, regressor_weight: np.ndarray, projected: np.ndarray, energy: float
    ) -> OnsetState:
        """Append one sample: w (m,), B0' W y (m,), y' W y. The state's arrays are moved in place."""
        state.outer[:-1] = state.outer[1:]
        state.projected[:-1] = state.projected[1:]
        state.energy[:-1] = state.energy[1:]
        np.multiply(regressor_weight[:, None], regressor_weight, out=state.outer[-1].reshape(self._motors, -1))
        np.multiply(regressor_weight, projected, out=state.projected[-1])
        state.energy[-1] = energy
        return state

    def sums(self, state: OnsetState, gram: np.ndarray) -> OnsetSums:
        """Statistics of all windows; ``gram`` = B0' W B0 (m, m)."""
        m = self._motors
        outer = (self._squared @ state.outer).reshape(-1, m, m)
        return OnsetSums(
            self._dt * gram * outer,
            self._dt * (self._response @ state.projected),
            self._dt * (self._inside @ state.energy),
            self.age_s,
        )
