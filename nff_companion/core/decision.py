"""From scores to declarations: which motors have failed, with confidence, hysteresis and a latch.

A declaration is made when one hypothesis (a motor, or a pair) explains the residual, no other does nearly as well,
and the loss is large. It latches: at u = 0 the data say nothing of a motor and the l1 term would bring its estimate
back to healthy. It is lifted by the operator, or by evidence while the motor is driven.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import hypotheses
from nff_companion.core.ambiguity import Among, followed, needed
from nff_companion.core.mates import Mates
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
    more: int = -1  # the motor that pulls more than it is asked to, where that explains better; -1: none
    moved: bool = False  # told from others by how the residual moves (core/evidence.py)
    # This one and those that explain as well, the best first: sets of motors with their losses. Empty: it leads.
    alike: tuple[tuple[tuple[int, ...], tuple[float, ...]], ...] = ()

    @property
    def confidence(self) -> float:
        """Probability against the next hypothesis."""
        return float(1.0 / (1.0 + np.exp(-min(self.margin, 50.0))))


@dataclass(frozen=True, slots=True)
class Event:
    """A declaration or its lifting. ``motor`` counts from 1."""

    time_s: float
    motor: int
    declared: bool
    effectiveness: float
    confidence: float


@dataclass(slots=True)
class DecisionState:
    """What is declared and what is being confirmed. Motors are indices from 0."""

    failed: NDArray[np.bool_]  # (m,) bool, latched
    either: tuple[int, ...] = ()  # one of these two, above each other, has failed; latched
    among: Among | None = None  # sets of motors of which one has failed
    more: Among | None = None  # a motor that seems to pull more than it is asked to, as the only set
    candidate: tuple[int, ...] = ()
    since_s: float = 0.0
    gradual_since_s: dict[int, float] = field(default_factory=dict)  # motors whose effectiveness is low, since when
    healthy_since_s: dict[int, float] = field(default_factory=dict)  # declared motors that work by the evidence

    @staticmethod
    def start(motors: int) -> DecisionState:
        """Nothing declared."""
        return DecisionState(failed=np.zeros(motors, bool))

    @property
    def quiet(self) -> bool:
        """Nothing is being confirmed."""
        weighed = self.candidate or self.gradual_since_s or self.healthy_since_s
        return not (weighed or self.among or self.more)


class Decision:
    """Thresholds and the hypotheses of an airframe with m motors."""

    def __init__(self, motors: int, axes: int, tuning: DecisionTuning, mates: Mates | None = None) -> None:
        self.tuning, self._mates = tuning, mates
        # With fewer motors than axes left nothing can be told apart, nor done about it.
        self.failed_max = max(1, min(tuning.failed_max, motors - axes))
        self._pairs = np.array(list(combinations(range(motors), 2)), int).reshape(-1, 2)

    def best(
        self, sums: OnsetSums, failed: NDArray[np.bool_], gamma: float, known: tuple[int, ...] = ()
    ) -> Hypothesis | None:
        """The hypothesis that explains the windows best, None when none improves enough. ``known``: motors of which it
        is known already that they pull more, or may."""
        o = self.tuning
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
            return self._against(self._of_place(found, pairs, two_best, one_best), most + o.pair_min, puller)
        # A pair on both sides of a motor can look like it: such a pair, with its lower prior, is a rival too.
        without = two_best[(pairs != first).all(axis=1)] - o.pair_min
        others = _beside(one_best, first)
        found = self._describe((first,), one, first, sums, others, without)
        return self._against(self._of_place(found, pairs, two_best, one_best), most, puller)

    def _against(self, found: Hypothesis, most: float, puller: int) -> Hypothesis:
        """``found``, with its margin over that the motor ``puller`` pulls more than it is asked to, which improves by
        ``most``: it turns the vehicle as the loss of those on the other side does."""
        ahead = most - found.improvement
        if -ahead >= found.margin:
            return found
        more = puller if ahead > self.tuning.margin_min and most > self.tuning.more_improvement_min else -1
        return replace(found, margin=-ahead, beside=min(found.beside, -ahead), alike=(), more=more)

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
        return replace(found, beside=found.improvement - max([*elsewhere, *two], default=0.0))

    def suspects(self, sums: OnsetSums, failed: NDArray[np.bool_], gamma: float) -> bool:
        """Whether ``best`` finds any hypothesis."""
        _, _, one_best, first = _alone(sums, failed, gamma)
        return self._improves(one_best[first])

    def _improves(self, improvement: float) -> bool:
        return not improvement < self.tuning.look_share * self.tuning.improvement_min

    def closed(self, state: DecisionState) -> bool:
        """No more motor may be declared, nor will one be within what any declaration takes: none is about to be lifted
        by evidence, which takes longer. An operator's order to lift is not foreseen."""
        full = sum(state.failed.tolist()) >= self.failed_max
        return full and not state.healthy_since_s and self.tuning.lift_s > 2.0 * self.tuning.confirm_ambiguous_s

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

    def step(
        self,
        state: DecisionState,
        time_s: float,
        best: Hypothesis | None,
        effectiveness: NDArray[np.float64],
        deviation: NDArray[np.float64],
        driven: NDArray[np.float64],
        direct: Hypothesis | None = None,
        turned: NDArray[np.float64] | None = None,
    ) -> tuple[DecisionState, list[Event]]:
        """One sample. ``effectiveness`` (m,) and ``deviation`` of the sparse estimate (of latched motors: their free
        coefficient); ``driven`` (m,) thrust fractions that the motors are asked for; ``direct``: named by rotor
        speeds, and the residual agrees; ``turned`` (m,): mean thrust fractions of the last moments, None: as
        ``driven``."""
        before: list[bool] = state.failed.tolist()
        eta: list[float] = effectiveness.tolist()
        told = best is None and direct is None and state.among is None and state.more is None
        if told and True not in before and min(eta) > 1.0 - self.tuning.loss_gradual:
            quiet = DecisionState(failed=np.zeros(len(eta), bool), either=state.either)
            return (state if state.quiet else quiet), []
        works = (eta, deviation.tolist(), driven.tolist())
        new = DecisionState(failed=state.failed, either=state.either)
        shown: list[float] = (driven if turned is None else turned).tolist()
        new.more = self._pulls_more(state, time_s, best)
        if best is not None and best.place and direct is None:
            events = self._either(state, new, time_s, best, shown)
        else:
            events = self._sudden(state, new, time_s, best, direct, shown)
        new.among = None if events else self._among(state, time_s, best)
        if not (new.more and new.more.told):
            events += self._gradual(state, new, time_s, *works)
        if True in before:
            events += self._lift(state, new, time_s, *works)
        return new, events

    def _sudden(
        self,
        state: DecisionState,
        new: DecisionState,
        time_s: float,
        best: Hypothesis | None,
        direct: Hypothesis | None,
        shown: list[float],
    ) -> list[Event]:
        """Losses that the onset windows show; what is being confirmed goes into ``new``."""
        room = self.failed_max - sum(state.failed.tolist())
        new.since_s = time_s
        if direct is not None and len(direct.motors) <= room:
            return self._declare(new, time_s, direct, 1.0)
        if best is None or not self.convincing(best):
            return []
        if min(shown[i] for i in best.motors) < self.tuning.driven:
            return []  # what such a motor could lose is within what the others may be wrong by
        if new.more is not None and new.more.told:
            return []
        if best.motors == state.candidate:
            new.since_s = state.since_s
        wait = self.tuning.confirm_s if len(best.motors) == 1 else self.tuning.confirm_ambiguous_s
        if time_s - new.since_s >= wait - 1e-9 and len(best.motors) <= room:
            return self._declare(new, time_s, best, best.confidence)
        new.candidate = best.motors
        return []

    def _either(
        self,
        state: DecisionState,
        new: DecisionState,
        time_s: float,
        best: Hypothesis,
        shown: list[float],
    ) -> list[Event]:
        """One of two motors above each other: which of them is not told. Where one was believed lost already, both."""
        o, place = self.tuning, best.place
        lost = best.improvement >= o.improvement_min and best.explained >= o.explained_min
        if not (lost and best.beside >= o.margin_min and sum(best.loss) >= o.loss_sudden):
            return []
        if max(shown[i] for i in place) < o.driven or (state.either and state.either != place):
            return []
        new.candidate, new.since_s = place, state.since_s if state.candidate == place else time_s
        if time_s - new.since_s < o.confirm_ambiguous_s - 1e-9:
            return []
        new.candidate = ()
        if not state.either:
            new.either = place
            return []
        new.either = ()
        both = replace(best, motors=place, loss=(1.0, 1.0))
        return (
            self._declare(new, time_s, both, best.confidence)
            if self.failed_max - sum(state.failed.tolist()) > 1
            else []
        )

    def _pulls_more(self, state: DecisionState, time_s: float, best: Hypothesis | None) -> Among | None:
        """A motor that pulls more than it is asked to, or one of two above each other, while that explains best. What
        it makes of the flight looks like losses of others then, and later like another that pulls more: the first
        stays."""
        found: tuple[tuple[int, ...], ...] = ()
        if best is not None and best.more >= 0:
            place = () if self._mates is None else self._mates.place((best.more,))
            found = (place or (best.more,),)
            if state.more is not None and state.more.told:
                found = state.more.sets
        return followed(state.more, time_s, found, self.tuning)

    def _among(self, state: DecisionState, time_s: float, best: Hypothesis | None) -> Among | None:
        """Sets of motors of which one is lost, where it cannot be told which: one of them would be declared, did it
        lead."""
        o, alike = self.tuning, () if best is None else best.alike
        lost = best is not None and best.explained >= o.explained_min
        room = self.failed_max - sum(state.failed.tolist())
        if not lost or not any(len(motors) <= room and self._large(loss) for motors, loss in alike):
            return followed(state.among, time_s, (), o)
        return followed(state.among, time_s, tuple(motors for motors, _ in alike), o)

    def _large(self, loss: tuple[float, ...]) -> bool:
        """Whether so much of two motors is lost as declares them."""
        o = self.tuning
        return min(loss) >= o.loss_sudden and sum(loss) >= o.loss_settled * len(loss)

    @staticmethod
    def _declare(new: DecisionState, time_s: float, found: Hypothesis, confidence: float) -> list[Event]:
        new.failed = new.failed.copy()
        new.failed[list(found.motors)] = True
        return [
            Event(time_s, motor + 1, True, 1.0 - loss, confidence)
            for motor, loss in zip(found.motors, found.loss, strict=True)
        ]

    def _gradual(
        self,
        state: DecisionState,
        new: DecisionState,
        time_s: float,
        eta: list[float],
        deviation: list[float],
        driven: list[float],
    ) -> list[Event]:
        """Gradual losses, by the sparse estimate alone: of one motor, while the others are whole. Several partial
        losses at once have look-alikes, and are what air that the model does not know looks like."""
        o = self.tuning
        failed: list[bool] = new.failed.tolist()
        left = [i for i, declared in enumerate(failed) if not declared]
        if sum(1.0 - eta[i] > o.loss_others for i in left) != 1:
            return []
        sure = [i for i in left if deviation[i] < o.deviation_gradual_max and driven[i] > o.driven]
        low = [i for i in sure if 1.0 - eta[i] > o.loss_gradual]
        new.gradual_since_s = {i: state.gradual_since_s.get(i, time_s) for i in low}
        ready = [i for i, since_s in new.gradual_since_s.items() if time_s - since_s >= o.confirm_gradual_s]
        if len(ready) != 1 or sum(failed) >= self.failed_max:
            return []
        motor = ready[0]
        new.failed = new.failed.copy()
        new.failed[motor] = True
        doubt = min(max(deviation[motor] / (1.0 - eta[motor]), 0.0), 1.0)
        return [Event(time_s, motor + 1, True, eta[motor], 1.0 - doubt * doubt)]

    def _lift(
        self,
        state: DecisionState,
        new: DecisionState,
        time_s: float,
        eta: list[float],
        deviation: list[float],
        driven: list[float],
    ) -> list[Event]:
        """Evidence that a declared motor works while it is driven."""
        o = self.tuning
        declared = [i for i, failed in enumerate(state.failed.tolist()) if failed]
        sure = [i for i in declared if deviation[i] < o.deviation_lift_max and driven[i] > o.driven]
        well = [i for i in sure if eta[i] > o.lift_effectiveness]
        new.healthy_since_s = {i: state.healthy_since_s.get(i, time_s) for i in well}
        lifted = [i for i, since_s in new.healthy_since_s.items() if time_s - since_s >= o.lift_s]
        if lifted:
            new.failed = new.failed.copy()
            new.failed[lifted] = False
        return [Event(time_s, i + 1, False, eta[i], 1.0) for i in lifted]

    def convincing(self, best: Hypothesis) -> bool:
        """Whether it would be declared once it has led for long enough and there is room."""
        o = self.tuning
        settled = best.age_s > o.settled_s or len(best.motors) > 1
        lead = o.moved_margin_min if best.moved else needed(best.improvement, o)
        return (
            best.improvement >= o.improvement_min
            and best.margin >= lead
            and best.explained >= o.explained_min
            and min(best.loss) >= o.loss_sudden
            and (sum(best.loss) >= o.loss_settled * len(best.loss) or not settled)
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
