"""Losses that cannot be told apart: when they are a set, for how long, and that nothing is done about them."""

from __future__ import annotations

from dataclasses import replace as replace_hypothesis

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.core.ambiguity import Among, followed, needed
from nff_companion.core.decision import Decision, DecisionState, Event
from nff_companion.core.onset import OnsetSums
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis, Weighing

TUNING = Tuning().decision
OPPOSITE = ((0, 1), (6, 7))  # of octo-x: either pair turns the yaw alone, to the same side
QUIET = (np.ones(8), np.full(8, 0.05), np.full(8, 0.5))


def sums_of(octo: Vehicle, loss: NDArray[np.float64], noise: NDArray[np.float64] | None = None) -> OnsetSums:
    """Of one window in which every motor is driven at hover, and motors lose ``loss`` (8,)."""
    matrix = octo.acceleration_effectiveness * octo.hover
    weight = 20.0 / np.array([0.5, 1.5, 1.5, 0.2]) ** 2
    y = -matrix @ loss + (0.0 if noise is None else noise)
    weighted = matrix * weight[:, None]
    energy = float(weight @ y**2)
    return OnsetSums((weighted.T @ matrix)[None], (weighted.T @ y)[None], np.array([energy]), np.array([0.2]))


def stepped(octo: Vehicle, loss: NDArray[np.float64], seconds: float) -> tuple[DecisionState, list[Event]]:
    decision, state, events = Decision(8, 4, TUNING), DecisionState.start(8), list[Event]()
    best = Weighing(8, TUNING).best(sums_of(octo, loss), np.zeros(8, bool), 0.0)
    for k in range(round(seconds / 0.005)):
        state, new = decision.step(state, 0.005 * k, best, *QUIET)
        events += new
        if events:
            break
    return state, events


@pytest.mark.parametrize("lost", OPPOSITE)
def test_opposite_motors_are_a_set_and_not_a_guess(octo: Vehicle, lost: tuple[int, int]) -> None:
    state, events = stepped(octo, np.isin(np.arange(8), lost).astype(float), 1.0)
    assert events == []
    assert state.among is not None
    assert state.among.told
    assert set(state.among.sets) == set(OPPOSITE)
    assert not state.failed.any()


def test_two_that_can_be_told_apart_are_declared(octo: Vehicle) -> None:
    state, events = stepped(octo, np.isin(np.arange(8), (0, 4)).astype(float), 0.1)
    assert [event.motor for event in events] == [1, 5]
    assert state.among is None


def test_the_lead_that_is_needed_grows_with_what_there_is_to_explain(octo: Vehicle) -> None:
    assert needed(100.0, TUNING) == TUNING.margin_min
    assert needed(1000.0, TUNING) == pytest.approx(25.0)
    decision = Decision(8, 4, TUNING)
    leads = Hypothesis((0, 1), (1.0, 1.0), 700.0, 7.0, 0.99, 0.2)
    assert not decision.convincing(leads)
    assert Decision(8, 4, replace(TUNING, margin_share=0.0)).convincing(leads)


def test_a_set_is_said_after_its_time_stays_while_it_holds_and_goes() -> None:
    among: Among | None = None
    for k in range(40):
        among = followed(among, 0.005 * k, OPPOSITE, TUNING)
        assert among is not None
        assert among.told == (0.005 * k >= TUNING.among_after_s - 1e-9)
    same = followed(among, 0.3, OPPOSITE[1:], TUNING)  # the other one is behind for a moment
    assert same is not None
    assert (same.sets, same.since_s) == (OPPOSITE, 0.0)
    other = followed(same, 0.4, ((2, 3), (0, 1)), TUNING)
    assert other is not None
    assert (other.sets, other.told) == (((2, 3), (0, 1)), True)
    assert followed(other, 0.4 + 0.9 * TUNING.among_hold_s, (), TUNING) is other
    assert followed(other, 0.4 + 1.1 * TUNING.among_hold_s, (), TUNING) is None


def test_partial_losses_alone_are_no_set(octo: Vehicle) -> None:
    state, events = stepped(octo, np.where(np.isin(np.arange(8), OPPOSITE[0]), 0.4, 0.0), 1.0)
    assert (state.among, events) == (None, [])


def test_a_declaration_ends_a_set(octo: Vehicle) -> None:
    decision, zero = Decision(8, 4, TUNING), np.zeros(8, bool)
    state = DecisionState(failed=zero, among=Among(OPPOSITE, 0.0, 1.0, told=True))
    best = Weighing(8, TUNING).best(sums_of(vehicle.load("octo-x"), np.eye(8)[3]), zero, 0.0)
    assert best is not None
    for k in range(10):
        state, events = decision.step(state, 1.0 + 0.005 * k, best, *QUIET)
        if events:
            break
    assert [event.motor for event in events] == [4]
    assert state.among is None


def test_two_of_which_less_than_all_seems_lost_are_a_set_too(octo: Vehicle) -> None:
    """By a file whose motors give less than it says, a stopped motor seems to have lost 70 %."""
    state, events = stepped(octo, 0.7 * np.isin(np.arange(8), OPPOSITE[0]).astype(float), 1.0)
    assert events == []
    assert state.among is not None
    assert state.among.told
    assert set(state.among.sets) == set(OPPOSITE)


@pytest.mark.parametrize(
    ("stood_s", "moved", "declared"),
    [(0.3, False, True), (2.0, False, False), (2.0, True, True)],
)
def test_an_old_set_is_told_by_what_moves_alone(stood_s: float, moved: bool, declared: bool) -> None:
    """Of a turning vehicle the pair that works led by 55 nats of 420 for a second."""
    found = Hypothesis((0, 1), (0.95, 0.95), 420.0, 55.0, 0.95, 0.2, moved=moved)
    state = DecisionState(failed=np.zeros(8, bool), among=Among(OPPOSITE, 0.0, stood_s, told=True))
    events = list[Event]()
    for k in range(1, 20):
        state, new = Decision(8, 4, TUNING).step(state, stood_s + 0.005 * k, found, *QUIET)
        events += new
        if events:
            break
    assert [event.motor for event in events] == ([1, 2] if declared else [])


def test_what_moved_tells_two_of_which_less_than_all_seems_lost() -> None:
    less = Hypothesis((0, 1), (0.7, 0.7), 200.0, 30.0, 0.95, 0.2)
    assert not Decision(8, 4, TUNING).convincing(less)
    assert Decision(8, 4, TUNING).convincing(replace_hypothesis(less, moved=True))
    assert not Decision(8, 4, TUNING).convincing(replace_hypothesis(less, moved=True, loss=(0.9, 0.4)))


@pytest.mark.parametrize("other", range(1, 8))
def test_a_motor_that_is_lost_whatever_else_is_named_alone(octo: Vehicle, other: int) -> None:
    """By a file that is off a part of another motor explains what the lost one leaves; no pair would be declared."""
    lost = np.eye(8)[0] + 0.25 * np.eye(8)[other]
    best = Weighing(8, TUNING).best(sums_of(octo, lost), np.zeros(8, bool), 0.0)
    assert best is not None
    assert best.shared
    _, events = stepped(octo, lost, 0.2)
    assert [event.motor for event in events] == [1]
