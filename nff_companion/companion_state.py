"""What the companion is told, remembers and says: orders in, the state between steps, the output of each.

Structs of msgspec: replacing one field of a frozen dataclass of this size costs fifteen times as much.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.plan import Plan
from nff_companion.allocation.planner import PlannerState
from nff_companion.condition import Mode, Reason, Statement, read_only
from nff_companion.control.law import Knowledge
from nff_companion.control.override import OverrideState
from nff_companion.core.decision import Event
from nff_companion.core.estimate import Estimate, EstimatorState
from nff_companion.core.flight_phase import FlightPhaseState
from nff_companion.core.rotor_speed import RotorSpeedState


class Output(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Result of one step; arrays are read-only. ``plan`` is what should be in force: None, the autopilot's own."""

    time_s: float  # of the last good sample, by the autopilot's clock
    mode: Mode  # in effect
    obstacle: Statement | None  # why it is not the mode asked for, or why what was decided has no matrix
    flying: bool
    failed: NDArray[np.bool_]  # (m,) bool
    effectiveness: NDArray[np.float64]  # (m,)
    deviation: NDArray[np.float64]  # (m,)
    degraded: NDArray[np.bool_]  # (m,) bool: allocated around, not declared
    events: tuple[Event, ...]
    plan: Plan | None
    override: NDArray[np.float64] | None  # (m,) motor outputs 0..1
    estimate: Estimate | None
    unallocated: NDArray[np.float64]  # (n,)
    rejected: int  # matrices that failed the check so far
    bad_samples: int

    @property
    def believed(self) -> NDArray[np.float64]:
        """(m,) effectiveness to be told: 0 of what is declared, of a partial loss what is left, of the rest 1."""
        partly = np.where(self.degraded, np.clip(self.effectiveness, 0.1, 1.0), 1.0)
        return read_only(np.where(self.failed, 0.0, partly))


class Orders(msgspec.Struct, frozen=True, kw_only=True):
    """What the operator, or a restart, wants; applied at the head of a step. Motors count from 1."""

    mode: Mode | None = None
    lift: tuple[int, ...] = ()
    adopt: tuple[int, ...] | None = None  # all declarations that the autopilot holds: its word replaces ours


NO_ORDERS = Orders()


class CompanionState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Everything remembered between steps. ``failed`` is the one place where declared motors are kept."""

    mode: Mode  # asked for
    failed: NDArray[np.bool_]  # (m,) bool, read-only
    last: Output
    phase: FlightPhaseState = msgspec.field(default_factory=FlightPhaseState)
    estimate: EstimatorState | None = None
    planning: PlannerState
    loop: OverrideState = msgspec.field(default_factory=OverrideState)
    speeds: RotorSpeedState
    knowledge: Knowledge
    adapted: Any = None  # of research
    last_s: float | None = None  # the last good sample; None: the next one begins anew
    good_since_s: float | None = None
    # Why the samples cannot be used now.
    trouble: Statement | None = msgspec.field(default_factory=lambda: Statement(Reason.WAITING))
    blind: Statement | None = None  # why override cannot close the loop
    fault: bool = False  # the estimator itself failed, and has not worked since
    bad_samples: int = 0

    @property
    def watching(self) -> bool:
        """Whether a flight is being estimated: nothing that it rests on may change now."""
        return self.estimate is not None
