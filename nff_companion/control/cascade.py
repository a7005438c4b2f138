"""The arithmetic of the control law, in plain numbers: for three axes arrays cost more than what is computed.

Vectors are tuples; world axes NED, body axes FRD, SI units.
"""

from __future__ import annotations

import math

from nff_companion.core.filters import lag_share

Vector = tuple[float, float, float]
Axes = tuple[Vector, Vector, Vector]

NOUGHT: Vector = (0.0, 0.0, 0.0)


def clip(value: float, limit: float) -> float:
    """Within +-``limit``."""
    return value if -limit <= value <= limit else min(max(value, -limit), limit)


def scaled(a: Vector, k: float) -> Vector:
    """k a."""
    return a[0] * k, a[1] * k, a[2] * k


def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def followed(before: Vector, now: Vector, dt_s: float, time_constant_s: float) -> Vector:
    """``before`` a sample later, smoothed towards ``now``."""
    share = lag_share(dt_s, time_constant_s)
    x, y, z = before
    return x + share * (now[0] - x), y + share * (now[1] - y), z + share * (now[2] - z)


def axes_of(w: float, x: float, y: float, z: float) -> Axes:
    """The body's axes in NED (columns of the rotation matrix) of a unit quaternion, body to NED."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def axes_along(push: Vector, yaw_rad: float) -> Axes:
    """The body's axes in NED that have the thrust along ``push`` (not horizontal) and the nose towards ``yaw_rad``."""
    down = scaled(push, -1.0 / math.sqrt(dot(push, push)))
    # right = down x heading
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    right = (-down[2] * sine, down[2] * cosine, down[0] * sine - down[1] * cosine)
    right = scaled(right, 1.0 / math.sqrt(dot(right, right)))
    return cross(right, down), right, down


def attitude_error(body: Axes, desired: Axes) -> Vector:
    """Rotation vector in the body frame, rad, from the ``body`` axes to the ``desired`` ones."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = body
    (dx, dy, dz), (ex, ey, ez), (fx, fy, fz) = desired
    # Half the sum of the cross products of each axis with where it should be: the sine of the angle, along the axis.
    x = 0.5 * (ay * dz - az * dy + by * ez - bz * ey + cy * fz - cz * fy)
    y = 0.5 * (az * dx - ax * dz + bz * ex - bx * ez + cz * fx - cx * fz)
    z = 0.5 * (ax * dy - ay * dx + bx * ey - by * ex + cx * fy - cy * fx)
    trace = ax * dx + ay * dy + az * dz + bx * ex + by * ey + bz * ez + cx * fx + cy * fy + cz * fz
    sine = math.sqrt(x * x + y * y + z * z)
    scale = math.atan2(sine, 0.5 * (trace - 1.0)) / sine if sine > 1e-9 else 1.0
    return (
        scale * (ax * x + ay * y + az * z),
        scale * (bx * x + by * y + bz * z),
        scale * (cx * x + cy * y + cz * z),
    )


def within_tilt(push: Vector, tangent: float, vertical_max: float) -> Vector:
    """Specific force (3,) NED whose vertical part (down) is at most ``vertical_max`` < 0, whatever was asked for; the
    horizontal part is cut to the largest tilt, given by its ``tangent``."""
    north, east, vertical = push
    vertical = min(vertical, vertical_max)
    lateral = math.hypot(north, east)
    lateral_max = -vertical * tangent
    if lateral > lateral_max:
        north, east = north * lateral_max / lateral, east * lateral_max / lateral
    return north, east, vertical


def gyroscopic(rate: Vector, inertia: Vector) -> Vector:
    """Torque w x J w of a body with principal ``inertia`` that turns at ``rate``."""
    return cross(rate, (inertia[0] * rate[0], inertia[1] * rate[1], inertia[2] * rate[2]))
