"""Random numbers of a fleet: one generator a vehicle, so that a vehicle flies the same alone and among a thousand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def vehicle_generators(seeds: list[int], stream: int) -> list[np.random.Generator]:
    """One independent generator for each vehicle's seed; ``stream`` separates the users of one seed."""
    return [np.random.default_rng([int(seed), stream]) for seed in seeds]


class NormalBlocks:
    """Standard normal draws (N, width) a step, taken from each vehicle's generator in blocks."""

    def __init__(self, generators: list[np.random.Generator], width: int, block: int = 256) -> None:
        self._generators, self._width, self._block = generators, width, block
        self._buffer = np.empty((0, len(generators), width))
        self._index = 0

    def next(self) -> NDArray[np.float64]:
        """Draws (N, width) of the next step."""
        if self._index >= len(self._buffer):
            self._buffer = np.stack([g.standard_normal((self._block, self._width)) for g in self._generators], axis=1)
            self._index = 0
        self._index += 1
        return self._buffer[self._index - 1]
