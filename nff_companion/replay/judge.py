"""What the companion would have said of a flight. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from nff_companion.companion import Companion
from nff_companion.companion_state import CompanionState, Output
from nff_companion.condition import Condition, Mode
from nff_companion.core import basis_network
from nff_companion.core.decision import Decision, Event
from nff_companion.core.estimate import Estimate
from nff_companion.core.parts import Parts
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.replay.trace import Trace
from nff_companion.replay.verdict import judgement
from nff_companion.replay.watch import Fault, Judgement, Watch

__all__ = ["Fault", "Judgement", "judge"]

_SETTLE_S = 0.3  # the effectiveness reported is that of so long after the declaration
_FOLLOW_S = 3.0  # after a declaration it is looked at whether the motor works after all
_BEGIN_S = 2.0  # of each flight left out of what is explained: take-off, and the air near the ground
_JUDGED = Parts(judged=True)
_FILTERS_S = 0.3  # and so long after a sample that could not be used: the filters start anew


def judge(
    vehicle: Vehicle,
    rows: Sequence[tuple[float, Sample]],
    rate_hz: float,
    first_s: float,
    outputs: str,
    outputs_hz: float,
    tuning: Tuning | None = None,
    trace: Trace | None = None,
) -> Judgement:
    """One flight; ``rows`` as a reader gives them, ``outputs`` the message with the motors' outputs; ``trace`` is given
    its course."""
    # What goes with the drag is not told from a rotor that is gone on a vehicle that spins, as many in logs do.
    network = basis_network.for_vehicle(vehicle, "airframe" if vehicle.network else "none")
    companion = Companion(vehicle, rate_hz, tuning, network=network, parts=_JUDGED)
    decision = Decision(vehicle.motors, vehicle.axes, companion.tuning.decision)
    watch = Watch(works_from=companion.tuning.decision.lift_effectiveness)
    state, nobody = companion.start(Mode.OBSERVE), Condition()
    settling: list[tuple[float, Event, Fault]] = []
    flying_since_s = estimating_since_s = None
    for stamp, sample in rows:
        before = state
        state, output = companion.step(state, sample, nobody)
        _count(watch, vehicle, before, state, sample)
        flying_since_s = (flying_since_s or sample.time_s) if state.phase.flying else None
        estimating_since_s = (estimating_since_s or sample.time_s) if output.estimate is not None else None
        for event in output.events:
            fault = _event(watch, event, stamp - first_s)
            if fault is not None:
                settling.append((sample.time_s + _SETTLE_S, event, fault))
        while settling and sample.time_s >= settling[0][0]:
            _, event, fault = settling.pop(0)
            if output.flying:
                fault.effectiveness = min(float(output.effectiveness[event.motor - 1]), 1.0)
        if trace is not None and output.estimate is not None:
            trace.add(stamp - first_s, output.estimate)
        if output.estimate is not None and watch.faults:
            _follow(watch, output.estimate, stamp - first_s)
        if state.estimate is not None and output.estimate is not None and not watch.faults:
            _doubt(watch, decision, output, sample.time_s)
            begun = flying_since_s is not None and sample.time_s - flying_since_s > _BEGIN_S
            if begun and estimating_since_s is not None and sample.time_s - estimating_since_s > _FILTERS_S:
                watch.measured.append(state.estimate.residual.measured)
                watch.residual.append(output.estimate.raw)
                watch.shown.append(output.estimate.thrust_shown)
                watch.times.append(stamp - first_s)
    return judgement(watch, vehicle, state.bad_samples, rate_hz, (outputs, outputs_hz))


def _count(watch: Watch, vehicle: Vehicle, before: CompanionState, state: CompanionState, sample: Sample) -> None:
    refused = state.bad_samples > before.bad_samples
    if not refused and state.estimate is not None and before.last_s is not None:
        watch.judged_s += sample.time_s - before.last_s
    if not sample.armed:
        return
    watch.refused_armed += refused
    watch.used_armed += not refused
    if refused and state.trouble is not None:
        watch.troubles[state.trouble.text] += 1
    if not refused:
        command = sample.thrust if sample.thrust is not None else vehicle.thrust_fraction(sample.output)
        watch.thrust_max = max(watch.thrust_max, float(command.sum()) / len(command))


def _event(watch: Watch, event: Event, time_s: float) -> Fault | None:
    """The fault that it declares; the lifting of one is noted in it."""
    if event.declared:
        fault = Fault(event.motor, time_s, event.effectiveness, event.confidence)
        watch.faults.append(fault)
        return fault
    for fault in reversed(watch.faults):
        if fault.motor == event.motor and fault.lifted_s is None:
            fault.lifted_s = time_s
            break
    return None


def _follow(watch: Watch, estimate: Estimate, time_s: float) -> None:
    """What the vehicle does without the motors that were declared first, once that shows."""
    since_s = time_s - watch.faults[0].time_s
    alone = all(fault.lifted_s is None and fault.time_s == watch.faults[0].time_s for fault in watch.faults)
    if alone and _SETTLE_S < since_s < _FOLLOW_S:
        watch.residual_after.append(estimate.raw)
        watch.shown_after.append(estimate.thrust_shown)


def _doubt(watch: Watch, decision: Decision, output: Output, time_s: float) -> None:
    """A hypothesis that would be declared, had it not more motors than may be lost."""
    best = None if output.estimate is None else output.estimate.best
    if best is None or len(best.motors) <= decision.failed_max or not decision.convincing(best):
        watch.doubtful, watch.doubtful_since_s = (), None
        return
    if best.motors != watch.doubtful or watch.doubtful_since_s is None:
        watch.doubtful, watch.doubtful_since_s = best.motors, time_s
    if time_s - watch.doubtful_since_s >= decision.tuning.confirm_ambiguous_s - 1e-9:
        watch.suspects = watch.suspects or best.motors
