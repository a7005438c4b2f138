"""Measured rotor speeds: which driven motors stand still, by telemetry that has proven itself.

A speed of zero is believed only of a motor whose telemetry was alive just before: fresh, changing, and in proportion
to what the motor is asked for. Zero-filled, frozen or stale telemetry never was, so it says nothing. What is found
here is a hint: it is declared when the residual agrees (decision.py), and never speaks for a motor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import RotorSpeedTuning


@dataclass(slots=True)
class MotorSpeed:
    """What is remembered of one motor; NaN: unknown."""

    reading: float = math.nan  # last speed, rad/s
    reading_s: float = math.nan  # time of the last reading
    changed_s: float = -math.inf  # when it last changed
    ratio: float = math.nan  # speed over the root of the thrust fraction
    good_s: float = 0.0  # how long readings have been good
    count: int = 0  # distinct readings in a row that say: stopped
    since_s: float = math.nan  # when the motor was found stopped, NaN: it is not


@dataclass(slots=True)
class RotorSpeedState:
    """Of all motors; changed in place."""

    motors: list[MotorSpeed]
    last_s: float = 0.0
    heard: bool = False  # any speed so far

    @staticmethod
    def start(motors: int) -> RotorSpeedState:
        """Nothing known."""
        return RotorSpeedState([MotorSpeed() for _ in range(motors)])


@dataclass(slots=True)
class _Look:
    """One motor at one sample."""

    motor: MotorSpeed
    speed: float
    ratio: float
    new: bool  # a reading that was not there before
    fresh: bool
    alive: bool  # fresh, and not frozen
    driven: bool
    turning: bool
    low: bool  # slower than it should be by far


class RotorSpeedWatch:
    """Constants of m motors; ``step`` changes the state in place."""

    def __init__(self, motors: int, tuning: RotorSpeedTuning | None = None) -> None:
        self.motors = motors
        self.tuning = tuning or RotorSpeedTuning()
        self._none = np.zeros(motors, bool)
        self._none.flags.writeable = False

    def step(
        self,
        state: RotorSpeedState,
        time_s: float,
        speed: NDArray[np.float64],
        read_s: NDArray[np.float64],
        thrust: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """(m,) bool: motors that are driven and stand still. ``speed`` (m,) rad/s with the times ``read_s`` (m,) of
        their readings, NaN: none; ``thrust`` (m,) fractions asked for."""
        o = self.tuning
        dt_s = min(max(time_s - state.last_s, 0.0), o.step_max_s)
        state.last_s = time_s
        speeds = speed.tolist()
        if not state.heard:
            state.heard = any(map(math.isfinite, speeds))
            if not state.heard:
                return self._none
        looks = [
            self._look(*each, time_s)
            for each in zip(state.motors, speeds, read_s.tolist(), thrust.tolist(), strict=True)
        ]
        self._learn(looks, dt_s)
        doubted, beginning = 0, False
        for look in looks:
            motor = look.motor
            if not look.low or motor.good_s < o.proven_s:
                motor.count = 0
                continue
            motor.count += look.new
            doubted += 1
            beginning = beginning or (motor.count >= o.readings and math.isnan(motor.since_s))
        if beginning and doubted > o.at_once_max:
            # Together within a moment: no two motors fail like that by chance, three never. They are not to be
            # believed again until they have proven themselves anew.
            for look in looks:
                look.motor.count = 0
                look.motor.good_s = 0.0 if look.low else look.motor.good_s
        stopped = [self._stands_still(look.motor, time_s) for look in looks]
        return np.array(stopped) if True in stopped else self._none

    def _look(self, motor: MotorSpeed, speed: float, read_s: float, thrust: float, time_s: float) -> _Look:
        """Take one reading."""
        o = self.tuning
        fresh = 0.0 <= speed < math.inf and abs(time_s - read_s) <= o.fresh_s  # comparisons with NaN are false
        new = fresh and motor.reading_s != read_s
        if fresh:
            if motor.reading != speed:
                motor.changed_s = time_s
            motor.reading, motor.reading_s = speed, read_s
        driven, root = thrust > o.driven, math.sqrt(max(thrust, 1e-6))
        unknown = math.isnan(motor.ratio)
        expected = math.inf if unknown else motor.ratio * root
        alive = fresh and time_s - motor.changed_s <= o.frozen_s
        turning = alive and driven and speed > o.turning_min_rad_s and (unknown or speed > o.turning_share * expected)
        low = fresh and driven and not unknown and speed < o.stopped_share * expected
        return _Look(motor, speed, speed / root, new, fresh, alive, driven, turning, low)

    def _learn(self, looks: list[_Look], dt_s: float) -> None:
        """The speed that each motor's own history leads one to expect, and for how long its telemetry has been good."""
        ratios = [look.ratio for look in looks if look.turning]
        middle = median(ratios) if ratios else math.nan
        share = dt_s / (self.tuning.ratio_s + dt_s)
        for look in looks:
            motor = look.motor
            # All motors are of one kind: a reading far from the others is another sender's, or nonsense.
            if look.turning and abs(look.ratio / middle - 1.0) <= self.tuning.unlike_share:
                motor.ratio = (
                    look.ratio if math.isnan(motor.ratio) else motor.ratio + share * (look.ratio - motor.ratio)
                )
                motor.good_s += dt_s
            # Slowing down neither proves nor disproves; silence and repetition do.
            elif look.driven and not (look.alive or look.low):
                motor.good_s = 0.0

    def _stands_still(self, motor: MotorSpeed, time_s: float) -> bool:
        """After a while without a declaration it is the sensor: its word no longer lowers any threshold."""
        if motor.count < self.tuning.readings:
            motor.since_s = math.nan
            return False
        if math.isnan(motor.since_s):
            motor.since_s = time_s
        return time_s - motor.since_s < self.tuning.fault_s

    def faults(self, state: RotorSpeedState, failed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(m,) bool: stopped by telemetry for a while, but nothing was declared: the residual says that they pull."""
        lasting = [state.last_s - motor.since_s >= self.tuning.fault_s for motor in state.motors]
        return np.array(lasting) & ~failed
