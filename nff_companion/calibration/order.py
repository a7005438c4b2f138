"""Are motors where the file has them, and do they turn as it says? Every swap and every spin is weighed.

Between two frequencies, where a vehicle's own motion is above the air's, each axis follows the outputs of the right
layout. What a layout leaves unexplained gives its likelihood; each axis' gain is free.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import chain, model
from nff_companion.calibration.model import Layout
from nff_companion.calibration.record import Record

_BANDS_HZ = {model.ROLL: (1.0, 8.0), model.PITCH: (1.0, 8.0), model.YAW: (0.3, 4.0)}
_SETTLE_S = 0.5


@dataclass(frozen=True, slots=True)
class Order:
    """A layout and what is changed in it: motors (from 1) that are swapped, or turn the other way."""

    layout: Layout
    swapped: tuple[int, int] | None = None
    reversed: tuple[int, ...] = ()

    @property
    def text(self) -> str:
        """In words; empty: nothing is changed."""
        if self.swapped:
            return f"motors {self.swapped[0]} and {self.swapped[1]} are swapped"
        if len(self.reversed) == self.layout.motors:
            return "all motors turn the other way"
        return " and ".join(f"motor {m} turns the other way" for m in self.reversed)


@dataclass(frozen=True, slots=True)
class Weighed:
    """The order that fits best, by how many nats better than the file's own, and than the next best one."""

    best: Order
    over_file_nats: float
    over_next_nats: float
    explained: NDArray[np.float64]  # (3,) roll, pitch, yaw, in their bands, by the best


def orders(layout: Layout) -> list[Order]:
    """The file's first; then every pair swapped, every motor reversed, all of them."""
    out = [Order(layout)]
    for i, k in combinations(range(layout.motors), 2):
        place, spin = layout.place.copy(), layout.spin.copy()
        place[[i, k]], spin[[i, k]] = place[[k, i]], spin[[k, i]]
        out.append(Order(replace(layout, place=place, spin=spin), swapped=(i + 1, k + 1)))
    for i in range(layout.motors):
        spin = layout.spin.copy()
        spin[i] = -spin[i]
        out.append(Order(replace(layout, spin=spin), reversed=(i + 1,)))
    everyone = tuple(range(1, layout.motors + 1))
    return [*out, Order(replace(layout, spin=-layout.spin), reversed=everyone)]


class Evidence:
    """Sums over a record: of each axis, the products of thrusts and accelerations in its band."""

    def __init__(
        self, record: Record, filters: chain.Filters, motors: chain.Motors, inertia: tuple[float, float, float]
    ) -> None:
        m = record.pieces[0].output.shape[1]
        self.gram = {axis: np.zeros((m + 1, m + 1)) for axis in _BANDS_HZ}
        self.independent = dict.fromkeys(_BANDS_HZ, 0.0)
        for piece in record.pieces:
            skip = round(_SETTLE_S / piece.dt_s)
            measured = chain.measured(piece, filters, inertia)
            thrust = chain.shown(piece, [motors], filters)[0]
            for axis, (low, high) in _BANDS_HZ.items():
                both = np.column_stack([thrust, measured[:, axis]])
                both = np.column_stack([chain.band(column, piece.dt_s, low, high) for column in both.T])[skip:-skip]
                self.gram[axis] += both.T @ both
                self.independent[axis] += 2.0 * (high - low) * len(both) * piece.dt_s

    def left(self, layout: Layout) -> NDArray[np.float64]:
        """(3,) share of the squares that the layout leaves, with the gain of each axis that leaves least; a gain is
        never negative."""
        rows = model.unit_rows(layout, np.zeros(layout.parameters))
        out = []
        for axis, gram in self.gram.items():
            thrusts, cross, power = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
            row = rows[axis]
            asked = float(row @ thrusts @ row)
            along = max(float(row @ cross), 0.0)
            out.append(1.0 - along * along / max(asked * float(power), 1e-30))
        return np.array(out)


def weigh(evidence: Evidence, layout: Layout) -> Weighed:
    """Which order the record speaks for."""
    found = orders(layout)
    left = np.array([evidence.left(order.layout) for order in found])
    count = np.array(list(evidence.independent.values()))
    nats = -0.5 * (np.log(np.maximum(left, 1e-9)) * count).sum(axis=1)
    ranked = np.argsort(-nats, kind="stable")
    best, following = int(ranked[0]), int(ranked[1])
    return Weighed(found[best], float(nats[best] - nats[0]), float(nats[best] - nats[following]), 1.0 - left[best])
