"""Quaternions (w, x, y, z), body to NED, over arrays (..., 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def _table(shape: tuple[int, ...], entries: dict[tuple[int, ...], float]) -> NDArray[np.float64]:
    """Coefficients of a bilinear form: ``shape`` is (left, right, out); flat over the first two."""
    table = np.zeros(shape)
    for place, value in entries.items():
        table[place] = value
    return table.reshape(shape[0] * shape[1], shape[2])


# Products of small vectors as one outer product and one product with a constant matrix: a tenth of the calls.
_W, _X, _Y, _Z = range(4)
_PRODUCT = _table(
    (4, 4, 4),
    {
        **{(_W, _W, _W): 1.0, (_X, _X, _W): -1.0, (_Y, _Y, _W): -1.0, (_Z, _Z, _W): -1.0},
        **{(_W, _X, _X): 1.0, (_X, _W, _X): 1.0, (_Y, _Z, _X): 1.0, (_Z, _Y, _X): -1.0},
        **{(_W, _Y, _Y): 1.0, (_X, _Z, _Y): -1.0, (_Y, _W, _Y): 1.0, (_Z, _X, _Y): 1.0},
        **{(_W, _Z, _Z): 1.0, (_X, _Y, _Z): 1.0, (_Y, _X, _Z): -1.0, (_Z, _W, _Z): 1.0},
    },
)
_MATRIX = _table(
    (4, 4, 9),
    {
        **{
            (_Y, _Y, 0): -2.0,
            (_Z, _Z, 0): -2.0,
            (_X, _Y, 1): 2.0,
            (_W, _Z, 1): -2.0,
            (_X, _Z, 2): 2.0,
            (_W, _Y, 2): 2.0,
        },
        **{
            (_X, _Y, 3): 2.0,
            (_W, _Z, 3): 2.0,
            (_X, _X, 4): -2.0,
            (_Z, _Z, 4): -2.0,
            (_Y, _Z, 5): 2.0,
            (_W, _X, 5): -2.0,
        },
        **{
            (_X, _Z, 6): 2.0,
            (_W, _Y, 6): -2.0,
            (_Y, _Z, 7): 2.0,
            (_W, _X, 7): 2.0,
            (_X, _X, 8): -2.0,
            (_Y, _Y, 8): -2.0,
        },
    },
)
_CROSS = _table(
    (3, 3, 3),
    {(1, 2, 0): 1.0, (2, 1, 0): -1.0, (2, 0, 1): 1.0, (0, 2, 1): -1.0, (0, 1, 2): 1.0, (1, 0, 2): -1.0},
)
_IDENTITY = np.eye(3).reshape(9)
_TINY = 1e-300  # no square of an angle is smaller, but that of none


def _bilinear(a: NDArray[np.float64], b: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The form ``table`` of each pair of vectors (..., k)."""
    outer = a[..., :, None] * b[..., None, :]
    product: NDArray[np.float64] = outer.reshape(*outer.shape[:-2], len(table)) @ table
    return product


def multiply(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion product a b."""
    return _bilinear(a, b, _PRODUCT)


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def conjugate(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a unit quaternion."""
    return q * _CONJUGATE


def normalise(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """To unit length."""
    return q / np.sqrt(np.vecdot(q, q))[..., None]


def to_matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3), body to NED, of unit quaternions."""
    return (_bilinear(q, q, _MATRIX) + _IDENTITY).reshape(*q.shape[:-1], 3, 3)


def from_rotation_vector(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion of a rotation vector (..., 3), rad."""
    angle = np.sqrt(np.maximum(np.vecdot(v, v), _TINY))
    half = 0.5 * angle
    out = np.empty((*v.shape[:-1], 4))
    out[..., 0] = np.cos(half)
    out[..., 1:] = (np.sin(half) / angle)[..., None] * v
    return out


def from_yaw(yaw_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level, heading ``yaw_rad``."""
    out = np.zeros((*np.shape(yaw_rad), 4))
    out[..., 0] = np.cos(0.5 * yaw_rad)
    out[..., 3] = np.sin(0.5 * yaw_rad)
    return out


def yaw_of(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heading in rad."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def tilt_of(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle in rad between the body's and the world's vertical."""
    return np.arccos(np.clip(1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2), -1.0, 1.0))


def cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cross product over (..., 3); numpy's own takes ten times as long for small arrays."""
    return _bilinear(a, b, _CROSS)


def swing_and_twist(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Error vector (..., 3): swing of the z axis (x, y) and twist about it (z), in rad, of q = swing * twist."""
    q = np.where(q[..., :1] < 0, -q, q)
    w, z = q[..., 0], q[..., 3]
    norm = np.hypot(w, z)
    upside_down = norm <= 1e-9  # no twist can be told
    untwist = np.zeros_like(q)  # the twist's inverse
    untwist[..., 0] = np.where(upside_down, 1.0, w / np.maximum(norm, 1e-9))
    untwist[..., 3] = np.where(upside_down, 0.0, -z / np.maximum(norm, 1e-9))
    swing = multiply(q, untwist)
    sine = np.hypot(swing[..., 1], swing[..., 2])
    angle = 2 * np.arctan2(sine, swing[..., 0])
    out = np.empty((*q.shape[:-1], 3))
    out[..., :2] = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)[..., None] * swing[..., 1:3]
    out[..., 2] = -2 * np.arctan2(untwist[..., 3], untwist[..., 0])
    return out
