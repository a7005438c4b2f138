"""How much less voltage a battery gives under more load, by a log that has its voltage.

A rotor's speed goes with the voltage of its motor, and its thrust with the square of that: what the battery gives less
at once is missing from the lift that a change of the outputs makes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEAST = 30  # readings beyond what is fitted
_SMOOTH_S = 0.1  # of the load that a reading is held against: a power module is read in its own time
_WINDOW_S = 20.0  # in which a battery runs down evenly
_SURE = 0.02  # deviation of what is found: with more, what batteries do is better known
_SUREST = 0.004  # what the voltage does beside: its sensor's filter, cables, temperature
_STIFFEST, _SOFTEST = 0.02, -0.35  # change of the voltage by the load's: no battery is outside, beside error
_DISTINCT = 5  # values: fewer are no measurement


@dataclass(frozen=True, slots=True)
class Sag:
    """Relative change of voltage over that of thrust, below 0, and its deviation."""

    ratio: float
    deviation: float

    def applied(self, thrust: NDArray[np.float64]) -> NDArray[np.float64]:
        """``thrust`` (N,) of any scale as the battery lets it be, about its mean."""
        return np.asarray(thrust * (1.0 + self.ratio * (thrust / thrust.mean() - 1.0)) ** 2)


def sag(
    readings: Sequence[NDArray[np.float64]],
    thrust: Sequence[NDArray[np.float64]],
    dt_s: Sequence[float],
    late_s: Sequence[float],
) -> Sag | None:
    """Of pieces of a record: ``readings`` (B, 2) seconds since its beginning and V, the modelled ``thrust`` (N,) of any
    scale from ``late_s`` on, ``dt_s`` apart. None where the readings show nothing, or what no battery does."""
    volts, loads, fitted, told_by = [], [], 0, set[float]()
    for told, given, step_s, begin_s in zip(readings, thrust, dt_s, late_s, strict=True):
        for voltage, load in _windows(told, given, step_s, begin_s):
            time = np.linspace(-1.0, 1.0, len(voltage))
            trend = np.column_stack([np.ones(len(time)), time])  # its charge, and how it runs down
            both = np.column_stack([voltage, load])
            left = both - trend @ np.linalg.lstsq(trend, both, rcond=None)[0]
            volts.append(left[:, 0] / voltage.mean())
            loads.append(left[:, 1])
            fitted += trend.shape[1]
            told_by |= set(voltage.tolist())
    if not volts or len(told_by) < _DISTINCT:
        return None
    change, load = np.concatenate(volts), np.concatenate(loads) / float(np.mean([given.mean() for given in thrust]))
    free, power = len(change) - fitted - 1, float(load @ load)
    if free < _LEAST or power <= 0.0:
        return None
    ratio = float(load @ change) / power
    rest = change - ratio * load
    deviation = float(np.hypot(np.sqrt(rest @ rest / free / power), _SUREST))
    if not (deviation <= _SURE and _SOFTEST < ratio < _STIFFEST):
        return None
    return Sag(ratio, deviation)


def _windows(
    told: NDArray[np.float64], given: NDArray[np.float64], dt_s: float, late_s: float
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Voltage and load (K,) at its readings, of each part of a piece."""
    width = max(round(_SMOOTH_S / dt_s), 1)
    if len(given) < 2 * width:
        return
    even = np.convolve(given, np.full(width, 1.0 / width), mode="same")
    at = late_s + dt_s * np.arange(len(given))
    inside = (told[:, 0] > at[0] + _SMOOTH_S) & (told[:, 0] < at[-1] - _SMOOTH_S) & (told[:, 1] > 0.0)
    time, volts = told[inside].T
    load = np.interp(time, at, even)
    part = np.floor((time - late_s) / _WINDOW_S)
    for k in np.unique(part):
        mine = part == k
        if mine.sum() > 3:
            yield volts[mine], load[mine]
