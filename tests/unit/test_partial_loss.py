"""A motor that has lost a part of its thrust: what tells it, what does not, and until when it stays told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimates import hovering

from nff_companion.allocation.partial import Partial, PartialState
from nff_companion.core import partial_loss, sparse
from nff_companion.core.partial_loss import NOTHING, PartialLossState
from nff_companion.core.slid_load import SlidLoadState
from nff_companion.core.tuning import PlannerTuning, Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis

TUNING = Tuning().decision
THIRD = Hypothesis((2,), (0.3,), 40.0, 20.0, 0.95, 0.2, beside=20.0)
LACKS_LIFT = SlidLoadState(sparse.Information.empty(8), 0.3, 0.0, nats=5.0)
DT_S = 0.005
NO_MOTOR = np.zeros(8, bool)


def watched(
    best: Hypothesis | None,
    state: PartialLossState = NOTHING,
    *,
    seconds: float = 0.2,
    place: tuple[int, ...] = (),
    load: SlidLoadState | None = LACKS_LIFT,
    again: float = 0.0,
    lost: float = 0.0,
) -> PartialLossState:
    for k in range(round(seconds / DT_S)):
        effectiveness = 1.0 - lost * (np.arange(8) == 2)
        state = partial_loss.followed(state, DT_S * k, best, place, load, again, effectiveness, TUNING)
    return state


def test_it_is_told_after_its_time_with_the_loss_of_the_best_window() -> None:
    assert watched(THIRD, seconds=0.9 * TUNING.partial_confirm_s).told == ()
    state = watched(THIRD)
    assert (state.told, state.told_loss) == ((2,), 0.3)
    better = watched(replace(THIRD, loss=(0.33,), improvement=60.0), state)
    assert better.told_loss == 0.33
    learnt = watched(replace(THIRD, loss=(0.2,), improvement=25.0), better)
    assert (learnt.told, learnt.told_loss) == ((2,), 0.33)


@pytest.mark.parametrize(
    ("best", "load"),
    [
        (replace(THIRD, loss=(0.1,)), LACKS_LIFT),
        (replace(THIRD, improvement=15.0), LACKS_LIFT),
        (replace(THIRD, margin=4.0), LACKS_LIFT),
        (replace(THIRD, explained=0.7), LACKS_LIFT),
        (replace(THIRD, age_s=0.05), LACKS_LIFT),
        (replace(THIRD, overruled=True), LACKS_LIFT),
        (replace(THIRD, more=4), LACKS_LIFT),
        (replace(THIRD, motors=(2, 3), loss=(0.3, 0.3)), LACKS_LIFT),
        (THIRD, None),
        (THIRD, replace(LACKS_LIFT, nats=1.0)),  # a load that slid
    ],
)
def test_less_than_that_is_not_told(best: Hypothesis, load: SlidLoadState | None) -> None:
    assert watched(best, load=load, seconds=1.0).told == ()


def test_a_moment_in_which_it_does_not_lead_begins_anew() -> None:
    state = watched(THIRD, seconds=0.08)
    state = watched(None, state, seconds=DT_S)
    assert watched(THIRD, state, seconds=0.08).told == ()


def test_of_two_above_each_other_one_is_told_by_what_it_leads_elsewhere() -> None:
    behind = replace(THIRD, margin=0.0)
    assert watched(behind, place=(2, 5)).told == (2, 5)
    assert watched(replace(behind, beside=3.0), place=(2, 5)).told == ()


def test_it_stays_told_while_nothing_shows_and_until_it_gives_more_again() -> None:
    told = replace(watched(THIRD), shown_s=-1.0)
    assert watched(None, told, seconds=30.0).told == (2,)
    other = replace(THIRD, motors=(6,), improvement=30.0)
    assert watched(other, told, seconds=0.05, again=25.0).told == (2,), "another explains more"
    assert watched(None, told, seconds=DT_S, again=TUNING.improvement_min + 1.0).told == ()


def test_what_ends_at_once_has_not_been_learnt_but_works_again() -> None:
    told = watched(THIRD, watched(THIRD, lost=0.3), lost=0.3)
    assert watched(None, replace(told, shown_s=-1.0), lost=0.05, seconds=DT_S).told == (2,), "learnt meanwhile"
    assert watched(None, told, lost=0.05, seconds=DT_S, load=replace(LACKS_LIFT, slid=True)).told == (2,)
    assert watched(replace(THIRD, motors=(3,)), told, lost=0.0, seconds=DT_S).told == (2,), "another explains it"
    assert watched(None, told, lost=0.05, seconds=DT_S).told == ()


def test_another_one_takes_its_place() -> None:
    state = watched(replace(THIRD, motors=(6,)), watched(THIRD))
    assert state.told == (6,)


def test_beside_a_loss_in_full_it_stays_but_for_the_motor_that_is_lost() -> None:
    told = watched(THIRD)
    assert partial_loss.beside(NOTHING, NO_MOTOR, ()) is NOTHING
    assert partial_loss.beside(told, np.arange(8) == 4, ()).told == (2,)
    assert partial_loss.beside(told, np.arange(8) == 2, ()).told == ()
    assert partial_loss.beside(told, NO_MOTOR, (2, 5)).told == ()


def test_while_it_shows_no_other_motor_begins_to_be_allocated_around(octo: Vehicle) -> None:
    lost = np.where(np.arange(8) == 2, 0.5, 1.0)
    for weak, shows, held in (((), False, True), ((2,), True, True), ((6,), True, False), ((6,), False, True)):
        state = PartialState.start(8)
        estimate = replace(hovering(octo, lost), weak=weak, weak_shows=shows)
        for k in range(100):
            state = Partial(PlannerTuning()).step(state, 6.0 + 0.01 * k, estimate, trusted=True)
        assert state.any == held
