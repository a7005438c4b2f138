"""How much lift a quick change of the outputs makes: it says how steep the thrust curve is where the vehicle hovers.

What the outputs do to roll, pitch and yaw hangs on the curve and on gains that nobody knows; of lift the gain is known,
as it carries the weight. The relative change of lift over that of the modelled thrust is regressed, with the noise made
white, beside what climbing, side wind, and a battery that runs down do. It comes out below the curve's own: under more
load the battery gives less at once, and the vehicle climbs away from its own downwash.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import noise

# Of what the curve alone would make, by the battery's resistance (5 to 10 % of its voltage at full load, and thrust
# goes with its square) and by what climbing takes before it is measured; and what is not known of that.
SHARE, _SHARE_DEVIATION = 0.88, 0.06
_STILL = 0.12  # the same without a velocity: climbing is not told apart
_ROUNDS, _MEMORY_S = 3, 0.3
_LEAST = 0.01  # of the thrust: with less change than that all else that changes the lift is more
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Slope:
    """Relative change of lift over that of the modelled thrust, and the deviation of its logarithm."""

    ratio: float
    deviation: float


def lift_slope(
    lift: Sequence[NDArray[np.float64]],
    thrust: Sequence[NDArray[np.float64]],
    air: Sequence[NDArray[np.float64]],
    dt_s: float,
    *,
    climbs: bool,
) -> Slope | None:
    """Of pieces of a record ``dt_s`` apart: upward specific force (N,), modelled thrust (N,) of any scale, and columns
    (N, c) of what the air does; ``climbs``: with the climb among them. None where the lift shows nothing."""
    rows, values = [], []
    for up, given, columns in zip(lift, thrust, air, strict=True):
        time = np.linspace(-1.0, 1.0, len(up))
        rows.append(np.column_stack([given / given.mean(), np.ones(len(up)), time, columns]))
        values.append(up / up.mean())
    if np.concatenate([row[:, 0] for row in rows]).std() < _LEAST:
        return None
    order = max(round(_MEMORY_S / dt_s), 2)
    if min(len(part) for part in values) <= 2 * order:
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
    own = _SHARE_DEVIATION if climbs else _STILL
    return Slope(ratio, float(np.hypot(spread / ratio, own / SHARE)))
