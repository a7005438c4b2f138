"""Quaternions (w, x, y, z), body to NED: as tuples in what is compiled, over arrays (..., 4) for all others."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import part

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Rows: TypeAlias = tuple[Vector, Vector, Vector]
_TINY = 1e-300  # no square of an angle is smaller, but that of none


# -- of numbers or of arrays ------------------------------------------------------------------------------------------


def _matrix(w: Any, x: Any, y: Any, z: Any) -> Any:
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _yaw(w: Any, x: Any, y: Any, z: Any) -> Any:
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _tilt(x: Any, y: Any) -> Any:
    return np.arccos(np.minimum(np.maximum(1 - 2 * (x * x + y * y), -1.0), 1.0))


def to_matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3), body to NED, of unit quaternions."""
    rows = _matrix(q[..., 0], q[..., 1], q[..., 2], q[..., 3])
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_yaw(yaw_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Level, heading ``yaw_rad``."""
    out = np.zeros((*np.shape(yaw_rad), 4))
    out[..., 0] = np.cos(0.5 * yaw_rad)
    out[..., 3] = np.sin(0.5 * yaw_rad)
    return out


def yaw_of(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heading in rad."""
    return np.asarray(_yaw(q[..., 0], q[..., 1], q[..., 2], q[..., 3]))


def tilt_of(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle in rad between the body's and the world's vertical."""
    return np.asarray(_tilt(q[..., 1], q[..., 2]))


# -- compiled: of one vehicle -----------------------------------------------------------------------------------------

_compiled_matrix = part(_matrix)
_compiled_yaw = part(_yaw)
_compiled_tilt = part(_tilt)


@part
def components(v: NDArray[np.float64]) -> Vector:
    """Of an array (3,)."""
    return v[0], v[1], v[2]


@part
def vector(array: NDArray[np.float64], n: int) -> Vector:
    """Row ``n`` of (N, 3)."""
    return array[n, 0], array[n, 1], array[n, 2]


@part
def quaternion(array: NDArray[np.float64], n: int) -> Quaternion:
    """Row ``n`` of (N, 4)."""
    return array[n, 0], array[n, 1], array[n, 2], array[n, 3]


@part
def put(array: NDArray[np.float64], n: int, v: Vector) -> None:
    """Into row ``n`` of (N, 3)."""
    array[n, 0], array[n, 1], array[n, 2] = v


@part
def put_quaternion(array: NDArray[np.float64], n: int, q: Quaternion) -> None:
    """Into row ``n`` of (N, 4)."""
    array[n, 0], array[n, 1], array[n, 2], array[n, 3] = q


@part
def add_scaled(a: Vector, factor: float, b: Vector) -> Vector:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@part
def scaled(factor: float, v: Vector) -> Vector:
    """factor v."""
    return factor * v[0], factor * v[1], factor * v[2]


@part
def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part
def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part
def matrix(q: Quaternion) -> Rows:
    """Rows of the rotation matrix, body to NED, of a unit quaternion."""
    return _compiled_matrix(q[0], q[1], q[2], q[3])


@part
def to_ned(rows: Rows, v: Vector) -> Vector:
    """A body vector in NED."""
    return dot(rows[0], v), dot(rows[1], v), dot(rows[2], v)


@part
def to_body(rows: Rows, v: Vector) -> Vector:
    """A NED vector in the body."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return a * v[0] + d * v[1] + g * v[2], b * v[0] + e * v[1] + h * v[2], c * v[0] + f * v[1] + i * v[2]


@part
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Quaternion product a b."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@part
def conjugate(q: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


@part
def normalise(q: Quaternion) -> Quaternion:
    """To unit length."""
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


@part
def from_rotation_vector(v: Vector) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    angle = math.sqrt(max(dot(v, v), _TINY))
    scale = math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), scale * v[0], scale * v[1], scale * v[2]


@part
def turned(q: Quaternion, v: Vector) -> Quaternion:
    """``q``, then a rotation vector in the body, rad; of unit length."""
    return normalise(multiply(q, from_rotation_vector(v)))


@part
def level(yaw_rad: float) -> Quaternion:
    """Level, heading ``yaw_rad``."""
    return math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad)


@part
def yaw(q: Quaternion) -> float:
    """Heading in rad."""
    return _compiled_yaw(q[0], q[1], q[2], q[3])


@part
def tilt(q: Quaternion) -> float:
    """Angle in rad between the body's and the world's vertical."""
    return _compiled_tilt(q[1], q[2])


@part
def swing_and_twist(q: Quaternion) -> Vector:
    """Error vector: swing of the z axis (x, y) and twist about it (z), in rad, of q = swing * twist."""
    if q[0] < 0.0:
        q = -q[0], -q[1], -q[2], -q[3]
    norm = math.hypot(q[0], q[3])
    c, s = 1.0, 0.0  # the twist's inverse; upside down no twist can be told
    if norm > 1e-9:
        c, s = q[0] / norm, -q[3] / norm
    swing = multiply(q, (c, 0.0, 0.0, s))
    sine = math.hypot(swing[1], swing[2])
    scale = 2.0
    if sine > 1e-9:
        scale = 2.0 * math.atan2(sine, swing[0]) / sine
    return scale * swing[1], scale * swing[2], -2.0 * math.atan2(s, c)
