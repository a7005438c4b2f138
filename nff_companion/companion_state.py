"""What the companion is told, remembers and says: orders in, the state between steps, the output of each.

Structs of msgspec: replacing one field of a frozen dataclass of this size costs fifteen times as much.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.handover import HandoverState
from nff_companion.allocation.plan import Plan
from nff_companion.allocation.planner import PlannerState
from nff_companion.condition import Mode, Reason, Statement, read_only
from nff_companion.control.law import Knowledge
from nff_companion.control.override import OverrideState
from nff_companion.core import partial_loss
from nff_companion.core.decision import Event
from nff_companion.core.estimate import Estimate, EstimatorState
from nff_companion.core.fit import NOTHING, Fit, FitVerdict
from nff_companion.core.fit_monitor import FitState
from nff_companion.core.flight_phase import FlightPhaseState
from nff_companion.core.partial_loss import PartialLossState
from nff_companion.core.rotor_speed import RotorSpeedState
from nff_companion.core.wear import WearState


class Output(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Result of one step; arrays are read-only. ``plan`` is what should be in force: None, the autopilot's own."""

    time_s: float  # of the last sample, used or not, by the autopilot's clock
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
    either: tuple[int, ...] = ()  # two motors (from 1) above each other, of which one has failed
    among: tuple[tuple[int, ...], ...] = ()  # sets of motors (from 1) of which one has failed: which is not known
    weak: tuple[int, ...] = ()  # the motor (from 1) that has lost a part, or two above each other: one of them
    weak_left: float = 1.0  # effectiveness that it has left
    worn: tuple[int, ...] = ()  # the motor (from 1) that gives less than earlier, or two above each other: one of them
    worn_left: float = 1.0  # of what it gave
    worn_sure: bool = False  # False: or a load has moved
    unresponsive: tuple[int, ...] = ()  # the motor (from 1) that keeps its thrust whatever it is told
    more: tuple[int, ...] = ()  # the motor (from 1) that pulls more than asked, or two above each other: one of them
    probing: bool = False  # motors are moved to tell which of ``among`` it is
    fit: Fit = NOTHING  # of the airframe file to the vehicle that flies
    trusted: bool = True  # the file is confirmed, and nothing that was flown contradicts it
    notes: tuple[Statement, ...] = ()  # what the pilot should hear beside all that

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
_WORD_S = 2.0  # for which a word is there to be said: who speaks looks once a second
_HELD_BACK_S = 2.0  # after which a motor that was not declared is no longer spoken of


class CompanionState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Everything remembered between steps. ``failed`` is the one place where declared motors are kept."""

    mode: Mode  # asked for
    failed: NDArray[np.bool_]  # (m,) bool, read-only
    last: Output
    either: tuple[int, ...] = ()  # indices of two motors above each other, of which one is believed lost
    phase: FlightPhaseState = msgspec.field(default_factory=FlightPhaseState)
    estimate: EstimatorState | None = None
    planning: PlannerState
    handover: HandoverState  # of what was planned to the autopilot
    loop: OverrideState = msgspec.field(default_factory=OverrideState)
    speeds: RotorSpeedState
    knowledge: Knowledge
    adapted: Any = None  # of research
    fit: FitState
    confirmed: bool  # the airframe file is the vehicle's own, by somebody's word
    weak: PartialLossState = partial_loss.NOTHING  # which motor has lost a part of its thrust
    wear: WearState
    held_back: tuple[tuple[int, ...], float] = ((), -math.inf)  # motors that would have been declared, and when last
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

    @property
    def trusted(self) -> bool:
        """Whether the airframe file may be acted upon: by somebody's word or by what was flown, and nothing contradicts
        it."""
        return trusts(self.fit, confirmed=self.confirmed)

    @property
    def whole(self) -> bool:
        """In flight, and no failure is declared, allocated around, held back or being weighed. What seems to fail by a
        file that the motion contradicts does not count: it is the file that is wrong."""
        if self.estimate is None or self.trouble is not None or True in self.failed.tolist() or self.either:
            return False
        if self.fit.fit.verdict == FitVerdict.DOES_NOT_FIT:
            return True
        weighed = isinstance(self.estimate, EstimatorState) and not self.estimate.decision.quiet
        said = self.weak.told or self.fit.answers.told >= 0 or bool(self.wear.told)
        return not (weighed or said or self.held_back[0] or True in self.last.degraded.tolist())

    @property
    def doubt(self) -> Statement | None:
        """Why the airframe file is not acted upon; None where it is."""
        if self.trusted:
            return None
        if self.fit.fit.verdict == FitVerdict.DOES_NOT_FIT:
            return Statement(Reason.WRONG_FILE, self.fit.fit.short)
        return Statement(Reason.UNCONFIRMED)

    def notes(self, time_s: float | None, word_s: float) -> tuple[Statement, ...]:
        """What the pilot should hear of the airframe file at ``time_s``; None: no sample has come. After ``word_s`` of
        flight also why nothing is known of it."""
        fit = self.fit.fit
        notes = [Statement(Reason.FILE_OFF, short) for short, _ in fit.differs]
        if self.fit.proven and not self.confirmed:
            notes.append(Statement(Reason.FILE_CONFIRMED))
        motors, at_s = self.held_back
        unknown = not self.trusted and fit.verdict == FitVerdict.UNKNOWN
        if motors and unknown and time_s is not None and time_s - at_s < _HELD_BACK_S:
            notes.append(Statement(Reason.HELD_BACK, ", ".join(map(str, motors))))
        elif unknown and time_s is not None and isinstance(self.estimate, EstimatorState):
            flown_s = time_s - self.estimate.started_s
            if word_s <= flown_s < word_s + _WORD_S:
                notes.append(Statement(Reason.FILE_OPEN, fit.short))
        return tuple(notes)


def trusts(fit: FitState, *, confirmed: bool) -> bool:
    """Whether a file of which the flight has shown ``fit`` may be acted upon."""
    return fit.proven or (confirmed and fit.fit.verdict != FitVerdict.DOES_NOT_FIT)
