"""Motor mixing that keeps roll and pitch over yaw, and attitude over thrust, when motors saturate.

After AP_MotorsMatrix::output_armed_stabilizing and Thrust_Linearization (Copter 4.7), without thrust boost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot.shaping import clip
from sitl.compiled import part

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


class Limits(NamedTuple):
    """Which demands could not be met in the last step."""

    roll_pitch: bool
    yaw: bool
    throttle_upper: bool
    throttle_lower: bool


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


@part
def _yaw_allowed(
    factors: NDArray[np.float64], demand: NDArray[np.float64], mean_max: float, dead: NDArray[np.bool_]
) -> float:
    """Most of yaw that leaves roll and pitch their room, at least the headroom."""
    allowed = 1.0
    for i in range(len(factors)):
        size = abs(factors[i, 3])
        if size > 1e-6 and not dead[i]:
            best = min(0.5, mean_max) + factors[i, 1] * demand[1] + factors[i, 2] * demand[2]
            room = 1.0 - best if demand[3] * factors[i, 3] > 0.0 else best
            allowed = min(allowed, max(room, 0.0) / size)
    return max(allowed, YAW_HEADROOM)


@part
def mix(
    factors: NDArray[np.float64],
    demand: NDArray[np.float64],
    throttle_mean_max: float,
    dead: NDArray[np.bool_],
    thrust: NDArray[np.float64],
) -> Limits:
    """Motor thrusts into ``thrust`` (m,), 0..1, for ``demand`` (4,) = throttle 0..1, roll, pitch, yaw -1..1.

    ``factors`` (m, 4); ``dead`` (m,) marks motors that take no part in the limits (declared failed).
    """
    throttle = clip(demand[0], 0.0, 1.0)
    mean_max = clip(throttle_mean_max, throttle, 1.0)
    allowed = _yaw_allowed(factors, demand, mean_max, dead)
    yaw = clip(demand[3], -allowed, allowed)
    low, high = math.inf, -math.inf
    for i in range(len(factors)):
        attitude = factors[i, 1] * demand[1] + factors[i, 2] * demand[2] + yaw * factors[i, 3]
        thrust[i] = attitude
        if not dead[i]:
            low, high = min(low, attitude), max(high, attitude)
    span = high - low
    scale = 1.0 / span if span > 1.0 else 1.0
    if mean_max + low < 0.0:
        scale = min(scale, -mean_max / low)
    high, low = high * scale, low * scale
    floor = -low
    adjust = throttle - floor
    scaled = scale < 1.0
    ceiling = 1.0 - (floor + high)
    upper = adjust > 0.0 if scaled else adjust > ceiling
    adjust = 0.0 if scaled else clip(adjust, 0.0, max(ceiling, 0.0))
    for i in range(len(factors)):
        thrust[i] = clip((floor + adjust) * factors[i, 0] + scale * thrust[i], 0.0, 1.0)
    return Limits(scaled, scaled or abs(demand[3]) > allowed, upper, demand[0] <= 0.0)


def thrust_to_output(thrust: Any, expo: float, spin_min: float, spin_max: float) -> Any:
    """Actuator output 0..1 for a thrust 0..1, number or array: the inverse of the motor's curve, above idle."""
    root = np.sqrt((1.0 - expo) ** 2 + 4.0 * expo * thrust)
    ratio = thrust if expo == 0.0 else (root - (1.0 - expo)) / (2.0 * expo)
    return spin_min + (spin_max - spin_min) * ratio


compiled_thrust_to_output = part(thrust_to_output)


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
