"""What the peers have in common: the same filtered accelerations and thrusts as ours, and a declaration once one motor
has been named for a while. Same interface as our estimator."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.decision import DecisionState, Event
from nff_companion.core.disturbance import Disturbance
from nff_companion.core.estimate import Estimate, Measurement
from nff_companion.core.residual import ResidualFilter, ResidualState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle


@dataclass(slots=True)
class PeerState:
    """``memory`` is the peer's own; ``candidate``: index of the motor that it names, since ``since_s``."""

    residual: ResidualState
    decision: DecisionState
    memory: Any
    since_s: float | None = None
    candidate: int = -1


@dataclass(frozen=True, slots=True)
class Look:
    """What a peer makes of a sample: its memory, the motor that it names (index, -1: none) and how surely, its
    effectiveness (m,) and the disturbance (n,)."""

    memory: Any
    named: int
    sure: float
    effectiveness: NDArray[np.float64]
    disturbance: NDArray[np.float64]


class PeerEstimator(ABC):
    """Constants of one airframe and sample time."""

    confirm_s: float  # for which a motor must be named

    def __init__(self, vehicle: Vehicle, dt_s: float) -> None:
        self.vehicle, self.dt_s = vehicle, dt_s
        self._filter = ResidualFilter(vehicle, dt_s)
        self._matrix = vehicle.acceleration_effectiveness
        self._variance = Disturbance(vehicle).floor ** 2  # (n,) of y in steady flight
        self._noise = np.diag(self._variance) * (Tuning().disturbance.correlation_s / dt_s)  # of independent samples

    @abstractmethod
    def memory(self) -> Any:
        """At the start of a flight, and after a declaration."""

    @abstractmethod
    def look(
        self,
        memory: Any,
        residual: NDArray[np.float64],
        thrust: NDArray[np.float64],
        measurement: Measurement,
        failed: NDArray[np.bool_],
    ) -> Look:
        """At y (n,) of the motors not declared, their thrusts w (m,) as they show in it, and what was measured."""

    def start(
        self,
        time_s: float,
        gyro: NDArray[np.float64],
        specific_force: NDArray[np.float64],
        command: NDArray[np.float64],
        failed: NDArray[np.bool_] | None = None,
        *,
        takes_off: bool = False,
    ) -> PeerState:
        """State at the first sample."""
        decision = DecisionState.start(self.vehicle.motors)
        if failed is not None:
            decision.failed = failed.copy()
        return PeerState(self._filter.start(gyro, specific_force, command), decision, self.memory())

    def step(self, state: PeerState, measurement: Measurement) -> tuple[PeerState, Estimate]:
        """One sample."""
        time_s, command = measurement.time_s, measurement.command
        filtered = self._filter.step(
            state.residual, measurement.gyro, measurement.specific_force, command, measurement.dt_s
        )
        failed = state.decision.failed if measurement.failed is None else measurement.failed
        thrust = np.where(failed, 0.0, filtered.thrust_shown)
        residual = filtered.measured - self._matrix @ thrust
        seen = self.look(state.memory, residual, thrust, measurement, failed)
        events, memory = list[Event](), seen.memory
        usable = seen.named >= 0 and not failed[seen.named]
        same = state.since_s is not None and seen.named == state.candidate
        since_s = (state.since_s if same else time_s) if usable else None
        if since_s is not None and time_s - since_s >= self.confirm_s - 1e-9 and failed.sum() < self.vehicle.motors - 4:
            failed = failed.copy()
            failed[seen.named] = True
            events.append(Event(time_s, seen.named + 1, True, 0.0, seen.sure))
            since_s, memory = None, self.memory()
        state.decision.failed = failed
        return PeerState(filtered, state.decision, memory, since_s, seen.named), Estimate(
            effectiveness=np.where(failed, 0.0, seen.effectiveness),
            deviation=np.full(self.vehicle.motors, 0.1),
            failed=failed,
            raw=residual,
            residual=residual - seen.disturbance,
            disturbance=seen.disturbance,
            features=None,
            thrust_shown=filtered.thrust_shown,
            lateral_m_s2=filtered.lateral_slow_m_s2,
            best=None,
            events=events,
        )
