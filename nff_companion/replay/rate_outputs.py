"""Motor outputs of an ArduPilot log at the rate of its rate loops.

RCOU comes ten times a second. RATE, which comes with every loop where LOG_BITMASK has bit 0, holds what the mixer was
given (AC_AttitudeControl_Logging.cpp, Write_Rate), and the mixer is known by parameters: outputs follow. One number is
not in a log, what the firmware makes up for thin air (and, without MOTB, for the battery): a gain of all thrusts that
changes slowly, and RCOU shows it. RCOU also shows whether all this is so; where it is not, it counts itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import NotJudged
from nff_companion.replay.ardupilot_mixer import Battery, Mixer, mixer_of
from nff_companion.replay.flight import newest, rate_of_outputs

Array = NDArray[np.float64]
FAST_HZ = 45.0  # RATE at less tells too little, and RCOU at as much needs no help
_GAP_S = 2.0 / FAST_HZ
_HOVER = 0.35  # MOT_THST_HOVER as it is shipped
_GAIN = (0.5, 3.0)  # thin air gives at most 2, an empty battery 1.7
_GAIN_RECORDS = 21  # of RCOU, two seconds, whose median the gain is
_FLYING = 0.05  # throttle
_LEAST = 20  # records of RCOU in flight
_LIMITED = 1e-6  # of thrust
_DOUBTFUL = 0.02  # of the outputs' range, between what the mixer may have done with too little room
# Of the outputs' range: the median of the worst motor; one record. Share of records that agree. Share of the power of
# the motors' differences that is not explained, in the half of the records with most of it; beside pulses in whole us.
_MEDIAN_MAX, _RECORD_MAX, _AGREE_MIN, _SURE_MIN = 0.01, 0.03, 0.8, 0.5
_UNEXPLAINED_MAX, _ROUNDING = 0.05, 5e-4


@dataclass(frozen=True, eq=False)
class Outputs:
    """``output`` (K, m), 0..1, at ``time_s`` (K,); ``joined`` (K,) whether this one and the next tell of what lies
    between them."""

    time_s: Array
    output: Array
    joined: NDArray[np.bool_]
    hz: float

    def at(self, time_s: Array) -> NDArray[np.bool_]:
        """(N,) whether outputs at ``time_s`` (N,) are known."""
        index = newest(self.time_s, time_s)
        return (index >= 0) & self.joined[np.maximum(index, 0)]


def is_faster(rate: Array | None, told_hz: float) -> bool:
    """Whether RATE (K, 5), time first, has more to say than RCOU at ``told_hz``. Never raises."""
    if rate is None or told_hz >= FAST_HZ or len(rate) < 2:
        return False
    gaps = np.diff(rate[:, 0])
    gaps = gaps[gaps > 0.0]
    return len(gaps) > 0 and 1.0 / float(np.median(gaps)) >= FAST_HZ


def reconstructed(
    rate: Array, battery: Array | None, told_s: Array, told: Array, values: Mapping[str, float]
) -> Outputs:
    """Outputs by ``rate`` (K, 5): time, roll, pitch, yaw, throttle; ``battery`` (B, 3): time, lift, voltage of MOTB;
    ``told`` (R, m) the outputs 0..1 of RCOU at ``told_s`` (R,). Raises NotJudged with what speaks against it."""
    mixer = mixer_of(values)
    if len(mixer.factors) != told.shape[1]:
        raise NotJudged(f"the mixer has {len(mixer.factors)} motors, the airframe {told.shape[1]}")
    rate = rate[np.isfinite(rate).all(axis=1)]
    rate = rate[np.concatenate([[True], np.diff(np.maximum.accumulate(rate[:, 0])) > 0.0])]
    hz = rate_of_outputs(rate[:, 0], "RATE")
    index = newest(rate[:, 0], told_s)
    # The mixer ran after the newest demands, and RCOU was written after it.
    beside = (index >= 0) & (told_s - rate[np.maximum(index, 0), 0] < 2.0 / hz)
    index = np.maximum(index, 0)
    state = _battery(battery, rate[:, 0])
    demand = rate[:, 1:] / state.lift[:, None]
    seen = Battery(state.lift[index], state.voltage[index])
    flying = beside & (rate[index, 4] > _FLYING) & np.isfinite(told).all(axis=1)
    gain = _gain(mixer, told_s, mixer.thrusts_of(told, seen), demand[index], flying, rate[:, 0])
    demand *= gain[:, None]
    hover = gain / state.lift * values.get("MOT_THST_HOVER", _HOVER)
    # How far it raises the mean thrust for the sake of roll and pitch is not in the log: no less than the throttle, no
    # more than that of hover (AC_AttitudeControl_Multi::get_throttle_avg_max).
    least, most = (
        mixer.outputs(mixer.thrusts(demand, raised), state)
        for raised in (demand[:, 3], np.maximum(demand[:, 3], hover))
    )
    output, sure = 0.5 * (least + most), np.abs(most - least).max(axis=1) < _DOUBTFUL
    error = output[index] - told
    _check(error, told, flying, flying & sure[index])
    # A record that is not sure speaks for nothing and against nothing.
    differs = ~beside | (sure[index] & (np.abs(error).max(axis=1) > _RECORD_MAX))
    before = newest(told_s, rate[:, 0])
    after = np.minimum(before + 1, len(told_s) - 1)
    known = sure & (before >= 0) & ~differs[np.maximum(before, 0)] & ~differs[after]
    near = np.diff(rate[:, 0]) < _GAP_S
    return Outputs(rate[:, 0], output, np.append(known[:-1] & known[1:] & near, False), hz)


def _battery(table: Array | None, time_s: Array) -> Battery:
    """By MOTB; without it the gain has to hold the battery too."""
    if table is None or not (np.isfinite(table).all() and (table[:, 1:] > 0.0).all()):
        return Battery(np.ones(len(time_s)), np.ones(len(time_s)))
    return Battery(*(np.interp(time_s, table[:, 0], column) for column in table[:, 1:].T))


def _gain(mixer: Mixer, told_s: Array, told: Array, demand: Array, flying: NDArray[np.bool_], at_s: Array) -> Array:
    """(K,) at ``at_s``: mean thrust ``told`` (R, m) over that asked for by ``demand`` (R, 4), where the mixer had room.
    Raises NotJudged."""
    throttle = demand[:, 3]
    asked = throttle[:, None] + demand[:, :3] @ mixer.factors.T
    limited = np.abs(mixer.thrusts(demand, throttle) - asked).max(axis=1) > _LIMITED
    room = flying & ~limited & (asked > 0.02).all(axis=1) & (told > 0.0).all(axis=1) & (told < 1.0).all(axis=1)
    if room.sum() < _LEAST:
        raise NotJudged(f"{room.sum()} records of RCOU in flight to compare with; {_LEAST} are needed")
    each = told[room].mean(axis=1) / asked[room].mean(axis=1)
    half = _GAIN_RECORDS // 2
    gain = np.median(np.lib.stride_tricks.sliding_window_view(np.pad(each, half, "reflect"), _GAIN_RECORDS), axis=1)
    if not (_GAIN[0] < float(np.median(gain)) < _GAIN[1]):
        raise NotJudged(f"RCOU has {np.median(gain):.2g} times the thrust that RATE asks for")
    return np.asarray(np.interp(at_s, told_s[room], np.clip(gain, *_GAIN)))


def _check(error: Array, told: Array, flying: NDArray[np.bool_], sure: NDArray[np.bool_]) -> None:
    """Raises NotJudged where ``error`` (R, m) of the outputs that are ``told`` (R, m) is too large in flight."""
    if sure.sum() < max(_LEAST, _SURE_MIN * flying.sum()):
        raise NotJudged(f"the motors are at their limits in {flying.sum() - sure.sum()} of {flying.sum()} records")
    worst = np.abs(error[sure]).max(axis=1)
    if float(np.median(worst)) > _MEDIAN_MAX:
        raise NotJudged(
            f"it gives outputs that differ from RCOU by {100.0 * np.median(worst):.2g} % of the range (median of the"
            f" worst motor; {100.0 * _MEDIAN_MAX:.0f} % may be)"
        )
    if float(np.mean(worst < _RECORD_MAX)) < _AGREE_MIN:
        many = f"{np.mean(worst >= _RECORD_MAX):.0%} of the records of RCOU"
        raise NotJudged(f"outputs differ from {many} by more than {100.0 * _RECORD_MAX:.0f} % of the range")
    # In a hover any mixer gives nearly the same to all motors.
    apart, missed = (((x - x.mean(axis=1, keepdims=True)) ** 2).mean(axis=1) for x in (told[sure], error[sure]))
    lively = apart >= np.median(apart)
    power = float(np.median(apart[lively]))
    if float(np.median(missed[lively])) > _UNEXPLAINED_MAX * power + _ROUNDING**2:
        raise NotJudged(
            f"it leaves {np.median(missed[lively]) / max(power, 1e-12):.0%} of how the motors differ in RCOU"
            " unexplained: another mixer?"
        )
