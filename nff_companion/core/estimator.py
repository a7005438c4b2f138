"""One step of estimation: telemetry in; residual, sparse effectiveness and decisions out.

    residual    y = x' - f(x) - B0 w, of the motors that are not declared
    explain     y - phi a, and W from how large it usually is
    accumulate  S, q of the sparse program, and the windows of the onsets
    weigh       the hypotheses, where the residual is suspicious; e by the sparse program, 100 times a second
    decide      what is declared
    learn       a and the rotors' share of the drag, from what no motor explains

No clock, no input or output. What is handed out never changes afterwards; a state is used up by its step.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import partial_loss, sparse
from nff_companion.core.balance import Balance, BalanceState
from nff_companion.core.curve import Curve
from nff_companion.core.decision import DecisionState
from nff_companion.core.disturbance import Basis, Disturbance, DisturbanceState, SideDragState, learn_side_drag
from nff_companion.core.estimate import Estimate, EstimatorState, Measurement, Motion, Seen, Weighed
from nff_companion.core.features import features
from nff_companion.core.filters import lag_share
from nff_companion.core.identification import Decided, Identification
from nff_companion.core.mates import HALF
from nff_companion.core.onset import OnsetState
from nff_companion.core.partial_loss import PartialLossState
from nff_companion.core.residual import ResidualFilter
from nff_companion.core.slid_load import SlidLoad, SlidLoadState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import YAW, Vehicle
from nff_companion.core.weighing import Hypothesis
from nff_companion.errors import SolverError

__all__ = ["Estimate", "Estimator", "EstimatorState", "Measurement", "Motion"]


class Estimator:
    """Constants of one airframe and sample time."""

    def __init__(
        self,
        vehicle: Vehicle,
        dt_s: float,
        tuning: Tuning | None = None,
        network: Basis | None = None,
        *,
        identify: bool = True,
        joint: float = 0.0,
        judged: bool = False,
    ) -> None:
        """``network`` None: a constant basis. ``identify`` False: no loss is looked for, total or partial. ``joint``:
        0, phi a first, then losses; else together, phi a off by so many deviations (docs/learning.md). ``judged``: of
        a log, in which no operator lifts a declaration: what matters only then is left out."""
        o = self.tuning = tuning or Tuning()
        self.vehicle, self.dt_s, self.network, self.identify = vehicle, dt_s, network, identify
        self._filter = ResidualFilter(vehicle, dt_s, o.residual)
        self._disturbance = Disturbance(vehicle, network, o, bounded=identify)
        self._balance = Balance(vehicle, o.balance, o.disturbance.correlation_s)
        self._curve = Curve(o.curve, o.disturbance.correlation_s)
        self._identification = Identification(vehicle, dt_s, self._filter.low_pass, o, joint=joint, judged=judged)
        self._onset = self._identification.onset
        self._slid_load = SlidLoad(vehicle.motors, o.slid_load, o.estimator.clear_loss, o.decision.loss_sudden)
        self._steady = lag_share(dt_s, o.estimator.steady_s)
        self._doubt, self._none = np.array(o.onset.together_error_share), np.zeros(vehicle.axes)

    def start(
        self,
        time_s: float,
        gyro: NDArray[np.float64],
        specific_force: NDArray[np.float64],
        command: NDArray[np.float64],
        failed: NDArray[np.bool_] | None = None,
        *,
        takes_off: bool = False,
    ) -> EstimatorState:
        """State at the first sample of a flight, or after a gap of one; ``failed`` (m,) bool are declarations taken
        over. ``takes_off``: it has just left the ground, so that what is off now is off by the file."""
        m = self.vehicle.motors
        decision = DecisionState.start(m)
        if failed is not None:
            decision.failed = failed.copy()
        return EstimatorState(
            residual=self._filter.start(gyro, specific_force, command),
            disturbance=self._disturbance.start(),
            side_drag=SideDragState.start(self.tuning.disturbance),
            balance=self._balance.start(time_s),
            curve=self._curve.start(time_s),
            information=sparse.Information.empty(m),
            onset=self._onset.start(),
            steady=command.copy(),
            decision=decision,
            started_s=time_s,
            fast_until_s=time_s + self.tuning.estimator.learn_fast_s,
            begin_until_s=time_s + self.tuning.estimator.begin_s if takes_off else -math.inf,
            anew_until_s=-math.inf,
            quiet_since_s=None,
            suspicious_since_s=None,
            solved_s=-math.inf,
            effectiveness=np.ones(m),
            deviation=np.ones(m),
        )

    def step(self, state: EstimatorState, measurement: Measurement) -> tuple[EstimatorState, Estimate]:
        """One sample. Raises SolverError."""
        time_s, failed = measurement.time_s, measurement.failed
        if failed is not None and state.decision.failed is not failed:
            same = bool((state.decision.failed == failed).all())
            state = replace(state, decision=replace(state.decision, failed=failed))
            state = state if same else _ordered(state)
        if state.decision.either != measurement.either:
            state = _ordered(replace(state, decision=replace(state.decision, either=measurement.either)))
        seen = self._explain(state, measurement)
        information, onset, steady, weight = self._accumulate(state, seen, measurement.dt_s)
        weighed = Weighed()
        solved_s, effectiveness, deviation = state.solved_s, state.effectiveness, state.deviation
        decided, load = Decided(state.decision, [], onset, None), state.slid_load
        if load is not None:
            lost = seen.effectiveness_matrix * seen.filtered.thrust_shown
            load = self._slid_load.grown(load, lost, seen.residual, weight, measurement.dt_s)
        if self.identify:
            weighed = self._identification.weighed(state, seen, onset, measurement)
            if time_s - solved_s >= self.tuning.sparse.solve_interval_s - 1e-9:
                solved_s = time_s
                effectiveness = sparse.effectiveness(information, state.decision.failed, self.tuning.sparse)
                deviation = sparse.deviation(information, self.tuning.sparse.prior_deviation)
                load = self._slid_load.looked(load, time_s, effectiveness, state.decision.failed)
                if load is not None and load.slid:
                    effectiveness = np.where(state.decision.failed, effectiveness, 1.0)
            decided = self._identification.decided(
                state, seen, weighed, onset, steady, measurement, effectiveness, deviation
            )
        decision, events, best = decided.decision, decided.events, weighed.best
        taken_back = state.second_look is not None and bool(events)
        if taken_back or any(event.declared for event in events) or decision.either != state.decision.either:
            information, load = sparse.Information.empty(self.vehicle.motors), None
        suspicious_since_s = _suspected(state, time_s, weighed, load)
        rate = self._learning_rate(state, time_s, suspicious_since_s, best)
        fast_until_s, quiet_since_s = self._settling(state, seen, time_s)
        weak = self._weak(state, time_s, decision, weighed, load, settled=time_s >= fast_until_s)
        among = decision.among if decision.among is not None and decision.among.told else None
        anew_until_s, onset = state.anew_until_s, decided.onset
        if weighed.refuted:
            anew_until_s = time_s + self.tuning.estimator.begin_s
        if weighed.alike or time_s < anew_until_s:
            information = sparse.Information.empty(self.vehicle.motors)
            effectiveness = np.where(decision.failed, effectiveness, 1.0)
        if time_s < anew_until_s:
            # No motor is lost by how the residual moves: what explained it is the file's, and learnt at once.
            rate, onset = self.tuning.estimator.begin_rate, self._onset.start()
        more = decision.more.sets[0] if decision.more is not None and decision.more.told else ()
        if among is not None or more:
            rate = 0.0  # what was learnt beside one of the sets would speak for it
        disturbance, side_drag = self._learn(state, seen, measurement, rate, effectiveness, decision.failed)
        balance = self._balanced(state, seen, measurement, rate, decision)
        curve = state.curve
        if rate == 1.0 and seen.bent is not self._none and among is None:
            curve = self._curve.learn(curve, time_s, seen.residual, seen.bent, seen.variance)
        new = EstimatorState(
            residual=seen.filtered,
            disturbance=disturbance,
            side_drag=side_drag,
            balance=balance,
            curve=curve,
            information=information,
            onset=onset,
            steady=steady,
            decision=decision,
            started_s=state.started_s,
            fast_until_s=fast_until_s,
            begin_until_s=state.begin_until_s,
            anew_until_s=anew_until_s,
            quiet_since_s=quiet_since_s,
            suspicious_since_s=suspicious_since_s,
            solved_s=solved_s,
            effectiveness=effectiveness,
            deviation=deviation,
            second_look=decided.second_look,
            evidence=weighed.evidence,
            slid_load=load,
            partial_loss=weak,
        )
        if decision.more is not None or (best is not None and best.overruled):
            effectiveness = np.where(decision.failed, effectiveness, 1.0)  # what others seem to lack it does too much
        if decision.either:
            effectiveness = effectiveness.copy()
            effectiveness[list(decision.either)] = HALF
        estimate = Estimate(
            effectiveness=effectiveness,
            deviation=deviation,
            failed=decision.failed,
            either=decision.either,
            among=() if among is None else among.sets,
            more=more,
            raw=seen.balanced + seen.unbalanced + seen.turned + state.curve.bend * seen.bent,
            residual=seen.residual,
            disturbance=seen.unbalanced + seen.expectation.believed,
            features=seen.features,
            thrust_shown=seen.filtered.thrust_shown,
            lateral_m_s2=seen.filtered.lateral_slow_m_s2,
            best=best,
            events=events,
            settled=time_s >= fast_until_s,
            weak=weak.told,
            weak_left=1.0 - weak.told_loss,
            weak_shows=bool(weak.told) and weak.motors == weak.told,
            balance=state.balance.share,
            gain=state.balance.gain,
            bend=state.curve.bend,
            variance=seen.variance,
        )
        _shut(estimate)
        return new, estimate

    def _explain(self, state: EstimatorState, measurement: Measurement) -> Seen:
        """y, what of it is expected, and W. Raises SolverError where the residual is not finite."""
        motion, failed = measurement.motion, state.decision.failed
        filtered = self._filter.step(
            state.residual, measurement.gyro, measurement.specific_force, measurement.command, measurement.dt_s
        )
        side_drag = self._filter.side_drag(filtered)
        matrix = self._filter.effectiveness_matrix(state.balance.matrix, side_drag, state.side_drag.share)
        thrust_left = filtered.thrust_shown
        bent, either = self._none, state.decision.either
        if True in failed.tolist() or either:
            thrust_left = np.where(failed, 0.0, thrust_left)
            thrust_left[list(either)] *= HALF
            bent = self._curve.shown(matrix, thrust_left)
        lift_m_s2 = self._balance.lift_m_s2(thrust_left)
        unbalanced = state.balance.share * lift_m_s2
        turned = self._balance.turned(state.balance, thrust_left)
        whole = matrix.dot(thrust_left)
        balanced = filtered.measured - whole - state.curve.bend * bent
        seen = None
        if motion is not None:
            lateral, rate = filtered.lateral_m_s2, filtered.rate_rad_s
            seen = features(motion.velocity_m_s, motion.quaternion, lateral, rate, whole - unbalanced - turned)
        basis = self._disturbance.basis(state.disturbance, seen, measurement.dt_s)
        expectation = self._disturbance.expect(state.disturbance, basis)
        residual = balanced - expectation.believed
        if not math.isfinite(sum(residual.tolist())):
            raise SolverError(f"residual {residual} is not finite; the estimate starts anew")
        variance = self._disturbance.variance(state.disturbance)
        return Seen(
            filtered=filtered,
            side_drag=side_drag,
            effectiveness_matrix=matrix,
            thrust_left=thrust_left,
            lift_m_s2=lift_m_s2,
            unbalanced=unbalanced,
            turned=turned,
            bent=bent,
            balanced=balanced,
            features=seen,
            expectation=expectation,
            residual=residual,
            variance=variance,
            noise_weight=1.0 / (variance * self.tuning.disturbance.correlation_s),
        )

    def _accumulate(
        self, state: EstimatorState, seen: Seen, dt_s: float
    ) -> tuple[sparse.Information, OnsetState, NDArray[np.float64], NDArray[np.float64]]:
        """S and q, the history of the onsets, and the slow part of w, with this sample; and its weight (n,)."""
        w, matrix = seen.filtered.thrust_shown, seen.effectiveness_matrix
        # What the motors turn beyond their steady part the file may have wrong: of that much nothing is evidence.
        doubtful = self._doubt * matrix.dot(w - state.steady)
        unknown = doubtful * doubtful + state.curve.variance * seen.bent * seen.bent
        weight = 1.0 / (1.0 / seen.noise_weight + self.tuning.disturbance.correlation_s * unknown)
        forgetting = self.tuning.sparse.forgetting_per_s
        information = sparse.update(state.information, matrix * w, seen.residual, weight, dt_s, forgetting)
        steady = state.steady + self._steady * (w - state.steady)
        return information, self._onset.push(state.onset, w, seen.residual, matrix, steady), steady, weight

    def _learn(
        self,
        state: EstimatorState,
        seen: Seen,
        measurement: Measurement,
        rate: float,
        effectiveness: NDArray[np.float64],
        failed: NDArray[np.bool_],
    ) -> tuple[DisturbanceState, SideDragState]:
        """a, and the rotors' share of the drag, from what no motor explains."""
        rest, dt_s = seen.balanced, measurement.dt_s
        explained = self._explained(effectiveness, failed) if self.identify else None
        if explained is not None:
            rest = rest - seen.effectiveness_matrix.dot(seen.filtered.thrust_shown * explained)
        disturbance = self._disturbance.learn(
            state.disturbance,
            seen.expectation,
            rest,
            dt_s,
            rate,
            measurement.allocation_norm,
            measurement.tracking_error,
            float(seen.filtered.rate_rad_s[2]) * dt_s,
        )
        if rate != 1.0:
            return disturbance, state.side_drag
        slope, yaw = float(seen.side_drag.dot(seen.thrust_left)), float(seen.residual[YAW])
        variance = float(disturbance.variance[YAW])
        return disturbance, learn_side_drag(state.side_drag, slope, yaw, variance, dt_s, self.tuning.disturbance)

    def _balanced(
        self, state: EstimatorState, seen: Seen, measurement: Measurement, rate: float, decision: DecisionState
    ) -> BalanceState:
        """What flight shows of lift, centre of mass and gains. At the beginning of a flight only a motor that is about
        to be declared stops it: what was there all the time is the file's error sooner than a failure."""
        time_s, balance = measurement.time_s, state.balance
        if (
            not self._balance.due(balance, time_s)
            or True in decision.failed.tolist()
            or decision.either
            or decision.among
            or decision.more
        ):
            return balance
        settling = time_s < state.fast_until_s
        if decision.candidate if settling else rate != 1.0:
            return balance
        gains = None if settling else measurement.gains
        return self._balance.learn(balance, time_s, seen.residual, seen.lift_m_s2, seen.variance, gains)

    def _explained(self, effectiveness: NDArray[np.float64], failed: NDArray[np.bool_]) -> NDArray[np.float64] | None:
        """Share (m,) of each motor's thrust that the motors explain, so that the disturbance does not learn it
        too: the loss of a few, and what declared motors still give. None: nothing."""
        o, eta, declared = self.tuning.estimator, effectiveness.tolist(), failed.tolist()
        if min(eta) >= 1.0 - o.clear_loss and True not in declared:
            return None
        lost = [not gone and e - 1.0 < -o.clear_loss for e, gone in zip(eta, declared, strict=True)]
        few = 0 < sum(lost) <= o.few
        if not few and True not in declared:
            return None
        each = zip(eta, declared, lost, strict=True)
        return np.array([e if gone else (e - 1.0 if few and low else 0.0) for e, gone, low in each])

    def _settling(self, state: EstimatorState, seen: Seen, time_s: float) -> tuple[float, float | None]:
        """Until when the start of a flight is learnt quickly, and since when y has been small: once it is, what comes
        quickly is no error of the file, and must not be learnt away before it is weighed."""
        o = self.tuning.estimator
        if time_s >= state.fast_until_s:
            return state.fast_until_s, None
        if max((seen.residual * seen.residual / seen.variance).tolist()) > o.quiet**2:
            return state.fast_until_s, None
        since_s = time_s if state.quiet_since_s is None else state.quiet_since_s
        return (time_s, None) if time_s - since_s >= o.quiet_s else (state.fast_until_s, since_s)

    def _weak(
        self,
        state: EstimatorState,
        time_s: float,
        decision: DecisionState,
        weighed: Weighed,
        load: SlidLoadState | None,
        *,
        settled: bool,
    ) -> PartialLossState:
        """The motor that has lost a part; ``settled``: what the file has wrong in steady flight has been learnt."""
        best, weak = weighed.best, state.partial_loss
        if time_s < state.anew_until_s or weighed.refuted:
            return weak
        if True in decision.failed.tolist() or decision.either or decision.among or decision.more:
            return partial_loss.beside(weak, decision.failed, decision.either)
        if not settled or (best is None and not weak.motors and not weak.told):
            return weak
        place = () if best is None else self._identification.place(best.motors)
        return partial_loss.followed(
            weak, time_s, best, place, load, weighed.again, state.effectiveness, self.tuning.decision
        )

    def _learning_rate(
        self, state: EstimatorState, time_s: float, suspicious_since_s: float | None, best: Hypothesis | None
    ) -> float:
        """Speed of learning phi a: faster at the start, frozen while a failure is being weighed."""
        o = self.tuning.estimator
        if suspicious_since_s is not None:
            sure = best is not None and best.explained > o.sure_explained
            longest = o.freeze_sure_s if sure else o.freeze_max_s
            return 0.0 if time_s - suspicious_since_s < longest else o.doubtful_rate
        if time_s < state.begin_until_s:
            return o.begin_rate
        return o.learn_fast_rate if time_s < state.fast_until_s else 1.0


def _suspected(state: EstimatorState, time_s: float, weighed: Weighed, load: SlidLoadState | None) -> float | None:
    """Since when losses are being weighed; None: they are not."""
    if not weighed.suspected or (load is not None and load.slid):
        return None
    return time_s if state.suspicious_since_s is None else state.suspicious_since_s


def _ordered(state: EstimatorState) -> EstimatorState:
    """After an order has changed what is declared: what was being told apart, or looked at again, was of before."""
    return replace(state, decision=replace(state.decision, among=None), evidence=None, second_look=None, slid_load=None)


def _shut(estimate: Estimate) -> None:
    """Nobody can write to its arrays: those that the state goes on with are among them."""
    e = estimate
    arrays = (e.effectiveness, e.deviation, e.failed, e.raw, e.residual, e.disturbance, e.thrust_shown, e.lateral_m_s2)
    for array in arrays if e.features is None else (*arrays, e.features):
        array.flags.writeable = False
    for learnt in (e.balance, e.gain, e.variance):
        if learnt is not None:
            learnt.flags.writeable = False
