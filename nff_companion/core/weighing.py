"""Which lost motors explain the last moments best, and by how much over anything else: one hypothesis.

Single motors and pairs by their onset windows, against each other, against motors that pull more than asked,
and against what rotor speeds say. Pure; what comes of it is for core/decision.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import hypotheses
from nff_companion.core.ambiguity import needed
from nff_companion.core.mates import HALF, Mates
from nff_companion.core.onset import OnsetSums
from nff_companion.core.tuning import DecisionTuning


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Best explanation of the moment: motors (indices from 0), their losses 1 - eta, and how sure."""

    motors: tuple[int, ...]
    loss: tuple[float, ...]
    improvement: float
    margin: float
    explained: float
    age_s: float
    beside: float = 0.0  # margin over the next that is not of the same place (core/mates.py)
    place: tuple[int, ...] = ()  # the two motors above each other of which it cannot be told; empty: it can
    place_loss: float = 1.0  # of ``place``: the loss of the one of the two that it would be least of
    more: int = -1  # the motor that pulls more than it is asked to, where that explains better; -1: none
    moved: bool = False  # told from others by how the residual moves (core/evidence.py)
    shared: bool = False  # one motor, of all the pairs that explain well
    # What is no loss explains better: a motor that pulls more, or one believed lost that works again.
    overruled: bool = False
    # This one and those that explain as well, the best first: sets of motors with their losses. Empty: it leads.
    alike: tuple[tuple[tuple[int, ...], tuple[float, ...]], ...] = ()

    @property
    def confidence(self) -> float:
        """Probability against the next hypothesis."""
        return float(1.0 / (1.0 + np.exp(-min(self.margin, 50.0))))


class Weighing:
    """Thresholds and the hypotheses of an airframe with m motors."""

    def __init__(self, motors: int, tuning: DecisionTuning, mates: Mates | None = None) -> None:
        self.tuning, self._mates = tuning, mates
        self._pairs = np.array(list(combinations(range(motors), 2)), int).reshape(-1, 2)

    def best(
        self, sums: OnsetSums, failed: NDArray[np.bool_], gamma: float, known: tuple[int, ...] = ()
    ) -> Hypothesis | None:
        """The hypothesis that explains the windows best, None when none improves enough. ``known``: two motors above
        each other, of each of which half is believed lost; where the one that failed works again, both give more."""
        o = self.tuning
        again = hypotheses.together(sums.matrix, sums.vector, known, 1.0 - HALF) if known else 0.0
        sums, one, one_best, first = _alone(sums, failed, gamma)
        if not self._improves(one_best[first]):
            return None
        pairs, most, puller = self._pairs, 0.0, -1
        if sums.more is not None and sums.more_square is not None:
            improvement, by = hypotheses.more(sums.more, sums.more_square)
            pulls = np.where(failed | (by < o.more_min), 0.0, improvement) - o.pair_min
            pulls[list(known)] = 0.0
            puller = int(pulls.argmax())
            most = float(pulls[puller])
        if again > most:
            most, puller = again, -1
        if True in failed.tolist():
            pairs = pairs[~failed[pairs].any(axis=1)]
        if len(pairs) == 0:
            return self._against(self._describe((first,), one, first, sums, one_best, np.zeros(0)), most, puller)
        two = hypotheses.pairs(sums.matrix, sums.vector, gamma, pairs[:, 0], pairs[:, 1])
        two_best = two.improvement.max(axis=0)
        best = int(two_best.argmax())
        gain = two_best[best] - one_best[first]
        if gain > o.pair_min:
            others = _beside(two_best, best)
            found = self._describe(tuple(pairs[best]), two, best, sums, others, one_best)
            found = self._with_alike(found, pairs, two, two_best)
            found = self._shared(found, pairs, two_best, one_best)
            return self._against(self._of_place(found, pairs, two_best, one_best), most + o.pair_min, puller)
        # A pair on both sides of a motor can look like it: such a pair, with its lower prior, is a rival too.
        without = two_best[(pairs != first).all(axis=1)] - o.pair_min
        others = _beside(one_best, first)
        found = self._describe((first,), one, first, sums, others, without)
        return self._against(self._of_place(found, pairs, two_best, one_best), most, puller)

    def _against(self, found: Hypothesis, most: float, puller: int) -> Hypothesis:
        """``found``, with its margin over that the motor ``puller`` pulls more than it is asked to, which improves by
        ``most``: it turns the vehicle as the loss of those on the other side does. -1: over what is no failure."""
        ahead = most - found.improvement
        if -ahead >= found.margin:
            return found
        more = puller if ahead > self.tuning.margin_min and most > self.tuning.more_improvement_min else -1
        overruled = ahead > self.tuning.margin_min
        return replace(found, margin=-ahead, beside=min(found.beside, -ahead), alike=(), more=more, overruled=overruled)

    def _with_alike(
        self,
        found: Hypothesis,
        pairs: NDArray[np.intp],
        two: hypotheses.Scores,
        two_best: NDArray[np.float64],
    ) -> Hypothesis:
        """With the pairs that explain as well as the one ``found``."""
        least = found.improvement - needed(found.improvement, self.tuning)
        if found.improvement < self.tuning.improvement_min or found.margin >= found.improvement - least:
            return found
        near = np.flatnonzero(two_best >= least)
        near = near[np.argsort(-two_best[near])][: self.tuning.alike_max]
        windows = two.improvement[:, near].argmax(axis=0)
        losses = (-two.e[windows, near]).tolist()
        sets = [tuple(motors) for motors in pairs[near].tolist()]
        return replace(found, alike=tuple(zip(sets, map(tuple, losses), strict=True)))

    def _shared(
        self,
        found: Hypothesis,
        pairs: NDArray[np.intp],
        two_best: NDArray[np.float64],
        one_best: NDArray[np.float64],
    ) -> Hypothesis:
        """The motor that is lost with whatever else ``found`` holds, where that is certain and the rest of it is less
        than a loss: by a file that is off, a part of another motor explains what one alone cannot."""
        o = self.tuning
        least, most = sorted(range(2), key=found.loss.__getitem__)
        if found.loss[least] > o.loss_others or found.loss[most] < o.loss_settled:
            return found
        if found.age_s <= o.settled_s or found.explained < o.shared_explained_min:
            return found
        believed, other = self._ahead(found.motors[most], pairs, two_best, one_best)
        if believed - other < needed(found.improvement, o):
            return found
        motors, loss = (found.motors[most],), (found.loss[most],)
        return replace(found, motors=motors, loss=loss, margin=believed - other, alike=(), shared=True)

    def _ahead(
        self, motor: int, pairs: NDArray[np.intp], two_best: NDArray[np.float64], one_best: NDArray[np.float64]
    ) -> tuple[float, float]:
        """Improvements: the best in which ``motor`` is lost, alone or with another, and the best in which it is not."""
        two, with_it = two_best - self.tuning.pair_min, (pairs == motor).any(axis=1)
        believed = max([float(one_best[motor]), *two[with_it].tolist()])
        return believed, max([*_beside(one_best, motor).tolist(), *two[~with_it].tolist()], default=0.0)

    def _of_place(
        self,
        found: Hypothesis,
        pairs: NDArray[np.intp],
        two_best: NDArray[np.float64],
        one_best: NDArray[np.float64],
    ) -> Hypothesis:
        """With its margin over what is elsewhere, where motors are above each other."""
        place = () if self._mates is None else self._mates.place(found.motors)
        if not place:
            return found
        elsewhere = [score for i, score in enumerate(one_best.tolist()) if i not in place]
        apart = ~np.isin(pairs, place).any(axis=1)
        two = (two_best[apart] - self.tuning.pair_min).tolist()
        mine = found.improvement - (self.tuning.pair_min if found.shared else 0.0)
        return replace(found, beside=mine - max([*elsewhere, *two], default=0.0))

    def behind(self, sums: OnsetSums, failed: NDArray[np.bool_], motor: int, gamma: float) -> float:
        """By how many nats, beyond what tells hypotheses apart, ``motor`` alone and every pair with it are behind the
        best of the others; below 0: it goes on being believed."""
        sums, _, one_best, _ = _alone(sums, failed, gamma)
        pairs = self._pairs[~failed[self._pairs].any(axis=1)]
        two = hypotheses.pairs(sums.matrix, sums.vector, gamma, pairs[:, 0], pairs[:, 1])
        believed, other = self._ahead(motor, pairs, two.improvement.max(axis=0), one_best)
        return float(other - believed - needed(other, self.tuning))

    def suspects(self, sums: OnsetSums, failed: NDArray[np.bool_], gamma: float) -> bool:
        """Whether ``best`` finds any hypothesis."""
        _, _, one_best, first = _alone(sums, failed, gamma)
        return self._improves(one_best[first])

    def _improves(self, improvement: float) -> bool:
        return not improvement < self.tuning.look_share * self.tuning.improvement_min

    def direct(
        self, sums: OnsetSums, failed: NDArray[np.bool_], stopped: tuple[int, ...], gamma: float
    ) -> Hypothesis | None:
        """The hypothesis that exactly the motors ``stopped`` (indices), which stand still by their rotor speeds, have
        failed; None when the residual does not agree."""
        o = self.tuning
        sums = _without(sums, np.flatnonzero(failed))
        one = hypotheses.singles(sums.matrix, sums.vector, gamma)
        best = one_best = one.improvement.max(axis=0)
        if len(stopped) == 1:
            scores, index = one, stopped[0]
            others = _beside(one_best, index)
        else:
            first, second = (np.array([motor]) for motor in stopped)
            scores, index = hypotheses.pairs(sums.matrix, sums.vector, gamma, first, second), 0
            others = one_best
            best = scores.improvement.max(axis=0)
        rival = float(others.max()) if others.size else 0.0
        if best[index] < o.direct_min or rival - best[index] > o.direct_behind:
            return None
        found = self._describe(stopped, scores, index, sums, others, np.zeros(0))
        return found if min(found.loss) >= o.direct_loss_share * o.loss_sudden else None

    @staticmethod
    def _describe(
        motors: tuple[int, ...],
        scores: hypotheses.Scores,
        index: int,
        sums: OnsetSums,
        others: NDArray[np.float64],
        simpler: NDArray[np.float64],
    ) -> Hypothesis:
        window = int(scores.improvement[:, index].argmax())
        e = scores.e[window, index]
        improvement = float(scores.improvement[window, index])
        rivals = [float(array.max()) for array in (others, simpler) if array.size]
        chosen = list(motors)
        s = sums.matrix[window].take(chosen, axis=0).take(chosen, axis=1)
        fit = float(sums.vector[window].take(chosen) @ e - 0.5 * e @ s @ e)
        return Hypothesis(
            motors=tuple(int(i) for i in motors),
            loss=tuple(-float(value) for value in e),
            improvement=improvement,
            margin=improvement - max(rivals, default=0.0),
            explained=2.0 * fit / max(float(sums.energy[window]), 1e-12),
            age_s=float(sums.age_s[window]),
        )


def _beside(values: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    """All but one of them; numpy's own ``delete`` takes ten times as long."""
    return np.concatenate((values[:index], values[index + 1 :]))


def _alone(
    sums: OnsetSums, failed: NDArray[np.bool_], gamma: float
) -> tuple[OnsetSums, hypotheses.Scores, NDArray[np.float64], int]:
    """The sums without motors ``failed`` (m,) bool, each other motor alone, its improvement (m,) at its best onset, and
    the best of them."""
    sums = _without(sums, np.flatnonzero(failed))
    one = hypotheses.singles(sums.matrix, sums.vector, gamma)
    one_best = one.improvement.max(axis=0)
    return sums, one, one_best, int(one_best.argmax())


def _without(sums: OnsetSums, nuisance: NDArray[np.intp]) -> OnsetSums:
    """What is left when the motors ``nuisance`` (indices) are fitted freely."""
    matrix, vector, energy, _ = hypotheses.without_nuisance(sums.matrix, sums.vector, sums.energy, nuisance)
    return replace(sums, matrix=matrix, vector=vector, energy=energy)
