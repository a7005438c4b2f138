"""A motor that has lost a part of its thrust: told by what the onset windows show, and by the lift that is missing.

One motor explains the last moments better than none, any other and any pair, by a loss too small to be declared. A load
that slid turns the vehicle as well; it takes no lift, so the thrust axis must speak for the loss (core/slid_load.py).
What is told stays told: within seconds it is learnt with all else that is steady, and shows no longer. It ends when
the motor gives more again (what was learnt shows the other way round, or what was not ends at once and nothing else
comes), when it is declared, or another one is told. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.ambiguity import needed
from nff_companion.core.slid_load import SlidLoadState
from nff_companion.core.tuning import DecisionTuning
from nff_companion.core.weighing import Hypothesis


@dataclass(frozen=True, slots=True)
class PartialLossState:
    """The motor (index; two: one of these above each other), since when it seems so, its loss by its best window so far
    and by how many nats that explains; ``told``: which are said."""

    motors: tuple[int, ...] = ()
    since_s: float = 0.0
    loss: float = 0.0
    improvement: float = 0.0
    told: tuple[int, ...] = ()
    told_loss: float = 0.0
    shown_s: float = 0.0  # when most of the told loss was last seen


NOTHING = PartialLossState()


def carried(state: PartialLossState) -> PartialLossState:
    """After a gap in the telemetry: what was told stays, times do not hold."""
    return PartialLossState(told=state.told, told_loss=state.told_loss, shown_s=-np.inf)


def beside(state: PartialLossState, failed: NDArray[np.bool_], either: tuple[int, ...]) -> PartialLossState:
    """While others are lost, or it is not told which: nothing more is found. ``failed`` (m,) bool and one of ``either``
    are lost in full."""
    if not state.motors and not state.told:
        return state
    lost = any(failed[motor] or motor in either for motor in state.told)
    return NOTHING if lost else replace(state, motors=(), improvement=0.0)


def shows(best: Hypothesis, place: tuple[int, ...], load: SlidLoadState | None, tuning: DecisionTuning) -> bool:
    """Whether one motor that has lost a part, or one of two above each other (``place``), explains the last moments."""
    if best.overruled or best.more >= 0 or best.shared or (len(best.motors) > 1 and not place):
        return False
    lead = best.beside if place else best.margin
    return (
        load is not None
        and load.nats >= tuning.partial_lift_min
        and sum(best.loss) >= tuning.partial_loss_min
        and best.age_s > tuning.settled_s
        and best.improvement >= tuning.improvement_min
        and lead >= needed(best.improvement, tuning)
        and best.explained >= tuning.partial_explained_min
    )


def followed(
    state: PartialLossState,
    time_s: float,
    best: Hypothesis | None,
    place: tuple[int, ...],
    load: SlidLoadState | None,
    again: float,
    effectiveness: NDArray[np.float64],
    tuning: DecisionTuning,
) -> PartialLossState:
    """A sample later. ``place``: the two motors (indices) above each other that ``best`` is about: of a part of what
    one of them gives yaw tells too little. ``again``: nats by which the last moments are explained by that what is
    told gives more again; ``effectiveness`` (m,) by the sparse program."""
    rival = 0.0 if best is None else best.improvement
    if state.told:
        lost, some = float((1.0 - effectiveness[list(state.told)]).sum()), tuning.partial_again_share * state.told_loss
        quiet = best is None and (load is None or not load.slid)
        at_once = quiet and lost < some and time_s - state.shown_s < tuning.partial_again_s
        if at_once or (again >= tuning.improvement_min and again - rival >= needed(again, tuning)):
            return NOTHING
        if best is not None and (place or best.motors) == state.told and sum(best.loss) > 2.0 * some:
            state = replace(state, shown_s=time_s)
    if best is None or not shows(best, place, load, tuning):
        return state if not state.motors else replace(state, motors=(), improvement=0.0)
    motors, loss = place or best.motors, min(sum(best.loss), 1.0)
    if motors != state.motors:
        state = replace(state, motors=motors, since_s=time_s, loss=loss, improvement=best.improvement)
    elif best.improvement >= state.improvement:
        state = replace(state, loss=loss, improvement=best.improvement)
    if state.told == motors:
        # The same loss goes on being weighed: that of its best window. Of one that was learnt it shows a part alone.
        return replace(state, told_loss=max(state.loss, state.told_loss))
    if time_s - state.since_s >= tuning.partial_confirm_s - 1e-9:
        return replace(state, told=motors, told_loss=state.loss, shown_s=-np.inf)
    return state
