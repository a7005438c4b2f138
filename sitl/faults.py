"""Motor faults at given times: total, partial, ramp, intermittent, stuck, high, slow, reversed, blade."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

KINDS = ("total", "partial", "ramp", "intermittent", "stuck", "high", "slow", "reversed", "blade")
_SHAKES = 30.0  # times as much as a whole propeller does


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault of one motor. ``motor`` counts from 1; ``effectiveness`` is what is left of the thrust.

    ramp: effectiveness falls linearly over ``duration_s``. intermittent: on and off with period ``duration_s``.
    stuck: the motor keeps the command that it had; high: it runs at full output. slow: it answers ``slower`` times as
    slowly. reversed: it turns the other way, and pushes ``effectiveness`` of its thrust downwards. blade: a part of the
    propeller is gone, what is left pushes less and shakes the vehicle. ``until_s`` ends the fault.
    """

    vehicle: int
    motor: int
    start_s: float
    kind: str = "total"
    effectiveness: float = 0.0
    duration_s: float = 1.0
    slower: float = 1.0
    until_s: float = math.inf

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"fault kind {self.kind!r} is unknown: choose one of {', '.join(KINDS)}")
        if self.slower < 1.0:
            raise ValueError(f"fault slower = {self.slower!r} is not allowed: give 1 or more")


class Faulty(NamedTuple):
    """What faults do at one moment, (N, m) each, or over K steps, (K, N, m)."""

    effectiveness: NDArray[np.float64]  # of the thrust; below 0: downwards
    stuck: NDArray[np.bool_]
    held: NDArray[np.float64]  # output at which a motor is stuck; NaN: the one that it had
    slower: NDArray[np.float64]  # times its lag
    shake: NDArray[np.float64]  # times its shaking

    @classmethod
    def none(cls, vehicles: int, motors: int) -> Faulty:
        """All motors work."""
        one = np.ones((vehicles, motors))
        return cls(one, np.zeros((vehicles, motors), bool), np.full((vehicles, motors), np.nan), one.copy(), one.copy())

    def each(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Faulty:
        """All of them changed alike."""
        return Faulty(
            change(self.effectiveness), change(self.stuck), change(self.held), change(self.slower), change(self.shake)
        )

    @classmethod
    def over(cls, moments: list[Faulty]) -> Faulty:
        """Of (N, m) at K moments, (K, N, m)."""
        return cls(*(np.stack(values) for values in zip(*moments, strict=True)))


class FaultSchedule:
    """What the faults of a fleet of N vehicles do over time."""

    def __init__(self, vehicles: int, motors: int, faults: list[Fault]) -> None:
        for fault in faults:
            if not (1 <= fault.motor <= motors and 0 <= fault.vehicle < vehicles):
                raise ValueError(f"fault of motor {fault.motor} on vehicle {fault.vehicle}: there is no such motor")
        self.faults = sorted(faults, key=lambda f: f.start_s)
        self._shape = vehicles, motors
        self._now = Faulty.none(vehicles, motors)
        self._next_change_s = -math.inf
        self._while_unchanged: Faulty | None = None

    def add(self, fault: Fault) -> None:
        """One more fault."""
        self.faults.append(fault)
        self._next_change_s = -math.inf

    def clear(self, vehicle: int, motor: int) -> None:
        """The motor works again."""
        self.faults = [f for f in self.faults if not (f.vehicle == vehicle and f.motor == motor)]
        self._next_change_s = -math.inf

    def at(self, time_s: float) -> Faulty:
        """At ``time_s``; made anew only when a fault begins, ends or changes."""
        if time_s < self._next_change_s:
            return self._now
        now = self._now = Faulty.none(*self._shape)
        self._next_change_s = math.inf
        for fault in self.faults:
            if time_s < fault.start_s:
                self._next_change_s = min(self._next_change_s, fault.start_s)
                continue
            if time_s >= fault.until_s:
                continue
            index = fault.vehicle, fault.motor - 1
            value, change = self._value(fault, time_s - fault.start_s)
            self._next_change_s = min(self._next_change_s, time_s + change, fault.until_s)
            now.effectiveness[index] *= value
            now.stuck[index] |= fault.kind in ("stuck", "high")
            if fault.kind == "high":
                now.held[index] = 1.0
            now.slower[index] *= fault.slower if fault.kind == "slow" else 1.0
            now.shake[index] *= _SHAKES if fault.kind == "blade" else 1.0
        return now

    def over(self, times_s: list[float]) -> Faulty:
        """As ``at``, for rising times: (K, N, m) each."""
        if times_s[-1] < self._next_change_s:
            if self._while_unchanged is None:
                many = len(times_s), 1, 1
                self._while_unchanged = self._now.each(lambda values: np.tile(values, many))
            return self._while_unchanged
        self._while_unchanged = None
        return Faulty.over([self.at(time_s) for time_s in times_s])

    @staticmethod
    def _value(fault: Fault, elapsed_s: float) -> tuple[float, float]:
        """Effectiveness now, and the time in s until it may change."""
        if fault.kind in ("total", "partial", "blade"):
            return fault.effectiveness, math.inf
        if fault.kind == "reversed":
            return -fault.effectiveness, math.inf
        if fault.kind == "ramp":
            share = min(elapsed_s / fault.duration_s, 1.0)
            return 1.0 + share * (fault.effectiveness - 1.0), 0.0 if share < 1.0 else math.inf
        if fault.kind == "intermittent":
            return (fault.effectiveness if (elapsed_s % fault.duration_s) < 0.5 * fault.duration_s else 1.0), 0.0
        return 1.0, math.inf
