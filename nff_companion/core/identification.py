"""Which motors are lost: from what a sample shows to hypotheses, and from those to declarations.

    weighed   the hypotheses, where the residual is suspicious; while a set of them stands, what has been seen since
    decided   what is declared; for a moment after a declaration, whether it is taken back

Parts: core/onset.py, core/weighing.py, core/evidence.py, core/mates.py, core/decision.py, core/second_look.py. Pure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import hypotheses, works_again
from nff_companion.core.decision import Decision, DecisionState, Event
from nff_companion.core.estimate import EstimatorState, Measurement, Seen, Weighed
from nff_companion.core.evidence import Evidence
from nff_companion.core.filters import LowPass
from nff_companion.core.mates import Mates
from nff_companion.core.onset import OnsetBank, OnsetState
from nff_companion.core.second_look import SecondLook
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import GRAVITY_M_S2, Vehicle
from nff_companion.core.weighing import Hypothesis, Weighing


@dataclass(frozen=True, slots=True)
class Decided:
    """What is declared after a sample, and with which windows it goes on."""

    decision: DecisionState
    events: list[Event]
    onset: OnsetState
    second_look: SecondLook | None


class Identification:
    """Constants of one airframe and sample time."""

    def __init__(
        self,
        vehicle: Vehicle,
        dt_s: float,
        low_pass: LowPass | None,
        tuning: Tuning,
        *,
        joint: float = 0.0,
        judged: bool = False,
    ) -> None:
        """``low_pass`` of the residual; ``joint`` and ``judged`` as of the estimator."""
        o = self._tuning = tuning
        self._motors, self._axes, self._judged = vehicle.motors, vehicle.axes, judged
        self.onset = OnsetBank(vehicle, dt_s, low_pass, o, joint=joint)
        self._per_sample = dt_s / o.disturbance.correlation_s
        self._doubt = np.array(o.onset.together_error_share)
        mates = Mates(vehicle, o)
        self._mates = mates if mates.any and not judged else None  # a log's verdict names a motor
        self._weighing = Weighing(vehicle.motors, o.decision, self._mates)
        self._decision = Decision(vehicle.motors, vehicle.axes, o.decision, self._mates)

    def place(self, motors: tuple[int, ...]) -> tuple[int, ...]:
        """The two motors (indices) above each other that ``motors`` are, or are of; empty: there are none."""
        return () if self._mates is None else self._mates.place(motors)

    def weighed(self, state: EstimatorState, seen: Seen, onset: OnsetState, measurement: Measurement) -> Weighed:
        """The hypotheses of a sample; ``onset`` with it."""
        if measurement.time_s < max(state.begin_until_s, state.anew_until_s):
            return Weighed()
        found = self._weigh(state, seen, onset, measurement)
        best = found.best
        joined = state.begin_until_s < state.started_s and measurement.time_s < state.fast_until_s
        since_s = measurement.time_s if state.suspicious_since_s is None else state.suspicious_since_s
        crept = measurement.time_s - since_s > self._tuning.decision.pair_sudden_s
        if (joined or crept) and best is not None and len(best.motors) > 1 and not best.overruled:
            # Of a flight that is under way nothing is learnt yet, and two motors do not stop little by little: the file
            # may have as much wrong. Two are a set then, told by what moves.
            alike = best.alike or ((best.motors, best.loss),)
            found = replace(found, best=replace(best, margin=0.0, beside=0.0, alike=alike))
        found = self._longer(state, seen, found, measurement.time_s)
        best = self._placed(state, seen, found.best)
        return found if best is found.best else replace(found, best=best)

    def decided(
        self,
        state: EstimatorState,
        seen: Seen,
        weighed: Weighed,
        onset: OnsetState,
        steady: NDArray[np.float64],
        measurement: Measurement,
        effectiveness: NDArray[np.float64],
        deviation: NDArray[np.float64],
    ) -> Decided:
        """What is declared; ``effectiveness`` and ``deviation`` (m,) of the sparse program, ``steady`` (m,) the slow
        part of w with the sample."""
        time_s, best = measurement.time_s, weighed.best
        if weighed.refuted:
            return Decided(replace(state.decision, among=None, candidate=()), [], self.onset.start(), None)
        turned = None if best is None else self.onset.worked(onset)
        decision, events = self._decision.step(
            state.decision, time_s, best, effectiveness, deviation, measurement.command, weighed.direct, turned
        )
        look = state.second_look
        if look is not None and not events and decision.either == state.decision.either:
            if measurement.stopped is not None and measurement.stopped[look.motor]:
                return Decided(decision, [], onset, None)  # it stands still by its speed
            return self._looked_again(look, state, seen, decision, onset, steady, time_s)
        second_look = None if not events else self._to_look_again(state, onset, events, weighed, time_s)
        if any(event.declared for event in events) or decision.either != state.decision.either:
            # What is left of the old residual belongs to the motors just declared; a new failure starts afresh.
            onset = self.onset.start()
        return Decided(decision, events, onset, second_look)

    def _weigh(self, state: EstimatorState, seen: Seen, onset: OnsetState, measurement: Measurement) -> Weighed:
        """The hypotheses, where the residual is suspicious."""
        failed, stopped = state.decision.failed, measurement.stopped
        hint: tuple[int, ...] = ()
        if stopped is not None and True in stopped.tolist():
            hint = tuple(np.flatnonzero(stopped & ~failed).tolist())
        largest = max((seen.residual * seen.residual * seen.noise_weight).tolist())
        if not hint and largest * self._tuning.disturbance.correlation_s <= self._tuning.estimator.suspicious**2:
            return Weighed()
        unknown = seen.variance + state.curve.variance * seen.bent * seen.bent
        sums = self.onset.sums(onset, seen.effectiveness_matrix, unknown, self._yaw_error(state, seen))
        gamma = self._tuning.onset.gamma_onset
        if self._judged and self._decision.closed(state.decision) and self._learns_alike(state, measurement.time_s):
            return Weighed(self._weighing.suspects(sums, failed, gamma))
        direct = self._weighing.direct(sums, failed, hint, gamma) if 1 <= len(hint) <= 2 else None
        # Of one of two half is believed lost: where that one works again both seem to pull more.
        either = state.decision.either
        best = self._weighing.best(sums, failed, gamma, either)
        if best is not None and direct is None and not either and True not in failed.tolist():
            # A battery that sags takes from all what a few seem to lack; what is balanced turns the vehicle with it.
            everyone = tuple(range(len(failed)))
            less = hypotheses.together(sums.matrix, -sums.vector, everyone, 1.0)
            if less - best.improvement >= self._tuning.decision.margin_min:
                return Weighed(alike=True)
        if either and best is not None:
            best = works_again.beside(best, sums, either, failed, gamma, self._tuning.decision)
        weak = state.partial_loss.told
        again = hypotheses.together(sums.matrix, sums.vector, weak, 1.0) if weak else 0.0
        return Weighed(best is not None, best, direct, again=again)

    def _learns_alike(self, state: EstimatorState, time_s: float) -> bool:
        """Whether the speed of learning is the same however sure the best hypothesis is."""
        o = self._tuning.estimator
        since_s = 0.0 if state.suspicious_since_s is None else time_s - state.suspicious_since_s
        return not min(o.freeze_max_s, o.freeze_sure_s) <= since_s < max(o.freeze_max_s, o.freeze_sure_s)

    def _yaw_error(self, state: EstimatorState, seen: Seen) -> float:
        """Yaw torque not modelled, as a share of roll and pitch torque: the rotors' side drag."""
        lateral = math.hypot(*seen.filtered.lateral_slow_m_s2.tolist())
        doubt = self._tuning.disturbance.share_doubt
        return math.sqrt(state.side_drag.variance + doubt * doubt) * lateral / GRAVITY_M_S2

    def _longer(self, state: EstimatorState, seen: Seen, weighed: Weighed, time_s: float) -> Weighed:
        """While a set of losses cannot be told apart: with the one of them as the best by which the residual moves,
        where that is certain. And where losses go on being suspected: whether it moves with them at all."""
        among, best, o = state.decision.among, weighed.best, self._tuning.decision
        told = among is not None and among.told
        since_s = state.suspicious_since_s
        if not told and (
            since_s is None or time_s - since_s < o.among_size_s or True in state.decision.failed.tolist()
        ):
            return weighed
        evidence, limit = state.evidence, self._tuning.estimator.suspicious
        if evidence is None or evidence.before(time_s, seen.variance, limit, o.among_block_s):
            evidence = Evidence.none(self._axes, self._motors, time_s)  # what was seen speaks of before
        happens = evidence.over(seen.residual, seen.variance, limit)
        w, matrix = seen.filtered.thrust_shown, seen.effectiveness_matrix
        each = matrix * (w - state.steady)
        doubt = self._tuning.onset.single_error_share**2 * np.add.reduce(each * each, axis=1)
        weight = self._per_sample / (seen.variance + doubt)
        evidence = evidence.grown(time_s, matrix * w, seen.residual, weight, o.among_block_s)
        sets = among.sets if told and among is not None else () if best is None else (best.motors,)
        if best is None or not sets:
            return replace(weighed, evidence=evidence)
        found = evidence.told(sets, self._tuning.onset.gamma_onset)
        moved = replace(best, motors=found.motors, loss=found.loss, margin=found.ahead, beside=found.ahead)
        moved = replace(moved, more=-1, moved=True, alike=())
        if told and self._decision.convincing(moved):
            return replace(weighed, best=moved, evidence=evidence)
        if found.improvement < -o.among_refuted_min and not happens:
            return Weighed(refuted=True)
        return replace(weighed, evidence=evidence)

    def _placed(self, state: EstimatorState, seen: Seen, best: Hypothesis | None) -> Hypothesis | None:
        """With the two motors above each other that ``best`` is about, where it cannot be told which."""
        place = () if best is None else self.place(best.motors)
        if self._mates is None or best is None or not place:
            return best
        w, lateral = seen.filtered.thrust_shown, math.hypot(*seen.filtered.lateral_slow_m_s2.tolist())
        doubtful = self._doubt * seen.effectiveness_matrix.dot(w - state.steady)
        alone = len(best.motors) == 1
        told = alone and self._mates.told_apart(best.motors[0], w, seen.residual, lateral, doubtful)
        if told:
            return best
        # While the vehicle turns one of the two is driven far more: a part of what it gives is all that the other does.
        lost = sum(share * float(w[motor]) for motor, share in zip(best.motors, best.loss, strict=True))
        most = max(float(w[motor]) for motor in place)
        return replace(best, place=place, place_loss=min(lost / most, 1.0) if most > 0.0 else 1.0)

    def _to_look_again(
        self, state: EstimatorState, onset: OnsetState, events: list[Event], weighed: Weighed, time_s: float
    ) -> SecondLook | None:
        """At a motor named by what the windows show, where two might have been."""
        failed, best = state.decision.failed, weighed.best
        if len(events) != 1 or not events[0].declared or best is None or weighed.direct is not None:
            return None
        motor = events[0].motor - 1
        if best.motors != (motor,) or sum(failed.tolist()) + 2 > self._decision.failed_max:
            return None
        return SecondLook(onset, failed, motor, time_s + self._tuning.decision.second_look_s)

    def _looked_again(
        self,
        look: SecondLook,
        state: EstimatorState,
        seen: Seen,
        decision: DecisionState,
        onset: OnsetState,
        steady: NDArray[np.float64],
        time_s: float,
    ) -> Decided:
        """Takes back what was just declared, where something else explains all that was seen since the loss began; the
        windows then are those from before it."""
        w, matrix = seen.filtered.thrust_shown, seen.effectiveness_matrix
        residual = look.residual(seen.residual, matrix, w)
        earlier = self.onset.push(look.onset, w, residual, matrix, steady)
        if time_s >= look.until_s or not decision.failed[look.motor]:
            return Decided(decision, [], onset, None)
        sums = self.onset.sums(earlier, matrix, seen.variance, self._yaw_error(state, seen))
        behind = self._weighing.behind(sums, look.failed, look.motor, self._tuning.onset.gamma_onset)
        if behind < 0.0:
            return Decided(decision, [], onset, look)
        doubted = decision.doubted_until_s | {look.motor: time_s + self._tuning.decision.doubted_s}
        start = DecisionState.start(self._motors)
        taken_back = replace(start, failed=look.failed, either=decision.either, doubted_until_s=doubted)
        return Decided(taken_back, [Event(time_s, look.motor + 1, False, 1.0, 1.0)], earlier, None)
