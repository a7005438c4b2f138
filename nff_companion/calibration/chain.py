"""The residual's chain (core/residual.py) over a whole record at once, for many variants of the motors together.

What is measured and what the outputs should do pass the same filters as in flight; a test holds the two equal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, lfilter_zi, sosfiltfilt

from nff_companion.calibration.record import Piece
from nff_companion.core.filters import LowPass, lag_share

_FORGOTTEN_LAGS = 25.0  # e to that is beyond what a number can hold beside 1
_PARTS = 8


@dataclass(frozen=True, slots=True)
class Motors:
    """How outputs become thrust, of one variant: thrust fraction = (1 - e) c + e c^2, c = (output - idle) / (full -
    idle), ``delay_s`` after the output, with first-order lags."""

    delay_s: float
    lag_up_s: float
    lag_down_s: float
    expo: float
    idle: float
    full: float


@dataclass(frozen=True, slots=True)
class Filters:
    """Of the autopilot and of the residual."""

    gyro_hz: float
    accelerometer_hz: float
    smoothing_s: float


def fraction(output: NDArray[np.float64], motors: Motors) -> NDArray[np.float64]:
    """Thrust fraction of outputs, any shape."""
    c = np.clip((output - motors.idle) / (motors.full - motors.idle), 0.0, None)
    return c * ((1.0 - motors.expo) + motors.expo * c)


def shown(piece: Piece, variants: list[Motors], filters: Filters) -> NDArray[np.float64]:
    """Thrust fractions after the whole chain (V, N, m)."""
    commands = np.stack([fraction(_late(piece.output, v.delay_s / piece.dt_s), v) for v in variants])
    lagged = _lagged(commands, variants, piece.dt_s)
    filtered = _low_passed(lagged, LowPass.design(filters.gyro_hz, piece.dt_s))
    return _smoothed(_means(filtered), lag_share(piece.dt_s, filters.smoothing_s))


def measured(piece: Piece, filters: Filters, inertia: tuple[float, float, float]) -> NDArray[np.float64]:
    """Upward specific force and angular accelerations less Euler's part (N, 4), lateral specific force (2), body
    rates (3), velocity (3): (N, 12) after the chain. ``inertia`` of any scale."""
    rate = piece.gyro_rad_s
    middle = _means(rate[None])[0]
    turning = np.diff(rate, axis=0, prepend=rate[:1]) / piece.dt_s
    jx, jy, jz = inertia
    p, q, r = middle.T
    turning = turning + np.stack([q * r * (jz - jy) / jx, r * p * (jx - jz) / jy, p * q * (jy - jx) / jz], axis=1)
    force = piece.specific_force_m_s2
    up = -force[:, 2]
    if filters.gyro_hz and not filters.accelerometer_hz:
        up = _low_passed(up[None, :, None], LowPass.design(filters.gyro_hz, piece.dt_s))[0, :, 0]
    up = _means(up[None, :, None])[0, :, 0]
    columns = np.column_stack([up, turning, force[:, :2], middle, piece.velocity_m_s])
    return _smoothed(columns[None], lag_share(piece.dt_s, filters.smoothing_s))[0]


def smoothed_both_ways(values: NDArray[np.float64], dt_s: float, time_constant_s: float) -> NDArray[np.float64]:
    """Columns (N, c) through a first-order lag, forwards and backwards, so that nothing is late."""
    share = lag_share(dt_s, time_constant_s)
    ahead = _smoothed(values[None], share)
    return _smoothed(ahead[:, ::-1], share)[0, ::-1]


def band(values: NDArray[np.float64], dt_s: float, low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """``values`` (N,) between two frequencies, without delay."""
    high = min(high_hz, 0.4 / dt_s)
    sections = butter(2, [min(low_hz, 0.5 * high), high], "bandpass", fs=1.0 / dt_s, output="sos")
    return np.asarray(sosfiltfilt(sections, values))


def _late(output: NDArray[np.float64], samples: float) -> NDArray[np.float64]:
    """``output`` (N, m) so many samples later, linear between them."""
    whole = int(np.floor(samples))
    part = samples - whole

    def moved(k: int) -> NDArray[np.float64]:
        return output[np.clip(np.arange(len(output)) - k, 0, len(output) - 1)]

    return moved(whole) if part == 0.0 else (1.0 - part) * moved(whole) + part * moved(whole + 1)


def _means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each sample and the one before, along the second axis."""
    before = np.concatenate([values[:, :1], values[:, :-1]], axis=1)
    return 0.5 * (values + before)


def _smoothed(values: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """First-order lag along the second axis, from its first value."""
    out, _ = lfilter([share], [1.0, share - 1.0], values, axis=1, zi=(1.0 - share) * values[:, :1])
    return np.asarray(out)


def _lagged(commands: NDArray[np.float64], variants: list[Motors], dt_s: float) -> NDArray[np.float64]:
    """``commands`` (V, N, m) after the motors' lags."""
    up = np.array([lag_share(dt_s, v.lag_up_s) for v in variants])
    down = np.array([lag_share(dt_s, v.lag_down_s) for v in variants])
    driven = _means(commands)
    if (up == down).all():
        return np.stack([_smoothed(driven[k : k + 1], float(up[k]))[0] for k in range(len(up))])
    count, samples, motors = commands.shape
    series = np.ascontiguousarray(driven.transpose(1, 0, 2)).reshape(samples, count * motors)
    # The record in parts at once, each begun so long before that how it began is forgotten.
    before = round(_FORGOTTEN_LAGS * max(max(v.lag_up_s, v.lag_down_s) for v in variants) / dt_s) + 1
    before = min(before, samples)
    length = max(before, math.ceil(samples / _PARTS))
    begins = np.arange(0, samples, length)
    at = np.arange(-before, length)[:, None] + begins
    parts = series[np.clip(at, 0, samples - 1)]  # (before + length, parts, series)
    up_each, down_each = np.repeat(up, motors), np.repeat(down, motors)
    now, out = parts[0].copy(), np.empty((length, *parts.shape[1:]))
    for k, driven_to in enumerate(parts[1:], start=1):
        ahead = driven_to - now
        now = now + np.where(ahead > 0.0, up_each, down_each) * ahead
        if k >= before:
            out[k - before] = now
    whole = out.transpose(1, 0, 2).reshape(-1, count * motors)[:samples]
    return np.asarray(whole.reshape(samples, count, motors).transpose(1, 0, 2))


def _low_passed(values: NDArray[np.float64], low_pass: LowPass | None) -> NDArray[np.float64]:
    """Along the second axis, as if the first value had been there for ever."""
    if low_pass is None:
        return values
    b, a = low_pass.b * np.array([1.0, 2.0, 1.0]), np.array([1.0, low_pass.a1, low_pass.a2])
    start = lfilter_zi(b, a)[None, :, None] * values[:, :1]
    out, _ = lfilter(b, a, values, axis=1, zi=start)
    return np.asarray(out)
