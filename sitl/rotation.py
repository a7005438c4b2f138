"""Quaternions (w, x, y, z), body to NED, over arrays (..., 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def multiply(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion product a b."""
    aw, ax, ay, az = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bw, bx, by, bz = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def conjugate(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a unit quaternion."""
    return q * _CONJUGATE


def normalise(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """To unit length."""
    return q / np.sqrt(np.einsum("...i,...i->...", q, q))[..., None]


def to_matrix(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices (..., 3, 3), body to NED."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def from_rotation_vector(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion of a rotation vector (..., 3), rad."""
    angle = np.sqrt(np.einsum("...i,...i->...", v, v))
    half = 0.5 * angle
    scale = np.where(angle > 1e-9, np.sin(half) / np.where(angle > 1e-9, angle, 1.0), 0.5)
    return np.concatenate([np.cos(half)[..., None], scale[..., None] * v], axis=-1)


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
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def swing_and_twist(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Error vector (..., 3): swing of the z axis (x, y) and twist about it (z), in rad, of q = swing * twist."""
    q = np.where(q[..., :1] < 0, -q, q)
    w, z = q[..., 0], q[..., 3]
    norm = np.sqrt(w * w + z * z)
    safe = np.where(norm > 1e-9, norm, 1.0)
    twist = np.zeros_like(q)
    twist[..., 0] = np.where(norm > 1e-9, w / safe, 1.0)
    twist[..., 3] = np.where(norm > 1e-9, z / safe, 0.0)
    swing = multiply(q, conjugate(twist))
    sine = np.hypot(swing[..., 1], swing[..., 2])
    angle = 2 * np.arctan2(sine, swing[..., 0])
    scale = np.where(sine > 1e-9, angle / np.where(sine > 1e-9, sine, 1.0), 2.0)
    return np.stack(
        [scale * swing[..., 1], scale * swing[..., 2], 2 * np.arctan2(twist[..., 3], twist[..., 0])], axis=-1
    )
