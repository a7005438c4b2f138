"""What a step comes to: the mode in effect, what stands in the way, and the output that says so. Pure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.companion_state import CompanionState, Output
from nff_companion.condition import Condition, Mode, Reason, Scalar, Statement, first, read_only
from nff_companion.core import partial_loss
from nff_companion.core.estimate import Estimate
from nff_companion.core.mates import HALF


def acting(state: CompanionState, condition: Condition) -> Mode:
    """The mode that nothing stands in the way of."""
    if state.trouble is not None or condition.command is not None or not state.trusted:
        return Mode.OBSERVE
    return Mode.OBSERVE if state.mode == Mode.ALLOCATE and condition.allocate is not None else state.mode


def obstacle(state: CompanionState, condition: Condition, mode: Mode) -> Statement | None:
    """Why the ``mode`` in effect is not the one asked for, or why there is no matrix for what was decided."""
    allocate = condition.allocate if state.mode == Mode.ALLOCATE else None
    none = state.planning.refusal
    no_plan = None
    if none is not None:
        no_plan = Statement(Reason.NO_PLAN, none.reason) if none.lift else Statement(Reason.NO_LIFT)
    blind = state.blind if state.mode == Mode.OVERRIDE and mode == Mode.ALLOCATE else None
    # What the autopilot itself says stands in the way is plainer than what the motion says.
    doubt = state.doubt if condition.command is None else None
    return first(state.trouble, condition.command, doubt, allocate, no_plan, blind)


class Outcome:
    """Constants of a vehicle with so many motors and axes."""

    def __init__(self, motors: int, axes: int) -> None:
        self._none, self._ones = read_only(np.zeros(axes)), read_only(np.ones(motors))
        self._no_motor = read_only(np.zeros(motors, bool))

    def first(self) -> Output:
        """Before anything was heard."""
        return Output(
            time_s=0.0,
            mode=Mode.OBSERVE,
            obstacle=Statement(Reason.WAITING),
            flying=False,
            failed=self._no_motor,
            effectiveness=self._ones,
            deviation=self._ones,
            degraded=self._no_motor,
            events=(),
            plan=None,
            override=None,
            estimate=None,
            unallocated=self._none,
            rejected=0,
            bad_samples=0,
        )

    def output(
        self,
        state: CompanionState,
        condition: Condition,
        time_s: float | None,
        estimate: Estimate | None,
        override: NDArray[np.float64] | None,
        notes: tuple[Statement, ...],
    ) -> Output:
        """Of a step; without a sample (``time_s`` None) it bears the time of the last one. ``override``: motor outputs
        (m,) that answered the sample."""
        mode, planning, failed = acting(state, condition), state.planning, state.failed
        weak = state.weak if state.trusted else partial_loss.NOTHING
        worn = tuple(motor + 1 for motor in state.wear.told) if state.trusted and not weak.told else ()
        if mode == Mode.OVERRIDE and override is None:
            mode = Mode.ALLOCATE
        if estimate is not None:
            effectiveness, deviation = _shut(estimate.effectiveness), _shut(estimate.deviation)
            held = planning.partial.held
            if planning.partial.any:
                partly = (held < 1.0) & ~estimate.failed
                partly[list(estimate.either)] = False
                effectiveness = read_only(np.where(partly, held, effectiveness))
        else:
            effectiveness, deviation = self._ones, self._ones
            if failed.any() or state.either:
                believed = np.where(failed, 0.0, 1.0)
                believed[list(state.either)] = HALF
                effectiveness = read_only(believed)
        return Output(
            time_s=state.last.time_s if time_s is None else time_s,
            mode=mode,
            obstacle=obstacle(state, condition, mode),
            flying=state.watching,
            failed=failed,
            effectiveness=effectiveness,
            deviation=deviation,
            degraded=self._no_motor if planning.untouched else _shut(planning.degraded & ~failed),
            events=() if estimate is None or time_s is None else tuple(estimate.events),
            plan=state.handover.told(planning.plan) if mode != Mode.OBSERVE else None,
            override=override if mode == Mode.OVERRIDE else None,
            estimate=estimate,
            unallocated=self._none if planning.plan is None else planning.plan.unallocated,
            rejected=planning.rejected,
            bad_samples=state.bad_samples,
            either=tuple(motor + 1 for motor in state.either),
            among=() if estimate is None else tuple(tuple(i + 1 for i in motors) for motors in estimate.among),
            more=() if estimate is None else tuple(motor + 1 for motor in estimate.more),
            weak=tuple(motor + 1 for motor in weak.told),
            weak_left=1.0 - weak.told_loss,
            worn=worn,
            worn_left=1.0 - state.wear.loss if worn else 1.0,
            worn_sure=state.wear.sure,
            unresponsive=self._unresponsive(state),
            probing=planning.probing and (mode == Mode.OVERRIDE or (mode == Mode.ALLOCATE and condition.takes_matrix)),
            fit=state.fit.fit,
            trusted=state.trusted,
            notes=notes,
        )

    @staticmethod
    def _unresponsive(state: CompanionState) -> tuple[int, ...]:
        """The motor (from 1) that does not answer: none that is known to have lost a part, of which half comes."""
        told, held = state.fit.answers.told, state.planning.partial.held
        known = told in state.weak.told or (told >= 0 and held[told] < 1.0)
        return (told + 1,) if told >= 0 and state.trusted and not known else ()


def _shut(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """The same numbers, which nobody can write to through it."""
    view = array.view()
    view.flags.writeable = False
    return view
