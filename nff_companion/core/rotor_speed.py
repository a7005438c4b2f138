"""Measured rotor speeds: which driven motors stand still, by telemetry that has proven itself.

A speed of zero is believed only of a motor whose telemetry was alive just before: fresh, changing, and in proportion
to what the motor is asked for. Zero-filled, frozen or stale telemetry never was, so it says nothing. What is found
here is a hint: it is declared when the residual agrees (decision.py), and never speaks for a motor.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np


class RotorSpeedOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Thresholds. Shares are of the speed that the motor's own history leads one to expect."""

    driven: float = 0.05  # thrust fraction below which a motor may stand still
    stopped_share: float = 0.35  # an eighth of the thrust
    turning_share: float = 0.5
    fresh_s: float = 0.1  # older readings say nothing
    frozen_s: float = 0.4  # the same reading for so long: the sender has stopped
    proven_s: float = 1.0  # of good readings, to be believed
    ratio_s: float = 0.5  # time constant of the expected speed
    readings: int = 2  # in a row
    at_once_max: int = 2  # more motors than this stop together: it is the telemetry
    fault_s: float = 0.5  # stands still by telemetry, pulls by the residual: a sensor fault


@dataclass(slots=True)
class RotorSpeedState:
    """Arrays (m,)."""

    reading: np.ndarray  # last speed, rad/s
    changed_s: np.ndarray  # when it last changed
    ratio: np.ndarray  # speed over the root of the thrust fraction, NaN: unknown
    good_s: np.ndarray  # how long readings have been good
    count: np.ndarray  # distinct readings in a row that say: stopped
    reading_s: np.ndarray  # time of the last reading
    since_s: np.ndarray  # when the motor was found stopped, NaN: it is not
    last_s: float

    @staticmethod
    def start(motors: int) -> RotorSpeedState:
        """Nothing known."""
        nan, zero = np.full(motors, np.nan), np.zeros(motors)
        return RotorSpeedState(
            nan.copy(), np.full(motors, -np.inf), nan.copy(), zero.copy(), zero.astype(int), nan.copy(), nan.copy(), 0.0
        )


class RotorSpeedWatch:
    """Constants of m motors; ``step`` changes the state in place."""

    def __init__(self, motors: int, options: RotorSpeedOptions | None = None) -> None:
        self.motors = motors
        self.options = options or RotorSpeedOptions()

    def step(
        self, state: RotorSpeedState, time_s: float, speed: np.ndarray, read_s: np.ndarray, thrust: np.ndarray
    ) -> np.ndarray:
        """(m,) bool: motors that are driven and stand still. ``speed`` (m,) rad/s with the times ``read_s`` (m,) of
        their readings, NaN: none; ``thrust`` (m,) fractions asked for."""
        o = self.options
        dt = float(np.clip(time_s - state.last_s, 0.0, 0.05))
        state.last_s = time_s
        known = np.isfinite(speed) & (speed >= 0.0)
        fresh = known & (np.abs(time_s - np.nan_to_num(read_s, nan=-np.inf)) <= o.fresh_s)
        new = fresh & (np.nan_to_num(state.reading_s, nan=-np.inf) != read_s)
        differs = fresh & (np.nan_to_num(state.reading, nan=-1.0) != np.nan_to_num(speed, nan=-1.0))
        state.changed_s[differs] = time_s
        state.reading[fresh], state.reading_s[fresh] = speed[fresh], read_s[fresh]
        driven = thrust > o.driven
        root = np.sqrt(np.maximum(thrust, 1e-6))
        expected = np.nan_to_num(state.ratio, nan=np.inf) * root
        alive = fresh & (time_s - state.changed_s <= o.frozen_s)
        turning = alive & driven & ((speed > o.turning_share * expected) | np.isnan(state.ratio)) & (speed > 1.0)
        ratio = np.where(turning, speed / root, np.nan)
        # All motors are of one kind: a reading far from the others is another sender's, or nonsense.
        middle = float(np.nanmedian(ratio)) if np.isfinite(ratio).any() else np.nan
        turning &= ~(np.abs(ratio / middle - 1.0) > 0.6) if np.isfinite(middle) else turning
        share = dt / (o.ratio_s + dt)
        state.ratio = np.where(
            turning, np.where(np.isnan(state.ratio), ratio, state.ratio + share * (ratio - state.ratio)), state.ratio
        )
        low = fresh & driven & (speed < o.stopped_share * expected) & np.isfinite(state.ratio)
        # Slowing down neither proves nor disproves; silence and repetition do.
        state.good_s = np.where(turning, state.good_s + dt, np.where(alive | low | ~driven, state.good_s, 0.0))
        proven = state.good_s >= o.proven_s
        state.count = np.where(low & proven, state.count + new, 0)
        stopped = state.count >= o.readings
        # Together within a moment: no two motors fail like that by chance, three never.
        beginning = stopped & np.isnan(state.since_s)
        if int((low & proven).sum()) > o.at_once_max and beginning.any():
            state.good_s[low] = 0.0  # not to be believed again until it has proven itself anew
            state.count[:] = 0
            stopped = np.zeros(self.motors, bool)
        state.since_s = np.where(stopped, np.where(np.isnan(state.since_s), time_s, state.since_s), np.nan)
        # After a while without a declaration it is the sensor: its word no longer lowers any threshold.
        return stopped & ~(time_s - np.nan_to_num(state.since_s, nan=np.inf) >= o.fault_s)

    def faults(self, state: RotorSpeedState, failed: np.ndarray) -> np.ndarray:
        """(m,) bool: stopped by telemetry for a while, but nothing was declared: the residual says that they pull."""
        since = np.nan_to_num(state.since_s, nan=np.inf)
        return np.asarray(~failed & (state.last_s - since >= self.options.fault_s))
