"""What has been seen since a set of losses was first said that cannot be told apart, or since losses are suspected that
nobody declares: how the residual changes.

Each of the sets explains what the residual is, by losses of its own; what the model has wrong of that is the same at
every moment. What tells them apart is how the residual moves when the motors do, by a test or by the way that the
vehicle flies: sums over blocks, in each of which the mean is left out. They grow for as long as the doubt lasts, where
the windows of the onsets end after a fifth of a second. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import hypotheses


@dataclass(frozen=True, slots=True)
class Sums:
    """Of losses x = B0 diag(w) (n, m) and y (n,), weighted: S (m, m), q (m,), and per axis of the weights (n,), x (n,
    m), y (n,)."""

    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]
    weight: NDArray[np.float64]
    lost: NDArray[np.float64]
    residual: NDArray[np.float64]

    @staticmethod
    def none(axes: int, motors: int) -> Sums:
        """Of no sample."""
        n, m = axes, motors
        return Sums(np.zeros((m, m)), np.zeros(m), np.zeros(n), np.zeros((n, m)), np.zeros(n))

    def grown(self, lost: NDArray[np.float64], residual: NDArray[np.float64], weight: NDArray[np.float64]) -> Sums:
        """With one sample: x (n, m), y (n,) and the diagonal (n,) of W."""
        weighted = lost * weight[:, None]
        return Sums(
            matrix=self.matrix + weighted.T.dot(lost),
            vector=self.vector + residual.dot(weighted),
            weight=self.weight + weight,
            lost=self.lost + weighted,
            residual=self.residual + weight * residual,
        )

    def changes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """S and q of what differs from the mean."""
        mean = self.lost / np.maximum(self.weight, 1e-300)[:, None]
        return self.matrix - mean.T.dot(self.lost), self.vector - self.residual.dot(mean)


class Told(NamedTuple):
    """A set of motors (indices), their losses, and by how many nats it is ahead of the next set, and of that none is
    lost: of the better of the two; and of the second alone, below 0 where the residual does not move with any set."""

    motors: tuple[int, ...]
    loss: tuple[float, ...]
    ahead: float
    improvement: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """``whole``: of all samples; ``block``: of those since ``begun_s``; S (m, m) and q (m,) of the changes within the
    blocks before."""

    whole: Sums
    block: Sums
    begun_s: float
    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]

    @staticmethod
    def none(axes: int, motors: int, time_s: float) -> Evidence:
        """Nothing seen yet."""
        empty = Sums.none(axes, motors)
        return Evidence(empty, empty, time_s, np.zeros((motors, motors)), np.zeros(motors))

    def grown(
        self,
        time_s: float,
        lost: NDArray[np.float64],
        residual: NDArray[np.float64],
        weight: NDArray[np.float64],
        block_s: float,
    ) -> Evidence:
        """With one sample, as ``Sums.grown``; a block lasts ``block_s``."""
        whole, block = self.whole.grown(lost, residual, weight), self.block.grown(lost, residual, weight)
        if time_s - self.begun_s < block_s:
            return replace(self, whole=whole, block=block)
        matrix, vector = block.changes()
        empty = Sums.none(*lost.shape)
        return Evidence(whole, empty, time_s, self.matrix + matrix, self.vector + vector)

    def over(self, residual: NDArray[np.float64], variance: NDArray[np.float64], deviations: float) -> bool:
        """Whether something has happened since: the ``residual`` (n,) is no longer the mean of what was seen, by more
        than so many ``deviations`` and half of that mean, which is what motors that move make of it."""
        if not self.whole.weight.any():
            return False
        mean = self.whole.residual / np.maximum(self.whole.weight, 1e-300)
        beyond = (np.abs(residual - mean) - 0.5 * np.abs(mean)) / np.sqrt(variance)
        return bool((beyond > deviations).any())

    def before(self, time_s: float, variance: NDArray[np.float64], deviations: float, block_s: float) -> bool:
        """The same of the mean of a block that ends now."""
        if time_s - self.begun_s < block_s or not self.block.weight.any():
            return False
        return self.over(self.block.residual / np.maximum(self.block.weight, 1e-300), variance, deviations)

    def told(self, sets: tuple[tuple[int, ...], ...], gamma: float) -> Told:
        """The one of ``sets`` (indices, one or two) by which the residual moves best."""
        matrix, vector = self.block.changes()
        matrix, vector = self.matrix + matrix, self.vector + vector
        improvement, losses = np.zeros(len(sets) + 1), [self._lost(motors, gamma) for motors in sets]
        for k, (motors, e) in enumerate(zip(sets, losses, strict=True)):
            improvement[k] = vector[list(motors)].dot(e) - 0.5 * e.dot(matrix[np.ix_(motors, motors)]).dot(e)
        best = int(improvement[:-1].argmax())
        ahead = float(improvement[best] - np.delete(improvement, best).max())
        return Told(sets[best], tuple((-losses[best]).tolist()), ahead, float(improvement[best]))

    def _lost(self, motors: tuple[int, ...], gamma: float) -> NDArray[np.float64]:
        """eta - 1 of each of ``motors``, by all that was seen."""
        matrix, vector = self.whole.matrix[None], self.whole.vector[None]
        if len(motors) == 1:
            return hypotheses.singles(matrix, vector, gamma).e[0, motors[0]]
        first, second = (np.array([motor]) for motor in motors)
        return hypotheses.pairs(matrix, vector, gamma, first, second).e[0, 0]
