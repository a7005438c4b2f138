"""Motor mixing that keeps roll and pitch over yaw, and attitude over thrust, when motors saturate.

After AP_MotorsMatrix::output_armed_stabilizing and Thrust_Linearization (Copter 4.7), without thrust boost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot.shaping import clip

YAW_HEADROOM = 0.2  # MOT_YAW_HEADROOM


def stock_factors(position_m: NDArray[np.float64], spin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Factors (m, 4) of throttle, roll, pitch, yaw, scaled so that the largest of each attitude axis is 0.5."""
    x, y = position_m[:, 0], position_m[:, 1]
    factors = np.stack([np.ones_like(x), -y, x, spin], axis=1)
    return factors * np.array([1.0, 0.5 / np.abs(y).max(), 0.5 / np.abs(x).max(), 0.5])


def normalised_effectiveness(position_m: NDArray[np.float64], spin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows of thrust, roll, pitch, yaw (4, m), each over the sum of its positive entries.

    This is the unit of a matrix that comes over the link: 1 is all that the motors could give on that axis.
    """
    x, y = position_m[:, 0], position_m[:, 1]
    return normalised(np.stack([np.ones_like(x), -y, x, spin]))


def normalised(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """``rows`` (4, m), each over the sum of its positive entries."""
    return rows / np.maximum(rows, 0.0).sum(axis=1, keepdims=True)


@dataclass(slots=True)
class Limits:
    """Which demands could not be met in the last step, (N,) each."""

    roll_pitch: NDArray[np.bool_]
    yaw: NDArray[np.bool_]
    throttle_upper: NDArray[np.bool_]
    throttle_lower: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Mixed:
    """Of one vehicle: outputs (m,) in 0..1, and which torques (3,), or thrust, could not be met."""

    output: NDArray[np.float64]
    torque_limited: NDArray[np.bool_]
    throttle_limited: bool


class OwnMixer(Protocol):
    """In place of the mixer below, for one vehicle."""

    def mix(self, throttle: float, torque: NDArray[np.float64], *, armed: bool, now_s: float) -> Mixed:
        """``throttle`` 0..1 and ``torque`` (3,) -1..1 as the loops ask for them."""


def mix(
    factors: NDArray[np.float64],
    demand: NDArray[np.float64],
    throttle_mean_max: NDArray[np.float64],
    dead: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], Limits]:
    """Motor thrusts (N, m) in 0..1 for ``demand`` (N, 4) = throttle 0..1, roll, pitch, yaw -1..1.

    ``factors`` (N, m, 4); ``dead`` (N, m) marks motors that take no part in the limits (declared failed).
    """
    throttle = clip(demand[:, 0], 0.0, 1.0)
    mean_max = clip(throttle_mean_max, throttle, 1.0)
    roll_pitch = np.matvec(factors[:, :, 1:3], demand[:, 1:3])
    best = np.minimum(0.5, mean_max)[:, None] + roll_pitch
    yaw_factor = factors[:, :, 3]
    upward = demand[:, 3:4] * yaw_factor > 0.0
    room = np.maximum(np.where(upward, 1.0 - best, best), 0.0)
    size = np.abs(yaw_factor)
    counts = (size > 1e-6) & ~dead
    allowed = np.where(counts, room / np.where(counts, size, 1.0), 1.0).min(axis=1)
    allowed = np.maximum(np.minimum(allowed, 1.0), YAW_HEADROOM)
    yaw = clip(demand[:, 3], -allowed, allowed)
    yaw_limited = np.abs(demand[:, 3]) > allowed

    attitude = roll_pitch + yaw[:, None] * yaw_factor
    low = np.where(dead, np.inf, attitude).min(axis=1)
    high = np.where(dead, -np.inf, attitude).max(axis=1)
    span = high - low
    scale = np.where(span > 1.0, 1.0 / np.maximum(span, 1e-9), 1.0)
    short = mean_max + low < 0.0
    scale = np.where(short, np.minimum(scale, -mean_max / np.where(short, low, -1.0)), scale)
    high, low = high * scale, low * scale
    floor = -low
    adjust = throttle - floor
    scaled = scale < 1.0
    ceiling = 1.0 - (floor + high)
    upper = np.where(scaled, adjust > 0.0, adjust > ceiling)
    adjust = np.where(scaled, 0.0, clip(adjust, 0.0, np.maximum(ceiling, 0.0)))
    thrust = (floor + adjust)[:, None] * factors[:, :, 0] + scale[:, None] * attitude
    limits = Limits(
        roll_pitch=scaled, yaw=scaled | yaw_limited, throttle_upper=upper, throttle_lower=demand[:, 0] <= 0.0
    )
    return clip(thrust, 0.0, 1.0), limits


def thrust_to_output(thrust: NDArray[np.float64], expo: float, spin_min: float, spin_max: float) -> NDArray[np.float64]:
    """Actuator output 0..1 for a thrust 0..1: the inverse of the motor's curve, above the idle speed."""
    root = np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust)
    ratio = thrust if expo == 0.0 else (root - (1.0 - expo)) / (2.0 * expo)
    return spin_min + (spin_max - spin_min) * ratio


def reduced_factors(
    position_m: NDArray[np.float64], spin: NDArray[np.float64], failed: NDArray[np.bool_]
) -> NDArray[np.float64] | None:
    """Stock factors for the motors left, by pseudo-inverse, in the stock's units; None where they cannot balance.

    What the autopilot holds on its own after the link to the companion is lost with a confirmed declaration.
    """
    stock = stock_factors(position_m, spin)
    x, y = position_m[:, 0], position_m[:, 1]
    rows = np.stack([np.ones_like(x), -y, x, spin])
    gain = rows @ stock
    left = rows * ~failed
    if np.linalg.matrix_rank(left, tol=1e-6) < 4:
        return None
    factors = np.linalg.pinv(left) @ np.diag(np.diag(gain))
    factors[failed] = 0.0
    # A negative share of the collective cannot be flown.
    return factors if (factors[~failed, 0] > 0.02).all() else None
