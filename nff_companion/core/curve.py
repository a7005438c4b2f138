"""What the airframe file says wrongly of the thrust curve: how much it is bent.

In hover all motors work at about the same output, and a curve that is bent otherwise than the file's is a little more
or less of everything, which ``balance.py`` learns. Once a motor is lost its neighbours give much more and the one
across gives little: by a curve that is off, that one looks as if it failed too.

Thrust is w + k w (w - h), h the mean of the motors that work: what it is about hover stays as it is. The residual has
a share g = B (w (w - h)) of it, one k for all motors, learnt with a prior once a motor is declared: while all work
the air does more than a bend. What is not known of k is no evidence. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import CurveTuning


@dataclass(slots=True)
class CurveState:
    """``bend`` k and its ``variance``; when it was last learnt."""

    bend: float
    variance: float
    learnt_s: float


class Curve:
    """Constants; states are replaced."""

    def __init__(self, tuning: CurveTuning, correlation_s: float) -> None:
        """``correlation_s`` of the residual: samples closer than this are not independent."""
        self._correlation_s, self._quickest_s = correlation_s, tuning.quickest_s
        self._prior = tuning.bend_deviation**2
        self._drift = self._prior / tuning.drift_s
        self._limit = tuning.deviations_max * tuning.bend_deviation

    def start(self, time_s: float) -> CurveState:
        """As the file says."""
        return CurveState(0.0, self._prior, time_s)

    @staticmethod
    def shown(matrix: NDArray[np.float64], thrust: NDArray[np.float64]) -> NDArray[np.float64]:
        """g (n,) of thrust fractions (m,), 0 of the motors that are declared; ``matrix`` (n, m) in accelerations."""
        mean = float(thrust.sum()) / max(int(np.count_nonzero(thrust)), 1)
        return matrix.dot(thrust * (thrust - mean))

    def learn(
        self,
        state: CurveState,
        time_s: float,
        residual: NDArray[np.float64],
        share: NDArray[np.float64],
        variance: NDArray[np.float64],
    ) -> CurveState:
        """One sample: ``residual`` (n,) with the present bend, g as ``share`` (n,), ``variance`` (n,) in steady flight;
        nothing where the last one was not long ago."""
        passed_s = time_s - state.learnt_s
        if passed_s < self._correlation_s:
            return state
        told, before = share / variance, min(state.variance + self._drift * passed_s, self._prior)
        left = 1.0 / (1.0 / before + float(told.dot(share)))
        change = left * float(told.dot(residual))
        # No quicker than a failure is named, also after a pause.
        pace = min(passed_s, 2.0 * self._correlation_s) / self._quickest_s
        bend = min(max(state.bend + pace * change, -self._limit), self._limit)
        return CurveState(bend, before + pace * (left - before), time_s)
