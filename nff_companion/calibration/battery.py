"""How much less voltage a battery gives under more load, by a log that has its voltage.

A rotor's speed goes with the voltage of its motor, and its thrust with the square of that: what the battery gives less
at once is missing from the lift that a change of the outputs makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEAST = 30  # readings
_SMOOTH_S = 0.1  # of the load that a reading is held against: a power module is read in its own time
_SURE = 0.05  # deviation of what is found: with more, nothing is known
_STIFFEST, _SOFTEST = 0.02, -0.35  # change of the voltage by the load's: no battery is outside, beside error


@dataclass(frozen=True, slots=True)
class Sag:
    """Relative change of voltage over that of thrust, below 0, and its deviation."""

    ratio: float
    deviation: float

    def applied(self, thrust: NDArray[np.float64]) -> NDArray[np.float64]:
        """``thrust`` (N,) of any scale as the battery lets it be, about its mean."""
        return np.asarray(thrust * (1.0 + self.ratio * (thrust / thrust.mean() - 1.0)) ** 2)


def sag(
    readings: Sequence[NDArray[np.float64]], thrust: Sequence[NDArray[np.float64]], dt_s: float, late_s: float
) -> Sag | None:
    """Of pieces of a record: ``readings`` (B, 2) seconds since its beginning and V, the modelled ``thrust`` (N,) of any
    scale from ``late_s`` on, ``dt_s`` apart. None where the readings show nothing, or what no battery does."""
    times, volts, loads = [], [], []
    for told, given in zip(readings, thrust, strict=True):
        width = max(round(_SMOOTH_S / dt_s), 1)
        even = np.convolve(given, np.full(width, 1.0 / width), mode="same")
        at = late_s + dt_s * np.arange(len(given))
        inside = (told[:, 0] > at[0] + _SMOOTH_S) & (told[:, 0] < at[-1] - _SMOOTH_S) & (told[:, 1] > 0.0)
        times.append(told[inside, 0])
        volts.append(told[inside, 1])
        loads.append(np.interp(told[inside, 0], at, even))
    seen = np.concatenate(volts)
    if len(seen) < _LEAST:
        return None
    scale = float(np.concatenate(loads).mean())
    rows = []
    for k, (time, load) in enumerate(zip(times, loads, strict=True)):
        each = np.zeros((len(time), 2 * len(times)))  # of each piece its own charge, and how it runs down
        each[:, 2 * k], each[:, 2 * k + 1] = 1.0, time - (time.mean() if len(time) else 0.0)
        rows.append(np.column_stack([load / scale, each]))
    matrix, side = np.concatenate(rows), seen / seen.mean()
    found = np.linalg.lstsq(matrix, side, rcond=1e-9)[0]
    rest = side - matrix @ found
    deviation = float(np.sqrt(np.linalg.pinv(matrix.T @ matrix)[0, 0] * rest.var()))
    ratio = float(found[0])
    if deviation > _SURE or not _SOFTEST < ratio < _STIFFEST:
        return None
    return Sag(ratio, deviation)
