"""Neural-Fly's adaptation: the residual is phi(x, u) a; a follows it by a Kalman filter ([S] 8, 9; [L] 26, 27).

One step in Joseph form, after the continuous law a' = -lam a - P phi^T R^-1 (phi a - y) + P phi^T s:

    a- = a0 + (1 - lam dt) (a - a0) ;  P- = (1 - lam dt)^2 P + Q dt
    K  = P- phi^T (phi P- phi^T + R/dt)^-1
    a  = a- - K (phi a- - y) + dt P- phi^T s ;  P = (I - K phi) P- (I - K phi)^T + K (R/dt) K^T

The printed discrete forms have R dt and another sign or scale of s and do not converge to the continuous law; an Euler
step of the covariance loses definiteness. [S] decays towards 0; we decay towards a0, what the training flights had in
common, so that a vehicle that starts its flight is already described.

All axes share the basis and, measured in their own scale, the noise: one gain (k,) serves every column of a (k, n).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import AdaptationTuning


@dataclass(slots=True)
class AdaptationState:
    """a (k, n) and P (k, k)."""

    a: NDArray[np.float64]
    covariance: NDArray[np.float64]


class Adaptation:
    """Constants for k basis functions and n axes."""

    def __init__(
        self, prior: NDArray[np.float64], tuning: AdaptationTuning, spread: NDArray[np.float64] | None = None
    ) -> None:
        """``prior``: a0 (k, n); ``spread``: P at the start (k, k), else that of a steady flight."""
        self.prior = prior
        k = len(prior)
        self._drive = np.eye(k) / tuning.follow_s**2
        self._start = np.eye(k) / tuning.follow_s if spread is None else spread
        # Directions of phi that a flight does not excite gather variance for ever: P's trace may grow this much.
        self._trace_max = tuning.covariance_growth * float(self._start.trace())
        self._identity = np.eye(k)
        self._tuning = tuning

    def start(self) -> AdaptationState:
        """Nothing learnt in this flight."""
        return AdaptationState(self.prior.copy(), self._start.copy())

    def step(
        self,
        state: AdaptationState,
        basis: NDArray[np.float64],
        residual: NDArray[np.float64],
        dt_s: float,
        tracking_error: NDArray[np.float64] | None = None,
    ) -> AdaptationState:
        """One sample: ``basis`` phi (k,), ``residual`` y (n,), ``tracking_error`` s (n,), actual - reference."""
        o = self._tuning
        keep, noise = 1.0 - o.forget_per_s * dt_s, 1.0 / dt_s
        a, covariance = state.a, state.covariance
        if keep != 1.0:
            a, covariance = self.prior + keep * (a - self.prior), keep * keep * covariance
        covariance = covariance + dt_s * self._drive
        reach = covariance.dot(basis)
        gain = reach / (float(basis.dot(reach)) + noise)
        new = a + _outer(gain, residual - basis.dot(a))
        if tracking_error is not None and o.composite:
            new = new + _outer((o.composite * dt_s) * reach, tracking_error)
        left = self._identity - _outer(gain, basis)
        covariance = left.dot(covariance).dot(left.T) + _outer(noise * gain, gain)
        size = sum(covariance.diagonal().tolist())
        if size > self._trace_max:
            covariance *= self._trace_max / size
        return AdaptationState(a=new, covariance=covariance)


def _outer(column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
    """Product (k, n) of (k,) and (n,); as a matrix product it costs half of what broadcasting costs."""
    return column[:, None].dot(row[None])
