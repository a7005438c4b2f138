"""Adaptation of the whole effectiveness matrix, Bbar = Bhat - B0 (6.19)-(6.32).

    P' = P/l1 - P (l2/l1 I + u u^T) P                                   (6.28)
    Bbar' = -(Bbar u - y) u^T P - (l2/l1) Bbar P + s u^T P              (6.32)

Both are carried in information form, which is linear: with S = P^-1 and N = Bbar S,

    S' = -S/l1 + l2/l1 I + u u^T,    N' = -N/l1 + (y + s) u^T

whose step at constant u, y, s is exact; an Euler step of P loses definiteness. P(0) = I/l2, Bbar(0) = 0 make the
recursion the batch solution (6.24).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import msgspec
import numpy as np
from numpy.typing import NDArray


class FullMatrixOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tuning."""

    forget_s: float = 0.5  # l1
    regularisation: float = 0.05  # l2
    composite: float = 0.0  # weight of the tracking error


@dataclass(slots=True)
class FullMatrixState:
    """S (m, m) and N (n, m)."""

    information: NDArray[np.float64]
    vector: NDArray[np.float64]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Bbar (n, m)."""
        return cast("NDArray[np.float64]", np.linalg.solve(self.information, self.vector.T).T)


class FullMatrix:
    """Constants for n axes and m motors."""

    def __init__(self, axes: int, motors: int, options: FullMatrixOptions) -> None:
        self._axes, self._motors, self._options = axes, motors, options

    def start(self) -> FullMatrixState:
        """Bbar = 0."""
        return FullMatrixState(
            self._options.regularisation * np.eye(self._motors), np.zeros((self._axes, self._motors))
        )

    def step(
        self,
        state: FullMatrixState,
        thrust: NDArray[np.float64],
        residual: NDArray[np.float64],
        dt_s: float,
        tracking_error: NDArray[np.float64] | None = None,
    ) -> FullMatrixState:
        """One sample: ``thrust`` u (m,), ``residual`` y (n,), ``tracking_error`` s (n,), actual - reference."""
        o = self._options
        keep = math.exp(-dt_s / o.forget_s)
        gathered = (1.0 - keep) * o.forget_s
        target = residual if tracking_error is None else residual + o.composite * tracking_error
        return FullMatrixState(
            keep * state.information
            + (1.0 - keep) * o.regularisation * np.eye(self._motors)
            + gathered * np.outer(thrust, thrust),
            keep * state.vector + gathered * np.outer(target, thrust),
        )

    def rate(self, state: FullMatrixState, thrust: NDArray[np.float64]) -> float:
        """alpha (6.45) in 1/s: half the smallest eigenvalue of (u u^T + P^-1/l1 + l2/l1 I) relative to P^-1."""
        o = self._options
        s = state.information
        drive = np.outer(thrust, thrust) + s / o.forget_s + o.regularisation / o.forget_s * np.eye(self._motors)
        values = np.linalg.eigvals(np.linalg.solve(s, drive))
        return 0.5 * float(values.real.min())
