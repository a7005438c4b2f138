"""Square-root controller and the proportional-integral-derivative block with ArduPilot's filters, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sitl.compiled import part
from sitl.records import Record


@part
def clip(value: float, low: float, high: float) -> float:
    """``value`` within bounds; what is not a number stays."""
    return low if value < low else high if value > high else value


@part
def square_root_controller(error: float, gain: float, limit: float, dt_s: float) -> float:
    """Rate for an error: linear near zero, then the speed from which ``limit`` still stops in time."""
    linear = limit / (gain * gain)
    size = abs(error)
    speed = gain * size if size <= linear else math.sqrt(max(2.0 * limit * (size - 0.5 * linear), 0.0))
    return math.copysign(min(speed, size / dt_s), error)


@part
def limit_length(x: float, y: float, limit: float) -> tuple[float, float]:
    """Shorten a vector to at most ``limit``."""
    scale = min(1.0, limit / max(math.sqrt(x * x + y * y), 1e-9))
    return scale * x, scale * y


@part
def filter_share(cutoff_hz: float, dt_s: float) -> float:
    """Share of a new sample in a first-order low-pass; 1 without a filter."""
    if cutoff_hz <= 0.0:
        return 1.0
    return dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff_hz))


class Gains(NamedTuple):
    """One PID; filters in Hz, 0: none."""

    p: float
    i: float
    d: float
    integral_limit: float
    target_hz: float = 0.0
    error_hz: float = 0.0
    derivative_hz: float = 20.0


PID = np.dtype([("integral", "f8"), ("target", "f8"), ("error", "f8"), ("derivative", "f8")])


@part
def reset(loop: Record) -> None:
    """Zero the state, a record PID."""
    loop.integral = loop.target = loop.error = loop.derivative = 0.0


@part
def pid(gains: Gains, loop: Record, target: float, measured: float, limited: bool, dt_s: float) -> float:
    """Output; ``limited``: the actuator could not follow the last one, and the integrator does not grow.

    ``loop``: a record PID.
    """
    loop.target += filter_share(gains.target_hz, dt_s) * (target - loop.target)
    error = loop.error + filter_share(gains.error_hz, dt_s) * (loop.target - measured - loop.error)
    slope = (error - loop.error) / dt_s
    loop.derivative += filter_share(gains.derivative_hz, dt_s) * (slope - loop.derivative)
    loop.error = error
    grown = clip(loop.integral + gains.i * error * dt_s, -gains.integral_limit, gains.integral_limit)
    if not (limited and abs(grown) > abs(loop.integral)):
        loop.integral = grown
    return gains.p * error + loop.integral + gains.d * loop.derivative
