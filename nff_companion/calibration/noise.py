"""What the model leaves is coloured: gusts below, the gyro's noise above. An autoregressive model makes it white, so
that in the closed loop of a flight the gains come out right (prediction error method; Ljung, System Identification,
2nd ed., 3.2 and 13.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter


def autoregression(residuals: Sequence[NDArray[np.float64]], order: int) -> NDArray[np.float64]:
    """Whitening filter (order + 1,) with 1 first, of residuals (N,) in pieces (Yule-Walker)."""
    lags = np.zeros(order + 1)
    for r in residuals:
        lags += [float(r[: len(r) - k] @ r[k:]) for k in range(order + 1)]
    lags[0] = lags[0] * (1.0 + 1e-9) + 1e-30
    return np.concatenate([[1.0], -solve_toeplitz(lags[:-1], lags[1:])])


def whitened(values: NDArray[np.float64], whitening: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns (N, c) through the filter, without the first ``order`` of them."""
    return np.asarray(lfilter(whitening, [1.0], values, axis=0))[len(whitening) - 1 :]
