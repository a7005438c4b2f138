"""Exact discretisations of the filters between a motor command and what the gyro shows. Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Signal = TypeVar("Signal", float, NDArray[np.float64])


def lag_share(dt_s: float, time_constant_s: float) -> float:
    """Share of the way that a first-order lag goes in ``dt_s`` towards a constant input."""
    return 1.0 if time_constant_s <= 0.0 else -math.expm1(-dt_s / time_constant_s)


@dataclass(frozen=True, slots=True)
class LowPass:
    """Second-order Butterworth low-pass (bilinear transform with pre-warping, as ArduPilot's LowPassFilter2p)."""

    b: float
    a1: float
    a2: float

    @staticmethod
    def design(cutoff_hz: float, dt_s: float) -> LowPass | None:
        """Coefficients for a sample time; None when there is no filter or it lies above 0.45 of the sample rate."""
        if cutoff_hz <= 0.0 or cutoff_hz * dt_s > 0.45:
            return None
        warped = math.tan(math.pi * cutoff_hz * dt_s)
        scale = 1.0 + math.sqrt(2.0) * warped + warped * warped
        return LowPass(
            warped * warped / scale,
            2.0 * (warped * warped - 1.0) / scale,
            (1.0 - math.sqrt(2.0) * warped + warped * warped) / scale,
        )

    def settled(self, value: Signal) -> tuple[Signal, Signal]:
        """State of a filter that has seen ``value`` for ever."""
        delayed = value / (1.0 + self.a1 + self.a2)
        return delayed, delayed

    def step(self, state: tuple[Signal, Signal], value: Signal) -> tuple[tuple[Signal, Signal], Signal]:
        """(new state, output) for one sample ``value``, a number or an array (width,) of parallel signals."""
        first, second = state
        new = value - self.a1 * first - self.a2 * second
        return (new, first), self.b * (new + 2.0 * first + second)


def loss_response(
    dt_s: float, samples: int, lag_s: float, low_pass: LowPass | None, smoothing_s: float
) -> NDArray[np.float64]:
    """How a sudden loss shows in the residual: response (samples,) of lag, low-pass, mean of two samples and
    smoothing to a unit step at sample 0; goes from 0 to 1."""
    share, smooth = lag_share(dt_s, lag_s), lag_share(dt_s, smoothing_s)
    out = np.zeros(samples)
    lag = before = filtered = 0.0
    state = (0.0, 0.0)
    for k in range(samples):
        # The sample before the loss is sample -1: the lag has moved for k + 1 periods, on average half of the first.
        lag += (0.5 if k == 0 else 1.0) * share * (1.0 - lag)
        value = lag
        if low_pass is not None:
            state, value = low_pass.step(state, lag)
        filtered += smooth * (0.5 * (value + before) - filtered)
        before = value
        out[k] = filtered
    return out
