"""What to tell an autopilot, and when: declare until confirmed, load, drive, release. The same for every adapter."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots import times
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, Mode, read_only

# Of a motor's effectiveness, where no matrix is taken: each telling may wear the autopilot's parameter storage.
_CHANGE_MIN, _CHANGE_INTERVAL_S = 0.15, 1.0
_JITTER_S = 1e-6  # of the autopilot's clock


@dataclass(frozen=True, slots=True)
class Declare:
    """These motors have failed (``failed`` (m,) bool); ``effectiveness`` (m,): 0 for those, else what is believed."""

    time_s: float
    failed: np.ndarray
    effectiveness: np.ndarray


@dataclass(frozen=True, slots=True)
class Load:
    """Use this matrix until it expires; it belongs to the motors ``failed`` (m,) bool."""

    time_s: float
    plan: Plan
    failed: np.ndarray


@dataclass(frozen=True, slots=True)
class Drive:
    """Use these motor ``outputs`` (m,) in 0..1 until they expire; ``time_s`` is that of the sample that they answer."""

    time_s: float
    outputs: np.ndarray


@dataclass(frozen=True, slots=True)
class Release:
    """Drop the matrix; declarations stay, outputs expire by themselves. ``leaving``: nothing more will be said."""

    time_s: float
    leaving: bool = False


Command = Declare | Load | Drive | Release


class ScheduleState(msgspec.Struct, frozen=True, eq=False):
    """What was told last, by the autopilot's clock. ``word``: the operator's, told in every mode until confirmed."""

    told: np.ndarray  # (m,) bool, of the last declaration
    effectiveness: np.ndarray  # (m,)
    told_s: float = -np.inf
    since_s: float = -np.inf  # since when this set is being told
    plan: Plan | None = None  # last streamed
    plan_s: float = -np.inf
    word: bool = False

    @staticmethod
    def start(motors: int) -> ScheduleState:
        """Nothing told."""
        return ScheduleState(read_only(np.zeros(motors, bool)), read_only(np.ones(motors)))

    def unconfirmed_s(self, condition: Condition, time_s: float) -> float:
        """How long the autopilot has not confirmed what it was told; 0 when it has, or was told nothing."""
        if not np.isfinite(self.since_s) or condition.in_force.holds(self.told):
            return 0.0
        return max(time_s - self.since_s, 0.0)


def steps(
    state: ScheduleState, output: Output, condition: Condition, time_s: float
) -> tuple[ScheduleState, list[Command]]:
    """What is due after ``output``; ``time_s`` by the autopilot's clock: of the sample, or a guess where none comes."""
    commands: list[Command] = []
    acting = output.mode != Mode.OBSERVE
    if state.word and condition.in_force.holds(output.failed):
        state = replace(state, word=False)
    if state.word or (acting and output.flying):
        state, told = _declare(state, output, condition, time_s)
        commands += told
    if not acting:
        return state, commands
    plan = output.plan if condition.takes_matrix else None
    if plan is not None:
        if plan is not state.plan or not 0.0 <= time_s - state.plan_s < times.MATRIX_INTERVAL_S - _JITTER_S:
            state = replace(state, plan=plan, plan_s=time_s)
            commands.append(Load(time_s, plan, output.failed))
    elif state.plan is not None:
        state = replace(state, plan=None)
        commands.append(Release(time_s))
    return state, commands


def _declare(
    state: ScheduleState, output: Output, condition: Condition, time_s: float
) -> tuple[ScheduleState, list[Command]]:
    """The declaration, when it changed, or is not yet confirmed."""
    changed = output.failed is not state.told and bool((output.failed != state.told).any())
    waited = time_s - state.told_s
    unconfirmed = (
        not condition.in_force.holds(output.failed) and not 0.0 <= waited < times.DECLARATION_INTERVAL_S - _JITTER_S
    )
    weakened = (
        not condition.takes_matrix
        and not 0.0 <= waited < _CHANGE_INTERVAL_S - _JITTER_S
        and float(np.abs(output.believed - state.effectiveness).max()) >= _CHANGE_MIN
    )
    if not (changed or unconfirmed or weakened):
        return state, []
    believed = output.believed
    # An autopilot that holds the same by itself (none failed, at the start of a flight) was told nothing.
    new = changed or weakened or not np.isfinite(state.since_s)
    state = replace(
        state,
        told=output.failed,
        effectiveness=believed,
        told_s=time_s,
        since_s=time_s if new else state.since_s,
    )
    return state, [Declare(time_s, output.failed, believed)]


def by_the_operator(state: ScheduleState) -> ScheduleState:
    """The operator has spoken: what is believed now is told in every mode, until confirmed."""
    return replace(state, word=True, told_s=-np.inf)


def released(state: ScheduleState, time_s: float, *, leaving: bool = False) -> tuple[ScheduleState, list[Command]]:
    """The vehicle is given back: at the end (``leaving``), or when the operator chooses to observe."""
    return replace(state, plan=None, plan_s=-np.inf), [Release(time_s, leaving)]
