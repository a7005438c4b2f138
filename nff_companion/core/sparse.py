"""Sparse effectiveness, discrete law (23) as a box quadratic program, and shaping (24).

    J = sum_k exp(-w_f (t - t_k)) dt |y_k - B0 diag(w_k) e|^2_W / 2 + gamma |e|_1,   e = eta - 1 in [-1, 0]

Since e <= 0, |e|_1 = -sum e is linear:  min 1/2 e'S e - (q + gamma 1)'e  in the box; gamma as in (8).
S and q are kept by recursion; dt keeps gamma independent of the rate. Exact active-set solver (daqp).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import SparseTuning
from nff_companion.errors import SolverError

_TINY = 1e-9


@dataclass(slots=True)
class Information:
    """S (m, m) and q (m,), both with forgetting."""

    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]

    @staticmethod
    def empty(motors: int) -> Information:
        """Nothing known."""
        return Information(np.zeros((motors, motors)), np.zeros(motors))


def update(
    information: Information,
    regressor: NDArray[np.float64],
    residual: NDArray[np.float64],
    noise_weight: NDArray[np.float64],
    dt_s: float,
    forgetting_per_s: float,
) -> Information:
    """One sample: ``regressor`` B0 diag(w) (n, m), ``residual`` y (n,), ``noise_weight`` diagonal of W (n,)."""
    keep = math.exp(-forgetting_per_s * dt_s)
    weighted = regressor.T * noise_weight
    return Information(
        matrix=keep * information.matrix + dt_s * weighted.dot(regressor),
        vector=keep * information.vector + dt_s * weighted.dot(residual),
    )


def solve(information: Information, gamma: float, lower: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """e (m,) minimising the program above. ``lower`` (m,) replaces -1. Raises SolverError.

    A motor without information (never driven) is left at 0: the l1 term alone decides it.
    """
    linear = information.vector + gamma
    values = linear.tolist()
    if min(values) >= 0.0 and math.isfinite(sum(values)):
        # The gradient at e = 0 is -(q + gamma 1): where it has no positive component, no e < 0 does better.
        return np.zeros(len(linear))
    diagonal = information.matrix.diagonal().tolist()
    if min(diagonal) > _TINY:
        return _box_program(information.matrix.copy(), -linear, lower)
    e = np.zeros(len(linear))
    free = np.flatnonzero(information.matrix.diagonal() > _TINY)
    if len(free):
        hessian = information.matrix[free[:, None], free]
        e[free] = _box_program(hessian, -linear[free], None if lower is None else lower[free])
    return e


def _box_program(
    hessian: NDArray[np.float64], gradient: NDArray[np.float64], lower: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """e minimising 1/2 e'H e + g'e in ``lower``, None: -1, to 0. ``hessian`` is written to. Raises SolverError."""
    count = len(gradient)
    # S has rank n at constant u: a proximal term far below the data makes the program strictly convex.
    hessian.ravel()[:: count + 1] += 1e-6 * sum(hessian.diagonal().tolist()) + _TINY
    low, high = np.full(count, -1.0) if lower is None else lower, np.zeros(count)
    e, _, flag, _ = daqp.solve(hessian, gradient, np.zeros((0, count)), high, low)
    if flag != 1 or not math.isfinite(sum(e.tolist())):
        raise SolverError(f"sparse step: daqp ended with flag {flag}; the last estimate stays")
    return np.minimum(np.maximum(e, low), high)


def effectiveness(information: Information, failed: NDArray[np.bool_], tuning: SparseTuning) -> NDArray[np.float64]:
    """eta (m,); motors already ``failed`` (m,) bool have a free coefficient in 0..``free_max`` instead of a loss,
    fitted with the losses of the others: hypotheses.without_nuisance for one window. Raises SolverError."""
    if True not in failed.tolist():
        return 1.0 + solve(information, tuning.gamma)
    matrix, vector = information.matrix, information.vector
    left, gone = np.flatnonzero(~failed), np.flatnonzero(failed)
    ridge = 1e-6 * sum(matrix.diagonal().tolist()) + _TINY
    rows, part = matrix.take(left, axis=0), vector.take(gone)
    cross, kept = rows.take(gone, axis=1), rows.take(left, axis=1)
    if len(gone) == 1:
        inverse = 1.0 / (matrix[gone, gone] + ridge)
        gain, free = cross * inverse, inverse * part
        rest = Information(matrix=kept - gain * cross.T, vector=vector.take(left) - gain[:, 0] * part)
    else:
        inverse = np.linalg.inv(matrix[gone[:, None], gone] + ridge * np.eye(len(gone)))
        gain, free = cross.dot(inverse), np.einsum("ij,j->i", inverse, part)
        lost = np.einsum("ij,j->i", gain, part)
        rest = Information(matrix=kept - gain.dot(cross.T), vector=vector.take(left) - lost)
    eta = np.empty(len(vector))
    eta[left] = 1.0 + solve(rest, tuning.gamma)
    eta[gone] = np.minimum(np.maximum(free, 0.0), tuning.free_max)
    return eta


def deviation(information: Information, prior: float = 1.0) -> NDArray[np.float64]:
    """Standard deviation (m,) of each e given the others, under a prior of standard deviation ``prior``.

    Given the others: at constant u the wrench has four axes for m motors, so that without the sparsity no motor
    could be known alone.
    """
    return np.asarray(1.0 / np.sqrt(np.maximum(information.matrix.diagonal(), 0.0) + 1.0 / prior**2))


def shape(effectiveness: NDArray[np.float64], full_at: float, none_below: float) -> NDArray[np.float64]:
    """Shaping (24): 1 from ``full_at`` (zeta), 0 below ``none_below`` (xi), linear between."""
    scaled = np.clip((effectiveness - none_below) / (full_at - none_below), 0.0, 1.0)
    return np.where(effectiveness < none_below, 0.0, scaled)
