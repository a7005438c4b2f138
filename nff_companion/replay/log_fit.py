"""What a log itself says of the vehicle: the thrust fraction that carries it, and how it turns by its motors.

Angular acceleration against the torque that the outputs ask for, in windows of the first part of the flight and
between two frequencies, where wind and trim are not: per axis the gain over the model's, and how much it explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from nff_companion.core.vehicle import GRAVITY_M_S2, Vehicle
from nff_companion.replay.flight import Row
from nff_companion.replay.table import Table

Array = NDArray[np.float64]
_GRID_HZ = 100.0
_WINDOW_S, _WINDOWS_MIN = 2.0, 3  # half of each is the next one's too
_BAND_HZ = (2.0, 15.0)  # below it wind and trim, above it vibration
_NYQUIST_SHARE = 0.4  # of the rate of the samples
_RATE_MIN_HZ = 20.0  # of samples and of outputs: with less the band holds nothing but what lies beyond it
_PART, _PART_LEAST_S, _PART_MOST_S = 0.2, 5.0, 120.0  # of the flight that is looked at, from its beginning
_LAGS_S = (0.005, 0.015, 0.03, 0.045, 0.065, 0.09, 0.12)  # where the search begins: between neighbours of the best
_LAG_TOLERANCE_S = 5e-4
# It flies where thrust over specific force, smoothed, has come near to what it is in the next seconds, and more is
# asked for than idling: a share of what is usual among what is no small part of the largest.
_RISEN, _RISING_S, _SMOOTH_S, _IDLE = 0.9, 1.5, 0.7, 0.35
_LARGEST, _SMALL = 90.0, 0.3  # per cent of the samples in which anything is asked for; share
_CARRIED = (0.3, 3.0)  # specific force over g of a vehicle that is carried by its motors
_LEAST_FLYING_S = 2.5


@dataclass(frozen=True)
class Motion:
    """The first part of the flight on a regular grid of ``rate_hz``: windows (W, L) of it."""

    turning: Array  # (W, L, 3) angular acceleration, rad/s^2
    thrust: Array  # (W, L, m) fractions asked for
    rate_hz: float
    band_hz: tuple[float, float]
    hover: float  # thrust fraction
    peak: float  # largest thrust fraction of any motor in flight
    fast: bool  # samples and outputs come often enough to see how it turns


@dataclass(frozen=True)
class Fit:
    """Of roll, pitch and yaw, (3,): ``gain`` over the model's, ``explained`` share of the power in the band with it,
    0 where the gain is negative; ``lag_s`` the motors' lag that explains most."""

    gain: Array
    explained: Array
    lag_s: float


def motion_of(rows: Sequence[Row], vehicle: Vehicle, outputs_hz: float) -> Motion | None:
    """None: too little of the flight is whole."""
    if len(rows) < 2:
        return None
    time_s, thrust, measured, armed = _columns(rows, vehicle)
    keep = np.concatenate([[True], np.diff(np.maximum.accumulate(time_s)) > 0.0])
    time_s, thrust, measured, armed = time_s[keep], thrust[keep], measured[keep], armed[keep]
    whole = armed & np.isfinite(np.hstack([thrust, measured])).all(axis=1)
    thrust, measured = (np.nan_to_num(table, posinf=0.0, neginf=0.0) for table in (thrust, measured))
    gyro, force_up = measured[:, :3], measured[:, 3]
    mean = np.where(whole, thrust.mean(axis=1), 0.0)
    step_s = float(np.median(np.diff(time_s)))
    if not (mean > 0.0).any():
        return None
    idle = _IDLE * float(np.median(mean[mean > _SMALL * np.percentile(mean[mean > 0.0], _LARGEST)]))
    flying = whole & (mean > idle)
    flying[: _take_off(mean, force_up, idle, step_s)] = False
    flown_s = np.cumsum(flying) * step_s
    flying &= flown_s <= min(max(_PART * float(flown_s[-1]), _PART_LEAST_S), _PART_MOST_S)
    carried = flying & (force_up > _CARRIED[0] * GRAVITY_M_S2) & (force_up < _CARRIED[1] * GRAVITY_M_S2)
    if carried.sum() * step_s < _LEAST_FLYING_S:
        return None
    rate_hz = min(_GRID_HZ, 1.0 / step_s)
    band = (_BAND_HZ[0], min(_BAND_HZ[1], _NYQUIST_SHARE / step_s, 0.5 * outputs_hz))
    turning, driven = _windows(time_s, gyro, thrust, flying, rate_hz)
    return Motion(
        turning=turning,
        thrust=driven,
        rate_hz=rate_hz,
        band_hz=band,
        hover=GRAVITY_M_S2 * float(np.median(mean[carried] / force_up[carried])),
        peak=float(np.percentile(thrust[flying].max(axis=1), 99.5)),
        fast=bool(min(outputs_hz, 1.0 / step_s) >= _RATE_MIN_HZ),
    )


def _columns(rows: Sequence[Row], vehicle: Vehicle) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Times (N,), thrust fractions (N, m), rates and upward specific force (N, 4), whether it is armed (N,)."""
    if isinstance(rows, Table):
        thrust = vehicle.thrust_fraction(rows.output) if rows.thrust is None else rows.thrust
        measured = np.hstack([rows.gyro_rad_s, -rows.specific_force_m_s2[:, 2:]])
        return rows.time_s, thrust, measured, rows.armed
    samples = [sample for _, sample in rows]
    if all(s.thrust is None for s in samples):
        thrust = vehicle.thrust_fraction(np.array([s.output for s in samples]))
    else:
        thrust = np.array([vehicle.thrust_fraction(s.output) if s.thrust is None else s.thrust for s in samples])
    measured = np.array([(*s.gyro_rad_s.tolist(), -float(s.specific_force_m_s2[2])) for s in samples])
    return np.array([s.time_s for s in samples]), thrust, measured, np.array([s.armed for s in samples])


def _take_off(mean: Array, force_up: Array, idle: float, step_s: float) -> int:
    """Index from which on the vehicle is carried, by its mean thrust (N,) and its specific force (N,); N: never."""
    smooth_n, rising_n = max(round(_SMOOTH_S / step_s), 1), max(round(_RISING_S / step_s), 1)
    if len(mean) <= smooth_n + rising_n:
        return len(mean)
    box = np.full(smooth_n, 1.0 / smooth_n)
    thrust, force = (np.convolve(values, box, mode="valid") for values in (mean, force_up))
    slow = thrust / np.maximum(force, _CARRIED[0] * GRAVITY_M_S2)
    ahead = np.lib.stride_tricks.sliding_window_view(slow, rising_n).max(axis=1)
    begun = np.flatnonzero((slow[: len(ahead)] >= _RISEN * ahead) & (thrust[: len(ahead)] > idle))
    return int(begun[0]) if len(begun) else len(mean)


def _windows(
    time_s: Array, gyro: Array, thrust: Array, flying: NDArray[np.bool_], rate_hz: float
) -> tuple[Array, Array]:
    """Windows (W, L, 3), (W, L, m) that are flown throughout and have no gap."""
    length = round(_WINDOW_S * rate_hz)
    turning, driven = [np.zeros((0, length, 3))], [np.zeros((0, length, thrust.shape[1]))]
    # Parts of their own where the time jumps: over a clock that was set in flight a grid has decades of points.
    jumps = np.flatnonzero(np.diff(time_s) > _WINDOW_S) + 1
    for begin, end in pairwise([0, *jumps, len(time_s)]):
        part = slice(begin, end)
        grid = np.arange(time_s[begin], time_s[end - 1], 1.0 / rate_hz)
        if len(grid) < length:
            continue
        nearest = np.clip(np.searchsorted(time_s[part], grid), 0, end - begin - 1)
        good = flying[part][nearest] & (np.abs(time_s[part][nearest] - grid) < 2.0 / rate_hz)
        rates, asked = (_on(grid, time_s[part], values[part]) for values in (gyro, thrust))
        rates = np.gradient(rates, 1.0 / rate_hz, axis=0)
        for k in range(0, len(grid) - length + 1, length // 2):
            if good[k : k + length].all():
                turning.append(rates[None, k : k + length])
                driven.append(asked[None, k : k + length])
    return np.concatenate(turning), np.concatenate(driven)


def _on(grid: Array, time_s: Array, values: Array) -> Array:
    """Columns of ``values`` (N, c) at ``grid`` (K,)."""
    return np.stack([np.interp(grid, time_s, column) for column in values.T], axis=1)


def fit(vehicle: Vehicle, motion: Motion) -> Fit:
    """Of the rows of ``vehicle``'s effectiveness, with the lag in common."""
    count, length = motion.turning.shape[:2]
    lag_s = vehicle.motor.time_constant_up_s
    frequency = np.asarray(np.fft.rfftfreq(length, 1.0 / motion.rate_hz), np.float64)
    inside = (frequency >= motion.band_hz[0]) & (frequency <= motion.band_hz[1])
    if count < _WINDOWS_MIN or not inside.any() or not motion.fast:
        return Fit(np.ones(3), np.zeros(3), lag_s)
    taper = np.hanning(length)[None, :, None]
    measured = np.fft.rfft(taper * (motion.turning - motion.turning.mean(axis=1, keepdims=True)), axis=1)[:, inside]
    torque = motion.thrust @ vehicle.acceleration_effectiveness[1:].T
    asked = np.fft.rfft(taper * (torque - torque.mean(axis=1, keepdims=True)), axis=1)[:, inside]
    # Rates that turn into accelerations by differences over two points of the grid lose the same.
    seen = _low_pass(frequency[inside], vehicle.telemetry.gyro_filter_hz) * np.sinc(
        2.0 * frequency[inside] / motion.rate_hz
    )
    asked = asked * seen[None, :, None]

    def with_lag(lag: float) -> Fit:
        return _gains(measured, asked / (1.0 + 2j * np.pi * frequency[inside] * lag)[None, :, None], float(lag))

    def unexplained(lag: float) -> float:
        return -float(with_lag(lag).explained[:2].sum())

    # Gain and lag go together: between two lags of the grid that explain alike the gain would be a matter of chance.
    best = min(range(len(_LAGS_S)), key=lambda k: unexplained(_LAGS_S[k]))
    bounds = (_LAGS_S[max(best - 1, 0)], _LAGS_S[min(best + 1, len(_LAGS_S) - 1)])
    refined = minimize_scalar(unexplained, bounds=bounds, method="bounded", options={"xatol": _LAG_TOLERANCE_S})
    return with_lag(refined.x if refined.fun < unexplained(_LAGS_S[best]) else _LAGS_S[best])


def _gains(measured: NDArray[np.complex128], shown: NDArray[np.complex128], lag_s: float) -> Fit:
    """Weighted medians over windows: a window in which something else turned the vehicle does not count."""
    across = (shown.conj() * measured).real.sum(axis=1)  # (W, 3)
    power = (np.abs(shown) ** 2).sum(axis=1)
    gain = np.array([_median(a / np.maximum(p, 1e-12), p) for a, p in zip(across.T, power.T, strict=True)])
    gain = np.maximum(gain, 0.0)
    left = (np.abs(measured - gain * shown) ** 2).sum(axis=1)
    total = (np.abs(measured) ** 2).sum(axis=1)
    explained = np.array(
        [_median(1.0 - le / np.maximum(to, 1e-12), to) for le, to in zip(left.T, total.T, strict=True)]
    )
    return Fit(gain, np.maximum(explained, 0.0), lag_s)


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(total, 0.5 * total[-1])), len(values) - 1)])


def _low_pass(frequency_hz: Array, cutoff_hz: float) -> NDArray[np.complex128]:
    """Of second order, as the autopilots' own (Butterworth); 0: none."""
    if cutoff_hz <= 0.0:
        return np.ones(len(frequency_hz), complex)
    s = 1j * frequency_hz / cutoff_hz
    return np.asarray(1.0 / (1.0 + np.sqrt(2.0) * s + s * s))
