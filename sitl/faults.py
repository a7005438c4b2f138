"""Motor faults at given times: total, partial, ramp, intermittent, stuck."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

KINDS = ("total", "partial", "ramp", "intermittent", "stuck")


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault of one motor. ``motor`` counts from 1; ``effectiveness`` is what is left of the thrust.

    ramp: effectiveness falls linearly over ``duration_s``. intermittent: on and off with period ``duration_s``.
    stuck: the motor keeps the command that it had. ``until_s`` ends the fault.
    """

    vehicle: int
    motor: int
    start_s: float
    kind: str = "total"
    effectiveness: float = 0.0
    duration_s: float = 1.0
    until_s: float = math.inf

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"fault kind {self.kind!r} is unknown: choose one of {', '.join(KINDS)}")


class FaultSchedule:
    """Effectiveness (N, m) and stuck mask (N, m) over time."""

    def __init__(self, vehicles: int, motors: int, faults: list[Fault]) -> None:
        for fault in faults:
            if not (1 <= fault.motor <= motors and 0 <= fault.vehicle < vehicles):
                raise ValueError(f"fault of motor {fault.motor} on vehicle {fault.vehicle}: there is no such motor")
        self.faults = sorted(faults, key=lambda f: f.start_s)
        self._effectiveness = np.ones((vehicles, motors))
        self._stuck = np.zeros((vehicles, motors), bool)
        self._next_change_s = -math.inf
        self._while_unchanged: tuple[NDArray[np.float64], NDArray[np.bool_]] | None = None

    def add(self, fault: Fault) -> None:
        """One more fault."""
        self.faults.append(fault)
        self._next_change_s = -math.inf

    def clear(self, vehicle: int, motor: int) -> None:
        """The motor works again."""
        self.faults = [f for f in self.faults if not (f.vehicle == vehicle and f.motor == motor)]
        self._next_change_s = -math.inf

    def at(self, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Effectiveness and stuck mask at ``time_s``; recomputed only when a fault begins, ends or changes."""
        if time_s < self._next_change_s:
            return self._effectiveness, self._stuck
        self._effectiveness = np.ones_like(self._effectiveness)
        self._stuck = np.zeros_like(self._stuck)
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
            self._effectiveness[index] *= value
            self._stuck[index] |= fault.kind == "stuck"
        return self._effectiveness, self._stuck

    def over(self, times_s: list[float]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """As ``at``, for rising times: (K, N, m) each."""
        if times_s[-1] < self._next_change_s:
            if self._while_unchanged is None:
                many = len(times_s), 1, 1
                self._while_unchanged = np.tile(self._effectiveness, many), np.tile(self._stuck, many)
            return self._while_unchanged
        self._while_unchanged = None
        effectiveness, stuck = zip(*(self.at(time_s) for time_s in times_s), strict=True)
        return np.stack(effectiveness), np.stack(stuck)

    @staticmethod
    def _value(fault: Fault, elapsed_s: float) -> tuple[float, float]:
        """Effectiveness now, and the time in s until it may change."""
        if fault.kind in ("total", "partial"):
            return fault.effectiveness, math.inf
        if fault.kind == "ramp":
            share = min(elapsed_s / fault.duration_s, 1.0)
            return 1.0 + share * (fault.effectiveness - 1.0), 0.0 if share < 1.0 else math.inf
        if fault.kind == "intermittent":
            return (fault.effectiveness if (elapsed_s % fault.duration_s) < 0.5 * fault.duration_s else 1.0), 0.0
        return 1.0, math.inf
