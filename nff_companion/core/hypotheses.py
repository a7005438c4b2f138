"""Which few motors explain the residual best: every single motor and every pair, in the box e in [-1, 0].

For a set of motors the sufficient statistics S, q give the improvement of J over "no loss" in closed form, so all
hypotheses are compared at once. Arrays carry a leading axis K of windows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TINY = 1e-9


@dataclass(frozen=True, slots=True)
class Scores:
    """Best e and improvement of each hypothesis in each window."""

    e: NDArray[np.float64]  # (K, H, s) eta - 1 of each motor of the set, in [-1, 0]
    improvement: NDArray[np.float64]  # (K, H) fall of J, in nats


def singles(matrix: NDArray[np.float64], vector: NDArray[np.float64], gamma: float) -> Scores:
    """Scores of each motor alone, from S (K, m, m) and q (K, m)."""
    diagonal = np.einsum("kii->ki", matrix)
    linear = vector + gamma
    e = np.clip(linear / (diagonal + _TINY), -1.0, 0.0)
    return Scores(e=e[:, :, None], improvement=linear * e - 0.5 * diagonal * e * e)


def pairs(
    matrix: NDArray[np.float64],
    vector: NDArray[np.float64],
    gamma: float,
    first: NDArray[np.intp],
    second: NDArray[np.intp],
) -> Scores:
    """Scores of the pairs (first[h], second[h]); the box is searched exactly: interior, then its four edges."""
    a, b = matrix[:, first, first] + _TINY, matrix[:, second, second] + _TINY
    c = matrix[:, first, second]
    p, q = vector[:, first] + gamma, vector[:, second] + gamma
    determinant = a * b - c * c
    safe = np.where(determinant > 1e-6 * a * b, determinant, np.inf)
    inside_x, inside_y = (b * p - c * q) / safe, (a * q - c * p) / safe
    ok = (inside_x <= 0) & (inside_x >= -1) & (inside_y <= 0) & (inside_y >= -1) & np.isfinite(safe)

    def value(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return p * x + q * y - 0.5 * (a * x * x + 2 * c * x * y + b * y * y)

    best_x, best_y = np.where(ok, inside_x, 0.0), np.where(ok, inside_y, 0.0)
    best = np.where(ok, value(best_x, best_y), -np.inf)
    for edge in (-1.0, 0.0):
        for x, y in (
            (np.full_like(p, edge), np.clip((q - c * edge) / b, -1.0, 0.0)),
            (np.clip((p - c * edge) / a, -1.0, 0.0), np.full_like(q, edge)),
        ):
            here = value(x, y)
            better = here > best
            best = np.where(better, here, best)
            best_x, best_y = np.where(better, x, best_x), np.where(better, y, best_y)
    return Scores(e=np.stack([best_x, best_y], axis=2), improvement=best)


def without_nuisance(
    matrix: NDArray[np.float64], vector: NDArray[np.float64], energy: NDArray[np.float64], nuisance: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """S, q, energy after the columns ``nuisance`` (indices) are fitted freely, and their coefficients (.., |nuisance|).
    Any axes may lead.

    The Schur complement: motors already declared may still push (spinning down) or work again; neither may be
    blamed on the others.
    """
    if len(nuisance) == 0:
        return matrix, vector, energy, np.zeros((*vector.shape[:-1], 0))
    cross = matrix[..., nuisance]
    part = vector[..., nuisance]
    ridge = 1e-6 * np.trace(matrix, axis1=-2, axis2=-1)[..., None, None] + _TINY
    block = cross[..., nuisance, :] + ridge * np.eye(len(nuisance))
    inverse = np.linalg.inv(block) if len(nuisance) > 1 else 1.0 / block
    gain = cross @ inverse
    coefficients = np.einsum("...ij,...j->...i", inverse, part)
    reduced = matrix - gain @ cross.swapaxes(-1, -2)
    remaining = vector - np.einsum("...ij,...j->...i", gain, part)
    reduced[..., nuisance, :] = 0.0
    reduced[..., nuisance] = 0.0
    remaining[..., nuisance] = 0.0
    return reduced, remaining, energy - (part * coefficients).sum(axis=-1), coefficients
