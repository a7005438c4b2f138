"""Other orders of an airframe's motors: two swapped, some turning the other way, the nose elsewhere.

One of them may be what flies. Rows are of roll, pitch and yaw: of the effectiveness matrix, in any units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Order:
    """``rows`` (3, m) after a change: motors (from 1) that are swapped, or turn the other way, or the frame turned
    clockwise."""

    rows: NDArray[np.float64]
    swapped: tuple[int, int] | None = None
    reversed: tuple[int, ...] = ()
    turned_deg: float = 0.0

    @property
    def text(self) -> str:
        """In a few words; empty: nothing is changed."""
        if self.swapped:
            return f"motors {self.swapped[0]}, {self.swapped[1]} swapped"
        if self.turned_deg:
            return f"nose {abs(self.turned_deg):g} deg elsewhere"
        if len(self.reversed) == self.rows.shape[1]:
            return "all spins reversed"
        return "".join(f"motor {motor} spin reversed" for motor in self.reversed)


def orders(rows: NDArray[np.float64]) -> list[Order]:
    """The own one first; then every two motors swapped that are not alike, every motor reversed, all of them, and the
    frame turned."""
    motors = rows.shape[1]
    out = [Order(rows)]
    for i, k in combinations(range(motors), 2):
        if np.allclose(rows[:, i], rows[:, k]):
            continue
        places = np.arange(motors)
        places[[i, k]] = k, i
        out.append(Order(rows[:, places], swapped=(i + 1, k + 1)))
    everyone = tuple(range(1, motors + 1))
    out += [_reversed(rows, (motor,)) for motor in everyone]
    # What is between frames of the firmwares: 22.5 and 30 degrees are much alike, and stand for 25.
    angles = (25.0, -25.0, 45.0, -45.0, 60.0, -60.0, 90.0, -90.0, 180.0)
    return [*out, _reversed(rows, everyone), *(_turned(rows, angle) for angle in angles)]


def _reversed(rows: NDArray[np.float64], motors: tuple[int, ...]) -> Order:
    roll, pitch, yaw = rows.copy()
    index = np.array(motors) - 1
    yaw[index] = -yaw[index]
    return Order(np.stack([roll, pitch, yaw]), reversed=motors)


def _turned(rows: NDArray[np.float64], angle_deg: float) -> Order:
    # Without the moments of inertia, which differ about the two axes.
    roll, pitch, yaw = rows / np.sqrt(np.mean(rows**2, axis=1, keepdims=True))
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return Order(np.stack([c * roll - s * pitch, s * roll + c * pitch, yaw]), turned_deg=angle_deg)
