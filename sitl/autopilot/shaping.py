"""Square-root controller and the proportional-integral-derivative block with ArduPilot's filters, over arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bound = NDArray[np.float64] | float


def clip(value: NDArray[np.float64], low: Bound, high: Bound) -> NDArray[np.float64]:
    """``value`` within bounds; numpy's own takes twice as long for small arrays."""
    return np.minimum(np.maximum(value, low), high)


def square_root_controller(error: NDArray[np.float64], gain: float, limit: Bound, dt_s: float) -> NDArray[np.float64]:
    """Rate for an error: linear near zero, then the speed from which ``limit`` still stops in time."""
    linear = limit / gain**2
    size = np.abs(error)
    far = np.sqrt(np.maximum(2.0 * limit * (size - 0.5 * linear), 0.0))
    speed = np.where(size <= linear, gain * size, far)
    return np.copysign(np.minimum(speed, size / dt_s), error)


def limit_length(vector: NDArray[np.float64], limit: Bound) -> NDArray[np.float64]:
    """Shorten the vectors (N, k) to at most ``limit``."""
    length = np.sqrt(np.vecdot(vector, vector))
    scale = np.minimum(1.0, limit / np.maximum(length, 1e-9))
    return vector * scale[:, None]


def filter_share(cutoff_hz: float, dt_s: float) -> float:
    """Share of a new sample in a first-order low-pass; 1 without a filter."""
    if cutoff_hz <= 0.0:
        return 1.0
    return dt_s / (dt_s + 1.0 / (2.0 * math.pi * cutoff_hz))


@dataclass(frozen=True, kw_only=True)
class Gains:
    """One PID; filters in Hz, 0: none."""

    p: float
    i: float
    d: float
    integral_limit: float
    target_hz: float = 0.0
    error_hz: float = 0.0
    derivative_hz: float = 20.0


class Pid:
    """N x k loops in one object; the integrator does not grow while its output is limited."""

    def __init__(self, gains: list[Gains], vehicles: int, dt_s: float) -> None:
        def row(name: str) -> NDArray[np.float64]:
            return np.array([getattr(g, name) for g in gains], float)

        self.p, self.i, self.d, self.limit = row("p"), row("i"), row("d"), row("integral_limit")
        self._target_share = np.array([filter_share(g.target_hz, dt_s) for g in gains])
        self._error_share = np.array([filter_share(g.error_hz, dt_s) for g in gains])
        self._derivative_share = np.array([filter_share(g.derivative_hz, dt_s) for g in gains])
        self._dt = dt_s
        shape = (vehicles, len(gains))
        self.integral, self._target = np.zeros(shape), np.zeros(shape)
        self._error, self._derivative = np.zeros(shape), np.zeros(shape)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Zero the state of the vehicles in ``mask`` (N,)."""
        for array in (self.integral, self._target, self._error, self._derivative):
            array[mask] = 0.0

    def step(
        self, target: NDArray[np.float64], measured: NDArray[np.float64], limited: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Output (N, k); ``limited`` (N, k) is true where the actuator could not follow the last output."""
        self._target = self._target + self._target_share * (target - self._target)
        error = self._error + self._error_share * (self._target - measured - self._error)
        slope = (error - self._error) / self._dt
        self._derivative = self._derivative + self._derivative_share * (slope - self._derivative)
        self._error = error
        grown = clip(self.integral + self.i * error * self._dt, -self.limit, self.limit)
        outward = limited & (np.abs(grown) > np.abs(self.integral))
        self.integral = np.where(outward, self.integral, grown)
        return self.p * error + self.integral + self.d * self._derivative
