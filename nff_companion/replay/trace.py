"""The course of a flight as the companion saw it, for drawings: means of so much time that there are few of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Estimate
from nff_companion.core.vehicle import Vehicle

RATE_HZ = 25.0


@dataclass(frozen=True)
class Course:
    """Arrays (K, ..) over ``time_s`` (K,) from the first record. ``residual`` (K, n): measured accelerations less what
    all motors, were they whole, would give; ``thrust`` (K, m): fractions as they show in it; ``effectiveness`` (K, m)
    as estimated; SI units."""

    time_s: NDArray[np.float64]
    residual: NDArray[np.float64]
    thrust: NDArray[np.float64]
    effectiveness: NDArray[np.float64]


@dataclass
class Trace:
    """Collects while a flight goes by."""

    vehicle: Vehicle
    _rows: list[NDArray[np.float64]] = field(default_factory=list)  # means so far
    _sum: NDArray[np.float64] | None = None
    _count: int = 0
    _began_s: float = 0.0

    def add(self, time_s: float, estimate: Estimate) -> None:
        """One sample, at ``time_s`` from the first record."""
        w = estimate.thrust_shown
        residual = estimate.raw
        if True in estimate.failed.tolist():  # which it is without
            residual = residual - self.vehicle.acceleration_effectiveness @ (w * estimate.failed)
        row = np.concatenate([[time_s], residual, w, estimate.effectiveness])
        if self._sum is None or time_s - self._began_s >= 1.0 / RATE_HZ - 1e-9 or time_s < self._began_s:
            self._close()
            self._sum, self._count, self._began_s = row, 1, time_s
        else:
            self._sum, self._count = self._sum + row, self._count + 1

    def _close(self) -> None:
        if self._sum is not None:
            self._rows.append(self._sum / self._count)

    def course(self) -> Course:
        """Of all that was added."""
        n, m = self.vehicle.axes, self.vehicle.motors
        last = [] if self._sum is None else [self._sum / self._count]
        rows = np.array([*self._rows, *last]).reshape(-1, 1 + n + 2 * m)
        return Course(rows[:, 0], rows[:, 1 : 1 + n], rows[:, 1 + n : 1 + n + m], rows[:, 1 + n + m :])
