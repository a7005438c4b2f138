"""Random numbers of a fleet: one generator a vehicle, so that a vehicle flies the same alone and among a thousand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def vehicle_generators(seeds: list[int], stream: int) -> list[np.random.Generator]:
    """One independent generator for each vehicle's seed; ``stream`` separates the users of one seed."""
    return [np.random.default_rng([int(seed), stream]) for seed in seeds]


class NormalBlocks:
    """Standard normal draws (N, width) a step, taken from each vehicle's generator in blocks.

    ``buffer`` (N, block, width) holds those of many steps; what was taken is overwritten when it has run out.
    """

    def __init__(self, generators: list[np.random.Generator], width: int, block: int = 256) -> None:
        self._generators = generators
        self.buffer = np.zeros((len(generators), block, width))
        self._index = block

    def take(self, steps: int) -> int:
        """The draws of the next ``steps`` are at this place in ``buffer``, one after the other, until the next call.

        Raises ValueError for more than a block.
        """
        block = self.buffer.shape[1]
        if steps > block:
            raise ValueError(f"{steps} steps are more than the {block} of a block: take fewer at once")
        if self._index + steps > block:
            left = block - self._index
            self.buffer[:, :left] = self.buffer[:, self._index :].copy()
            for rows, generator in zip(self.buffer, self._generators, strict=True):
                generator.standard_normal(out=rows[left:])
            self._index = 0
        self._index += steps
        return self._index - steps

    def next(self) -> NDArray[np.float64]:
        """Draws (N, width) of the next step."""
        return self.buffer[:, self.take(1)].copy()
