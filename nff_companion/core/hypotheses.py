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
    diagonal = matrix.diagonal(axis1=1, axis2=2)
    linear = vector + gamma
    e = np.minimum(np.maximum(linear / (diagonal + _TINY), -1.0), 0.0)
    return Scores(e=e[:, :, None], improvement=linear * e - 0.5 * diagonal * e * e)


def more(vector: NDArray[np.float64], square: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Improvement (m,), at its best window, of each motor that pulls by up to its full thrust more than it is asked to:
    one whose output is stuck, high; and by how much of it (m,). From q and the diagonal of S (K, m)."""
    d = np.minimum(np.maximum(vector / (square + _TINY), 0.0), 1.0)
    improvement = vector * d - 0.5 * square * d * d
    best = improvement.argmax(axis=0)[None]
    return np.take_along_axis(improvement, best, 0)[0], np.take_along_axis(d, best, 0)[0]


def together(matrix: NDArray[np.float64], vector: NDArray[np.float64], motors: tuple[int, ...], most: float) -> float:
    """Improvement, at its best window, of that ``motors`` (indices) give more than is believed, all by the same share
    up to ``most``: from S (K, m, m) and q (K, m)."""
    chosen = list(motors)
    q = np.add.reduce(vector[:, chosen], axis=1)
    s = np.add.reduce(matrix[:, chosen][:, :, chosen], axis=(1, 2))
    c = np.minimum(np.maximum(q / (s + _TINY), 0.0), most)
    return float((q * c - 0.5 * s * c * c).max())


def pairs(
    matrix: NDArray[np.float64],
    vector: NDArray[np.float64],
    gamma: float,
    first: NDArray[np.intp],
    second: NDArray[np.intp],
) -> Scores:
    """Scores of the pairs (first[h], second[h]); the box is searched exactly: interior, then its four edges."""
    diagonal, linear = matrix.diagonal(axis1=1, axis2=2) + _TINY, vector + gamma
    a, b = diagonal.take(first, axis=1), diagonal.take(second, axis=1)
    c = matrix.reshape(len(matrix), -1).take(first * matrix.shape[-1] + second, axis=1)
    p, q = linear.take(first, axis=1), linear.take(second, axis=1)
    determinant = a * b - c * c
    safe = np.where(determinant > 1e-6 * a * b, determinant, np.inf)
    inside_x, inside_y = (b * p - c * q) / safe, (a * q - c * p) / safe
    ok = (inside_x <= 0) & (inside_x >= -1) & (inside_y <= 0) & (inside_y >= -1) & (safe < np.inf)

    # The interior, and the edges x = -1, y = -1, x = 0, y = 0, at once.
    x, y = np.empty((5, *p.shape)), np.empty((5, *p.shape))
    x[0], y[0] = np.where(ok, inside_x, 0.0), np.where(ok, inside_y, 0.0)
    x[1], x[3], y[2], y[4] = -1.0, 0.0, -1.0, 0.0
    y[1], y[3], x[2], x[4] = (q + c) / b, q / b, (p + c) / a, p / a
    np.minimum(np.maximum(x, -1.0, out=x), 0.0, out=x)
    np.minimum(np.maximum(y, -1.0, out=y), 0.0, out=y)
    values = p * x + q * y - 0.5 * (a * x * x + 2 * c * x * y + b * y * y)
    values[0][~ok] = -np.inf
    chosen = values.argmax(axis=0) * p.size + np.arange(p.size).reshape(p.shape)
    e = np.empty((*p.shape, 2))
    e[:, :, 0], e[:, :, 1] = x.take(chosen), y.take(chosen)
    return Scores(e=e, improvement=values.take(chosen))


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
    if len(nuisance) == 1 and matrix.ndim == 3:
        return _without_one(matrix, vector, energy, int(nuisance[0]))
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


def _without_one(
    matrix: NDArray[np.float64], vector: NDArray[np.float64], energy: NDArray[np.float64], motor: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The same of one motor in windows (K,): the same numbers, in a third of the time."""
    cross, part = matrix[:, :, motor], vector[:, motor]
    ridge = 1e-6 * np.add.reduce(matrix.diagonal(axis1=1, axis2=2), axis=1) + _TINY
    inverse = 1.0 / (cross[:, motor] + ridge)
    gain, coefficient = cross * inverse[:, None], inverse * part
    reduced, remaining = matrix - gain[:, :, None] * cross[:, None, :], vector - gain * part[:, None]
    reduced[:, motor] = 0.0
    reduced[:, :, motor] = 0.0
    remaining[:, motor] = 0.0
    return reduced, remaining, energy - part * coefficient, coefficient[:, None]
