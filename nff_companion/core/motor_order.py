"""Other orders of an airframe's motors: two swapped, some turning the other way. One of them may be what flies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Order:
    """``rows`` (k, m) of the effectiveness matrix after a change: motors (from 1) that are swapped, or turn the other
    way."""

    rows: NDArray[np.float64]
    swapped: tuple[int, int] | None = None
    reversed: tuple[int, ...] = ()

    @property
    def text(self) -> str:
        """In a few words; empty: nothing is changed."""
        if self.swapped:
            return f"motors {self.swapped[0]}, {self.swapped[1]} swapped"
        if len(self.reversed) == self.rows.shape[1]:
            return "all spins reversed"
        return "".join(f"motor {motor} spins the other way" for motor in self.reversed)


def orders(rows: NDArray[np.float64], yaw: int) -> list[Order]:
    """The file's own first; then every two motors swapped that are not alike, every motor reversed, all of them.

    ``rows`` (k, m); ``yaw``: which of them changes its sign where a motor turns the other way.
    """
    motors = rows.shape[1]
    out = [Order(rows)]
    for i, k in combinations(range(motors), 2):
        if np.allclose(rows[:, i], rows[:, k]):
            continue
        places = np.arange(motors)
        places[[i, k]] = k, i
        out.append(Order(rows[:, places], swapped=(i + 1, k + 1)))
    everyone = tuple(range(1, motors + 1))
    return [*out, *(_reversed(rows, yaw, (motor,)) for motor in everyone), _reversed(rows, yaw, everyone)]


def _reversed(rows: NDArray[np.float64], yaw: int, motors: tuple[int, ...]) -> Order:
    turned, index = rows.copy(), np.array(motors) - 1
    turned[yaw, index] = -turned[yaw, index]
    return Order(turned, reversed=motors)
