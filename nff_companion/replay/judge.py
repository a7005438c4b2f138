"""What the companion would have said of a flight, and whether the log lets it say anything. Pure.

Nothing is said of a flight that was not judged: where samples could not be used, or where the outputs of the log do
not foretell its motion. What is learnt of the latter is the share of the variance of the measured accelerations that
the model explains before the first fault, 1 - var(y) / var(x'), of the residual y in (6.5) before anything is learnt.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nff_companion.companion import Companion
from nff_companion.companion_state import CompanionState, Output
from nff_companion.condition import Condition, Mode
from nff_companion.core import basis_network
from nff_companion.core.decision import Decision, Event
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import AXES, PITCH, ROLL, Vehicle

Verdict = Literal["fault", "no_fault", "not_judged"]
_SETTLE_S = 0.3  # the effectiveness reported is that of so long after the declaration
_BEGIN_S = 1.0  # of each flight left out of what is explained: take-off
_FILTERS_S = 0.3  # and so long after a sample that could not be used: the filters start anew
_BEFORE_S = 0.3  # and so long before a declaration: the fault is there before it is declared
_LEAST_S = 1.0  # of judged flight; less says nothing
_SHARE_MIN = 0.8  # of the samples of a flight that must have been usable
_LAST_S = 10.0  # before a declaration
# Outputs that ask for twice the power that was measured, or more, were not what the motors did. Where the residual is
# small beside the loss of a motor it does not matter. Real flights: -0.6 and more of the former; -3 of outputs at 10 Hz
# of a vehicle that moves faster.
_EXPLAINED_MIN = -1.0
_RESIDUAL_MOTORS = 0.15
_MEAN_MAX_MOTORS = 2.5  # mean residual, in losses of one motor at hover: beyond it is another vehicle
_SPARSE_HZ = 50.0


@dataclass
class Fault:
    """A declaration; times in s from the first record, ``motor`` from 1."""

    motor: int
    time_s: float
    effectiveness: float
    confidence: float
    lifted_s: float | None = None


@dataclass(frozen=True)
class Judgement:
    """``explained`` (n,) of the axes, None: too little flight. ``faults`` are empty unless the verdict is fault."""

    verdict: Verdict
    reason: str
    judged_s: float
    refused: int
    explained: NDArray[np.float64] | None
    faults: list[Fault]


@dataclass
class _Watch:
    """What is gathered while a log goes through the companion."""

    faults: list[Fault] = field(default_factory=list)
    judged_s: float = 0.0
    refused_armed: int = 0
    used_armed: int = 0
    troubles: Counter[str] = field(default_factory=Counter)
    measured: list[NDArray[np.float64]] = field(default_factory=list)  # (n,) each, of the healthy part
    residual: list[NDArray[np.float64]] = field(default_factory=list)
    thrust: list[float] = field(default_factory=list)  # mean of the motors while armed
    doubtful: tuple[int, ...] = ()  # motors (from 0) that were convincing, and too many to be declared
    doubtful_since_s: float | None = None
    suspects: tuple[int, ...] = ()


def judge(
    vehicle: Vehicle,
    rows: Sequence[tuple[float, Sample]],
    rate_hz: float,
    first_s: float,
    outputs: str,
    outputs_hz: float,
    tuning: Tuning | None = None,
) -> Judgement:
    """One flight; ``rows`` as a reader gives them, ``outputs`` the message with the motors' outputs."""
    companion = Companion(vehicle, rate_hz, tuning, network=basis_network.for_vehicle(vehicle, "airframe"))
    decision = Decision(vehicle.motors, vehicle.axes, companion.tuning.decision)
    watch, state, nobody = _Watch(), companion.start(Mode.OBSERVE), Condition()
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
        if state.estimate is not None and output.estimate is not None and not watch.faults:
            _doubt(watch, decision, output, sample.time_s)
            begun = flying_since_s is not None and sample.time_s - flying_since_s > _BEGIN_S
            if begun and estimating_since_s is not None and sample.time_s - estimating_since_s > _FILTERS_S:
                watch.measured.append(state.estimate.residual.measured)
                watch.residual.append(output.estimate.raw)
    return _judgement(watch, vehicle, state.bad_samples, rate_hz, (outputs, outputs_hz))


def _count(watch: _Watch, vehicle: Vehicle, before: CompanionState, state: CompanionState, sample: Sample) -> None:
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
        watch.thrust.append(float(command.mean()))


def _event(watch: _Watch, event: Event, time_s: float) -> Fault | None:
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


def _doubt(watch: _Watch, decision: Decision, output: Output, time_s: float) -> None:
    """A hypothesis that would be declared, had it not more motors than may be lost."""
    best = None if output.estimate is None else output.estimate.best
    if best is None or len(best.motors) <= decision.failed_max or not decision.convincing(best):
        watch.doubtful, watch.doubtful_since_s = (), None
        return
    if best.motors != watch.doubtful or watch.doubtful_since_s is None:
        watch.doubtful, watch.doubtful_since_s = best.motors, time_s
    if time_s - watch.doubtful_since_s >= decision.tuning.confirm_ambiguous_s - 1e-9:
        watch.suspects = watch.suspects or best.motors


# -- verdict ------------------------------------------------------------------------------------------------------


def _judgement(watch: _Watch, vehicle: Vehicle, refused: int, rate_hz: float, outputs: tuple[str, float]) -> Judgement:
    explained = None
    wrong = note = ""
    healthy = len(watch.measured) - (round(_BEFORE_S * rate_hz) if watch.faults else 0)
    healthy = max(healthy, 0)
    if healthy >= _LEAST_S * rate_hz:
        measured, residual = np.array(watch.measured[:healthy]), np.array(watch.residual[:healthy])
        explained = _explained(measured, residual)
        last = slice(-round(_LAST_S * rate_hz), None)
        wrong = (
            _misfit(vehicle, residual)
            or _unforetold(vehicle, measured, residual, *outputs)
            or _unforetold(vehicle, measured[last], residual[last], *outputs)
        )
        explained = np.maximum(explained, 0.0)
    if explained is None and watch.faults:
        note = f"not checked against healthy flight, of which there are {healthy / rate_hz:.1f} s"
    if wrong and watch.faults:
        named = " and ".join(str(fault.motor) for fault in watch.faults)
        wrong += f" (motor {named} would have been declared)"
    if not watch.faults:
        wrong = "; or ".join(
            filter(None, (_suspected(watch, vehicle), wrong or _unseen(watch, vehicle, rate_hz, healthy)))
        )
    verdict: Verdict = "not_judged" if wrong else "fault" if watch.faults else "no_fault"
    faults = watch.faults if verdict == "fault" else []
    return Judgement(verdict, wrong or note, watch.judged_s, refused, explained, faults)


def _explained(measured: NDArray[np.float64], residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) 1 - var(y) / var(x'); negative where the model asks for what did not happen."""
    return np.asarray(1.0 - residual.var(axis=0) / np.maximum(measured.var(axis=0), 1e-12))


def _one_motor(vehicle: Vehicle) -> NDArray[np.float64]:
    """(n,) what the loss of one motor does at hover, m/s^2 and rad/s^2."""
    return np.sqrt(((vehicle.acceleration_effectiveness * vehicle.hover) ** 2).mean(axis=1))


def _misfit(vehicle: Vehicle, residual: NDArray[np.float64]) -> str:
    off = np.abs(residual.mean(axis=0)) / _one_motor(vehicle)
    axis = int(off.argmax())
    if off[axis] <= _MEAN_MAX_MOTORS:
        return ""
    return (
        f"airframe {vehicle.name} does not fit: on the {AXES[axis]} axis it is off by {off[axis]:.1f} lost motors in"
        " the mean; check airframe, motor order, mass and full thrust"
    )


def _unforetold(
    vehicle: Vehicle, measured: NDArray[np.float64], residual: NDArray[np.float64], outputs: str, outputs_hz: float
) -> str:
    explained, large = _explained(measured, residual), residual.std(axis=0) / _one_motor(vehicle)
    bad = [axis for axis in (ROLL, PITCH) if explained[axis] < _EXPLAINED_MIN and large[axis] > _RESIDUAL_MOTORS]
    if not bad:
        return ""
    axis = min(bad, key=lambda a: float(explained[a]))
    ratio = 1.0 - explained[axis]
    found = f"what they leave unexplained of {AXES[axis]} has {ratio:.1f} times the power of what was measured"
    if outputs_hz < _SPARSE_HZ:
        return f"{outputs} at {outputs_hz:.0f} Hz is too seldom for this motion: {found}; log outputs faster"
    return f"the outputs do not foretell the motion: {found}; check airframe, inertia and motor order"


def _unseen(watch: _Watch, vehicle: Vehicle, rate_hz: float, healthy: int) -> str:
    """Why too little was judged for "no fault"; empty when enough was. ``healthy``: samples that the model could be
    compared with."""
    if watch.refused_armed + watch.used_armed == 0:
        return "the vehicle is never armed in this log"
    refused_s = watch.refused_armed / rate_hz
    if watch.refused_armed and watch.judged_s < _SHARE_MIN * (watch.judged_s + refused_s):
        text, _ = watch.troubles.most_common(1)[0]
        count = watch.refused_armed + watch.used_armed
        return f"{watch.refused_armed} of {count} samples while armed cannot be used: {text}"
    if watch.judged_s < _LEAST_S:
        most = max(watch.thrust, default=0.0) / vehicle.hover
        return (
            f"{watch.judged_s:.1f} s of flight were judged: the outputs reach {most:.2f} of what hover needs;"
            " too short a flight, or another airframe, unit or output?"
        )
    if healthy < _LEAST_S * rate_hz:
        return f"{healthy / rate_hz:.1f} s of flight are whole enough to see whether the airframe fits: too short?"
    return ""


def _suspected(watch: _Watch, vehicle: Vehicle) -> str:
    if not watch.suspects:
        return ""
    named = " and ".join(str(motor + 1) for motor in watch.suspects)
    return (
        f"one or more of motors {named} have failed: with {vehicle.motors} motors it cannot be told which, so that"
        " none is declared"
    )
