"""From hypotheses to declarations: which motors have failed, with confidence, hysteresis and a latch.

A declaration is made when one hypothesis (a motor, or a pair) explains the residual, no other does nearly as well,
and the loss is large. It latches: at u = 0 the data say nothing of a motor and the l1 term would bring its estimate
back to healthy. It is lifted by the operator, or by evidence while the motor is driven.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.ambiguity import Among, followed, needed
from nff_companion.core.mates import Mates
from nff_companion.core.tuning import DecisionTuning
from nff_companion.core.weighing import Hypothesis


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
    doubted_until_s: dict[int, float] = field(
        default_factory=dict
    )  # motors taken back: till then no window names them alone

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
    """Thresholds for an airframe with m motors and n axes."""

    def __init__(self, motors: int, axes: int, tuning: DecisionTuning, mates: Mates | None = None) -> None:
        self.tuning, self._mates = tuning, mates
        # With fewer motors than axes left nothing can be told apart, nor done about it.
        self.failed_max = max(1, min(tuning.failed_max, motors - axes))

    def closed(self, state: DecisionState) -> bool:
        """No more motor may be declared, nor will one be within what any declaration takes: none is about to be lifted
        by evidence, which takes longer. An operator's order to lift is not foreseen."""
        full = sum(state.failed.tolist()) >= self.failed_max
        return full and not state.healthy_since_s and self.tuning.lift_s > 2.0 * self.tuning.confirm_ambiguous_s

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
            doubted = state.doubted_until_s
            quiet = DecisionState(failed=np.zeros(len(eta), bool), either=state.either, doubted_until_s=doubted)
            return (state if state.quiet else quiet), []
        works = (eta, deviation.tolist(), driven.tolist())
        new = DecisionState(failed=state.failed, either=state.either, doubted_until_s=state.doubted_until_s)
        shown: list[float] = (driven if turned is None else turned).tolist()
        new.more = self._pulls_more(state, time_s, best)
        if best is not None and best.place and direct is None:
            events = self._either(state, new, time_s, best, shown)
        else:
            events = self._sudden(state, new, time_s, best, direct, shown)
        new.among = None if events or new.either != state.either else self._among(state, time_s, best)
        if best is not None and best.overruled:
            new.gradual_since_s = state.gradual_since_s
        elif not (new.more and new.more.told):
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
        if best is None or not self.convincing(best) or (best.shared and self.failed_max < 2):
            return []  # a vehicle that may not lose two has no pairs of which one motor is sure
        if len(best.motors) == 1 and time_s < state.doubted_until_s.get(best.motors[0], -math.inf):
            return []  # it was named and taken back a moment ago: nothing flaps
        if min(shown[i] for i in best.motors) < self.tuning.driven:
            return []  # what such a motor could lose is within what the others may be wrong by
        if new.more is not None and new.more.told:
            return []
        stands = state.among is not None and time_s - state.among.since_s >= self.tuning.among_size_s
        if stands and len(best.motors) > 1 and not best.moved:
            return []  # by now its size is the model's error: what moves tells which it is
        if best.motors == state.candidate:
            new.since_s = state.since_s
        wait = self.tuning.confirm_s if len(best.motors) == 1 else self.tuning.confirm_ambiguous_s
        if best.shared:
            wait = self.tuning.confirm_shared_s
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
        # That the other one is lost too takes the whole arm off: one that turns the wrong way looks like part of it.
        least = o.loss_settled if state.either else o.loss_sudden
        if not (lost and best.beside >= o.margin_min and sum(best.loss) >= least):
            return []
        if not state.either and best.place_loss < o.place_loss_min:
            return []
        if (best.shared and self.failed_max < 2) or (new.more is not None and new.more.told):
            return []
        if max(shown[i] for i in place) < o.driven or (state.either and state.either != place):
            return []
        new.candidate, new.since_s = place, state.since_s if state.candidate == place else time_s
        if time_s - new.since_s < (o.confirm_shared_s if best.shared else o.confirm_ambiguous_s) - 1e-9:
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
        stays. Where one of two is lost it is not asked: one of them that turns the wrong way takes more than it gives,
        which those across seem to add."""
        found: tuple[tuple[int, ...], ...] = ()
        if best is not None and best.more >= 0 and not state.either:
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
        if not lost or not any(len(motors) <= room and min(loss) >= o.loss_sudden for motors, loss in alike):
            return followed(state.among, time_s, (), o)
        return followed(state.among, time_s, tuple(motors for motors, _ in alike), o)

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
            and (sum(best.loss) >= o.loss_settled * len(best.loss) or not settled or best.moved)
        )
