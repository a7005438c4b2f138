"""Whether a log lets anything be said, and with what confidence. Pure.

Nothing is said of a flight that was not judged: where samples could not be used, or where the outputs of the log do
not foretell its motion. What is learnt of the latter is the share of the variance of the measured accelerations that
the model explains before the first fault, 1 - var(y) / var(x'), of the residual y in (6.5) before anything is learnt.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.vehicle import AXES, PITCH, ROLL, Vehicle
from nff_companion.replay.watch import Fault, Judgement, Verdict, Watch

_BEFORE_S = 0.3  # and so long before a declaration: the fault is there before it is declared
# Where the residual looked like the loss before it was declared, that was the fault too; for longer, it is the model.
_ONSET_LOSS, _ONSET_MEAN_S, _ONSET_MAX_S = 0.25, 0.2, 3.0
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
_AFTER_S = 0.5  # of flight after a declaration, to see whether the motor works
_DRIVEN = 0.2  # of the thrust of hover: a motor that is asked for less shows little
# What the model explains of roll and pitch, the lesser, from which on it takes nothing from a declaration's confidence.
_TRUSTED = 0.5


def judgement(watch: Watch, vehicle: Vehicle, refused: int, rate_hz: float, outputs: tuple[str, float]) -> Judgement:
    """What is said of the flight; ``outputs``: name and rate of the message with the motors' outputs."""
    explained = None
    wrong = note = ""
    healthy = _healthy(watch, vehicle, rate_hz)
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
        wrong = _unchecked(healthy / rate_hz, *outputs)
    wrong = wrong or _works(watch, vehicle, rate_hz, *outputs)
    if wrong and watch.faults:
        named = " and ".join(str(fault.motor) for fault in watch.faults)
        wrong += f" (motor {named} would have been declared)"
    if not watch.faults:
        wrong = "; or ".join(
            filter(None, (_suspected(watch, vehicle), wrong or _unseen(watch, vehicle, rate_hz, healthy)))
        )
    verdict: Verdict = "not_judged" if wrong else "fault" if watch.faults else "no_fault"
    faults = [_doubted(fault, explained) for fault in watch.faults] if verdict == "fault" else []
    return Judgement(verdict, wrong or note, watch.judged_s, refused, explained, faults)


def _healthy(watch: Watch, vehicle: Vehicle, rate_hz: float) -> int:
    """How many of the samples are of flight before the first fault: up to its onset, where that can be seen."""
    count = len(watch.measured)
    if not watch.faults:
        return count
    declared = max(count - round(_BEFORE_S * rate_hz), 0)
    mean, most = max(round(_ONSET_MEAN_S * rate_hz), 1), round(_ONSET_MAX_S * rate_hz)
    begin = max(count - most - mean, 0)
    if count - begin < 2 * mean:
        return declared
    first_s = watch.faults[0].time_s
    motors = [fault.motor - 1 for fault in watch.faults if fault.time_s == first_s]
    scale = _one_motor(vehicle)
    shown = np.array(watch.shown[begin:])[:, motors]
    lost = -(shown @ vehicle.acceleration_effectiveness[:, motors].T) / scale
    residual = np.array(watch.residual[begin:]) / scale
    box = np.full(mean, 1.0 / mean)
    both, size = (np.convolve(part.sum(axis=1), box, mode="valid") for part in (residual * lost, lost * lost))
    whole = np.flatnonzero(both < _ONSET_LOSS * size)  # index k: the mean of k .. k + mean
    if len(whole) == 0:
        return declared  # it has looked like this for long: not an onset but the model
    return min(begin + int(whole[-1]), declared)


def _doubted(fault: Fault, explained: NDArray[np.float64] | None) -> Fault:
    """With a confidence that goes with how well the model was seen to fit: the decision's own compares hypotheses with
    each other, not with the model being wrong. Half of it where nothing is explained, or nothing was seen."""
    least = 0.0 if explained is None else float(explained[[ROLL, PITCH]].min())
    trust = 0.5 + 0.5 * min(least / _TRUSTED, 1.0)
    return replace(fault, confidence=fault.confidence * trust)


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


def _works(watch: Watch, vehicle: Vehicle, rate_hz: float, outputs: str, outputs_hz: float) -> str:
    """Which motor pulls after it was declared, by the mean of what outputs that come seldom leave unexplained: between
    two of them a motion that begins may look like a loss for as long as a declaration takes, and no longer."""
    if outputs_hz >= _SPARSE_HZ or len(watch.residual_after) < _AFTER_S * rate_hz:
        return ""
    motors = [fault.motor - 1 for fault in watch.faults if fault.time_s == watch.faults[0].time_s]
    driven, scale = np.mean(watch.shown_after, axis=0)[motors], _one_motor(vehicle)
    if (driven < _DRIVEN * vehicle.hover).any():
        return ""  # at rest it shows nothing
    pulls = vehicle.acceleration_effectiveness[:, motors] * driven / scale[:, None]
    left, *_ = np.linalg.lstsq(pulls, np.mean(watch.residual_after, axis=0) / scale, rcond=None)
    works = int(left.argmax())
    if left[works] < watch.works_from:
        return ""
    return (
        f"{outputs} at {outputs_hz:.0f} Hz is too seldom for this motion: motor {motors[works] + 1} seemed lost at"
        f" {watch.faults[0].time_s:.2f} s, and pulls all the same in the seconds after; log outputs faster"
    )


def _unchecked(healthy_s: float, outputs: str, outputs_hz: float) -> str:
    """What comes seldom may be samples of anything: a declaration by it needs flight that says otherwise."""
    if outputs_hz >= _SPARSE_HZ:
        return ""
    return (
        f"{outputs} at {outputs_hz:.0f} Hz is seldom, and {healthy_s:.1f} s of flight before are too few to see whether"
        " they foretell the motion; log outputs faster"
    )


def _unseen(watch: Watch, vehicle: Vehicle, rate_hz: float, healthy: int) -> str:
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
        most = watch.thrust_max / vehicle.hover
        return (
            f"{watch.judged_s:.1f} s of flight were judged: the outputs reach {most:.2f} of what hover needs;"
            " too short a flight, or another airframe, unit or output?"
        )
    if healthy < _LEAST_S * rate_hz:
        return f"{healthy / rate_hz:.1f} s of flight are whole enough to see whether the airframe fits: too short?"
    return ""


def _suspected(watch: Watch, vehicle: Vehicle) -> str:
    if not watch.suspects:
        return ""
    named = " and ".join(str(motor + 1) for motor in watch.suspects)
    return (
        f"one or more of motors {named} have failed: with {vehicle.motors} motors it cannot be told which, so that"
        " none is declared"
    )
