"""How much lift a quick change of the outputs makes: it says how steep the thrust curve is where the vehicle hovers.

What the outputs do to roll, pitch and yaw hangs on the curve and on gains that nobody knows; of lift the gain is known,
as it carries the weight. The relative change of lift over that of the modelled thrust is regressed, with the noise made
white, beside what climbing, side wind, and a battery that runs down do. It comes out below the curve's own: under more
load the battery gives less at once (battery.py), and the vehicle climbs away from its own downwash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import decimate

from nff_companion.calibration import noise
from nff_companion.calibration.battery import Sag

# Of what the curve alone would make, and the deviation of its logarithm: by what the vehicle does to the air between a
# change and its measurement, and by gusts that the outputs answer. 19 flights of octo-x, coax-x8 and paper-octo, off
# from their files, had 0.88 to 0.96 (`nff bench calibration`).
_AIR = 0.915, 0.025
_BATTERY = 0.95, 0.04  # the same by a battery whose voltage is not known: 2 to 8 % of it go at full load
_STILL = 0.10  # deviation without a velocity: climbing is not told apart
_PERIOD_S = 0.02  # what is quicker is motors' lag, filters and shaking
_ROUNDS, _MEMORY_S = 6, 0.3
_LEAST = 0.01  # of the thrust: with less change than that all else that changes the lift is more
_TINY = 1e-12
_TAPS = 20  # of the filter, over how many rows become one


@dataclass(frozen=True, slots=True)
class Slope:
    """Relative change of lift over that of the modelled thrust, and the deviation of its logarithm."""

    ratio: float
    deviation: float


@dataclass(frozen=True, slots=True)
class Share:
    """Of the curve's own steepness that a change of lift shows, and the deviation of its logarithm."""

    mean: float
    deviation: float


def share_of(*, climbs: bool, battery: Sag | None) -> Share:
    """``climbs``: with the climb among what the air does; ``battery``: with its sag in the thrust."""
    (mean, first), second = _AIR, 0.0 if climbs else _STILL
    if battery is None:
        return Share(mean * _BATTERY[0], float(np.sqrt(first**2 + second**2 + _BATTERY[1] ** 2)))
    return Share(mean, float(np.sqrt(first**2 + second**2 + (2.0 * battery.deviation) ** 2)))


def lift_slope(
    lift: Sequence[NDArray[np.float64]],
    thrust: Sequence[NDArray[np.float64]],
    air: Sequence[NDArray[np.float64]],
    dt_s: float,
) -> Slope | None:
    """Of pieces of a record ``dt_s`` apart: upward specific force (N,), modelled thrust (N,) of any scale, and columns
    (N, c) of what the air does. None where the lift shows nothing."""
    rows, values, many = [], [], max(round(_PERIOD_S / dt_s), 1)
    order = max(round(_MEMORY_S / (many * dt_s)), 2)
    least = many * (2 * _TAPS + 2 * order + 2)
    for piece in zip(lift, thrust, air, strict=True):
        if len(piece[0]) < least:
            continue
        up, given, columns = (_slower(each, many) for each in piece)
        time = np.linspace(-1.0, 1.0, len(up))
        rows.append(np.column_stack([given / given.mean(), np.ones(len(up)), time, columns]))
        values.append(up / up.mean())
    if not rows or np.concatenate([row[:, 0] for row in rows]).std() < _LEAST:
        return None
    matrices, sides = list(rows), list(values)
    found, spread = np.zeros(rows[0].shape[1]), 0.0
    for _ in range(_ROUNDS):
        whole, right = np.concatenate(matrices), np.concatenate(sides)
        scale = np.sqrt(np.mean(whole * whole, axis=0)) + _TINY
        found = np.linalg.lstsq(whole / scale, right, rcond=1e-9)[0] / scale
        rest = right - whole @ found
        information = np.linalg.pinv((whole / scale).T @ (whole / scale))
        spread = float(np.sqrt(information[0, 0] * rest.var())) / float(scale[0])
        left = [value - row @ found for row, value in zip(rows, values, strict=True)]
        filter_ = noise.autoregression([part - part.mean() for part in left], order)
        matrices = [noise.whitened(row, filter_) for row in rows]
        sides = [noise.whitened(value[:, None], filter_)[:, 0] for value in values]
    ratio = float(found[0])
    if not ratio > 2.0 * spread:
        return None
    return Slope(ratio, spread / ratio)


def _slower(values: NDArray[np.float64], many: int) -> NDArray[np.float64]:
    """Every ``many``-th row of ``values`` (N, ...), after what is too quick for that is out; without the ends, where
    the filter lacks a half."""
    if many < 2:
        return values
    return np.asarray(decimate(values, many, _TAPS * many, "fir", axis=0)[_TAPS:-_TAPS])
