"""What to tell an autopilot, and when: declare until confirmed, load, drive, release. The same for every adapter."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

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
    failed: NDArray[np.bool_]
    effectiveness: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Load:
    """Use this matrix until it expires, ``timeout_s`` after it came; it belongs to the motors ``failed`` (m,) bool."""

    time_s: float
    plan: Plan
    failed: NDArray[np.bool_]
    timeout_s: float = times.MATRIX_TIMEOUT_S


@dataclass(frozen=True, slots=True)
class Drive:
    """Use these motor ``outputs`` (m,) in 0..1 until they expire; ``time_s`` is that of the sample that they answer."""

    time_s: float
    outputs: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Release:
    """Drop the matrix; declarations stay, outputs expire by themselves. ``leaving``: nothing more will be said."""

    time_s: float
    leaving: bool = False


Command = Declare | Load | Drive | Release


class ScheduleState(msgspec.Struct, frozen=True, eq=False):
    """What was told last, by the autopilot's clock. ``lifted`` (m,) bool: by the operator's word since ``lifted_s``,
    which is told in every mode until confirmed, or no longer fresh."""

    told: NDArray[np.bool_]  # (m,) bool, of the last declaration
    effectiveness: NDArray[np.float64]  # (m,)
    told_s: float = -np.inf
    since_s: float = -np.inf  # since when this set is being told
    plan: Plan | None = None  # last streamed
    plan_s: float = -np.inf
    lifted: NDArray[np.bool_] | None = None
    lifted_s: float = -np.inf

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
    if acting and output.flying:
        state = state if state.lifted is None else replace(state, lifted=None)
        state, told = _declare(state, output, condition, time_s)
        commands += told
    elif state.lifted is not None:
        state, told = _lift(state, state.lifted, condition, time_s)
        commands += told
    if not acting:
        return state, commands
    plan = output.plan if condition.takes_matrix else None
    if plan is not None:
        if plan is not state.plan or not 0.0 <= time_s - state.plan_s < times.MATRIX_INTERVAL_S - _JITTER_S:
            state = replace(state, plan=plan, plan_s=time_s)
            timeout_s = times.PROBE_TIMEOUT_S if output.probing else times.MATRIX_TIMEOUT_S
            commands.append(Load(time_s, plan, output.failed, timeout_s))
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


def _lift(
    state: ScheduleState, motors: NDArray[np.bool_], condition: Condition, time_s: float
) -> tuple[ScheduleState, list[Command]]:
    """The operator's word where we do not act: of what the autopilot holds these ``motors`` go, nothing is added; while
    it does not say what it holds, the word waits."""
    held = condition.in_force.failed
    fresh = 0.0 <= time_s - state.lifted_s < times.ORDER_MAX_S
    if not fresh or (held is not None and not (held & motors).any()):
        return replace(state, lifted=None), []
    if held is None or 0.0 <= time_s - state.told_s < times.DECLARATION_INTERVAL_S - _JITTER_S:
        return state, []
    left = read_only(held & ~motors)
    return replace(state, told_s=time_s), [Declare(time_s, left, read_only(np.where(left, 0.0, 1.0)))]


def lifted(state: ScheduleState, motors: Iterable[int], time_s: float) -> ScheduleState:
    """The operator lifts ``motors`` (from 1): that is told at once, and in every mode."""
    mask = np.zeros(len(state.told), bool)
    mask[[motor - 1 for motor in motors]] = True
    if state.lifted is not None:
        mask |= state.lifted
    return replace(state, lifted=read_only(mask), lifted_s=time_s, told_s=-np.inf)


def released(state: ScheduleState, time_s: float, *, leaving: bool = False) -> tuple[ScheduleState, list[Command]]:
    """The vehicle is given back: at the end (``leaving``), or when the operator chooses to observe."""
    return replace(state, plan=None, plan_s=-np.inf), [Release(time_s, leaving)]
