"""Two motors above each other: one of them has failed, and what is done is right for either."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimates import hovering
from msgspec.structs import replace as changed
from numpy.typing import NDArray

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan
from nff_companion.allocation.planner import Planner
from nff_companion.companion import Companion
from nff_companion.core import vehicle as vehicles
from nff_companion.core import works_again
from nff_companion.core.ambiguity import Among
from nff_companion.core.decision import Decision, DecisionState
from nff_companion.core.mates import Mates
from nff_companion.core.onset import OnsetSums
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import PITCH, ROLL, Vehicle
from nff_companion.core.weighing import Hypothesis, Weighing

TUNING = Tuning()
COAX = {1: 6, 2: 5, 3: 8, 4: 7}


@pytest.fixture(scope="module")
def coax() -> Vehicle:
    return vehicles.load("coax-x8")


def test_motors_above_each_other_are_found_and_of_others_none(coax: Vehicle, octo: Vehicle) -> None:
    mates = Mates(coax, TUNING)
    for one, other in COAX.items():
        assert (mates.of[one - 1], mates.of[other - 1]) == (other - 1, one - 1)
        assert mates.place((other - 1,)) == mates.place((one - 1, other - 1)) == (one - 1, other - 1)
    assert mates.place((0, 1)) == ()
    for vehicle in (octo, vehicles.load("hexa-x"), vehicles.load("octo-plus"), vehicles.load("paper-octo")):
        assert not Mates(vehicle, TUNING).any
        assert Mates(vehicle, TUNING).place((0,)) == ()


def test_yaw_tells_them_apart_in_still_air_and_not_in_fast_flight(coax: Vehicle) -> None:
    mates, thrust = Mates(coax, TUNING), np.full(8, 0.4)
    residual = -coax.acceleration_effectiveness[:, 2] * 0.4
    assert mates.told_apart(2, thrust, residual, 0.3, np.zeros(4))
    assert not mates.told_apart(2, thrust, residual, 4.0, np.zeros(4))
    assert not mates.told_apart(2, thrust, residual, 0.3, np.array([0.0, 0.0, 0.0, 2.0]))
    assert np.abs(residual[ROLL : PITCH + 1]).min() > 1.0


def weighed(
    coax: Vehicle, samples: int, state: DecisionState, best: Hypothesis, from_s: float = 5.0
) -> tuple[DecisionState, list[int]]:
    decision = Decision(8, 4, TUNING.decision, Mates(coax, TUNING))
    driven, named = np.full(8, 0.4), list[int]()
    for k in range(samples):
        state, events = decision.step(state, from_s + 0.005 * k, best, np.ones(8), np.full(8, 0.02), driven)
        named += [event.motor for event in events]
    return state, named


BEST = Hypothesis((7,), (0.95,), 40.0, 0.5, 0.9, 0.09, beside=30.0, place=(2, 7))


def test_one_of_two_is_believed_lost_and_when_the_rest_goes_both_are_declared(coax: Vehicle) -> None:
    state, named = weighed(coax, 2, DecisionState.start(8), BEST)
    assert (state.either, named) == ((), []), "not by one shock"
    state, named = weighed(coax, 4, state, BEST, 5.01)
    assert (state.either, named) == ((2, 7), [])
    assert not state.failed.any()
    state, named = weighed(coax, 5, state, BEST, 5.03)
    assert named == [3, 8]
    assert state.either == ()
    assert np.flatnonzero(state.failed).tolist() == [2, 7]


DOUBTFUL = (
    replace(BEST, improvement=5.0),
    replace(BEST, beside=1.0),
    replace(BEST, explained=0.3),
    replace(BEST, loss=(0.2,)),
    replace(BEST, place_loss=0.2),
)


@pytest.mark.parametrize("doubtful", DOUBTFUL)
def test_what_is_not_sure_of_the_place_is_not_believed(coax: Vehicle, doubtful: Hypothesis) -> None:
    state, named = weighed(coax, 20, DecisionState.start(8), doubtful)
    assert (state.either, named) == ((), [])


def test_what_is_believed_stays_when_nothing_shows_any_more(coax: Vehicle) -> None:
    state, _ = weighed(coax, 6, DecisionState.start(8), BEST)
    decision = Decision(8, 4, TUNING.decision, Mates(coax, TUNING))
    for k in range(100):
        state, events = decision.step(state, 6.0 + 0.005 * k, None, np.ones(8), np.full(8, 0.02), np.full(8, 0.4))
        assert events == []
    assert state.either == (2, 7)


def test_the_matrix_for_either_gives_both_the_same_and_lifts_by_one(coax: Vehicle) -> None:
    planner = Planner(coax, allocator("trim"), TUNING.planner)
    estimate = hovering(coax, np.where(np.isin(np.arange(8), (2, 7)), 0.5, 1.0), either=(2, 7))
    state = planner.step(planner.start(), 5.0, estimate)
    assert isinstance(state.plan, Plan), "at once"
    assert np.flatnonzero(state.degraded).tolist() == [2, 7]
    matrix = state.plan.matrix
    np.testing.assert_allclose(matrix[2], matrix[7], atol=1e-9)
    for dead in (2, 7):
        left = np.where(np.arange(8) == dead, 0.0, 1.0)
        wrench = coax.effectiveness @ (left[:, None] * matrix)
        np.testing.assert_allclose(wrench[:3], np.eye(4)[:3], atol=0.02)
    again = planner.step(state, 5.005, estimate)
    assert again.plan is state.plan


def test_the_tuning_decides_how_sure_yaw_must_be(coax: Vehicle) -> None:
    strict = changed(TUNING, decision=changed(TUNING.decision, mates_sure=10.0))
    thrust, residual = np.full(8, 0.4), -coax.acceleration_effectiveness[:, 2] * 0.4
    assert not Mates(coax, strict).told_apart(2, thrust, residual, 0.3, np.zeros(4))
    assert Companion(coax, 200.0, strict).tuning.decision.mates_sure == 10.0


def windows(coax: Vehicle, y: NDArray[np.float64]) -> OnsetSums:
    """Of one window in which every motor is driven at hover, and the residual is ``y`` (4,)."""
    matrix = coax.acceleration_effectiveness * coax.hover
    weight = 20.0 / np.array([0.5, 1.5, 1.5, 0.2]) ** 2
    weighted = matrix * weight[:, None]
    energy = np.array([float(weight @ y**2)])
    return OnsetSums((weighted.T @ matrix)[None], (weighted.T @ y)[None], energy, np.array([0.2]))


@pytest.mark.parametrize("one", [1, 2, 3, 4])
def test_where_one_of_the_two_works_again_nobody_across_is_lost(coax: Vehicle, one: int) -> None:
    """It turns the vehicle as the loss of those on the other side does."""
    place, weighing = (one - 1, COAX[one] - 1), Weighing(8, TUNING.decision, Mates(coax, TUNING))
    matrix = coax.acceleration_effectiveness * coax.hover
    again = windows(coax, 0.5 * matrix[:, place].sum(axis=1))
    decision, nobody = Decision(8, 4, TUNING.decision, Mates(coax, TUNING)), np.zeros(8, bool)
    unknown = weighing.best(again, nobody, 0.0)
    assert unknown is not None
    known = weighing.best(again, nobody, 0.0, place)
    assert known is not None
    assert known.overruled
    assert not decision.convincing(known)
    # Nor is it by the sparse estimate, which sees nothing of it.
    state = DecisionState(failed=nobody, either=place)
    eta = np.where(np.arange(8) == known.motors[0], 0.05, 1.0)
    for k in range(200):
        state, events = decision.step(state, 0.005 * k, known, eta, np.full(8, 0.02), np.full(8, 0.4))
        assert events == []


@pytest.mark.parametrize("lost", range(8))
def test_another_that_is_lost_beside_one_of_the_two_is_named(coax: Vehicle, lost: int) -> None:
    place = next((one - 1, other - 1) for one, other in COAX.items() if lost + 1 not in (one, other))
    weighing = Weighing(8, TUNING.decision, Mates(coax, TUNING))
    matrix = coax.acceleration_effectiveness * coax.hover
    best = weighing.best(windows(coax, -matrix[:, lost]), np.zeros(8, bool), 0.0, place)
    assert best is not None
    assert best.motors == (lost,)
    assert best.margin > TUNING.decision.margin_min


@pytest.mark.parametrize("again", [0.0, 0.5])
@pytest.mark.parametrize("lost", range(8))
def test_another_that_fails_while_one_of_the_two_works_again_is_named_or_nobody(
    coax: Vehicle, lost: int, again: float
) -> None:
    place = next((one - 1, other - 1) for one, other in COAX.items() if lost + 1 not in (one, other))
    decision = Decision(8, 4, TUNING.decision, Mates(coax, TUNING))
    matrix, nobody = coax.acceleration_effectiveness * coax.hover, np.zeros(8, bool)
    sums = windows(coax, again * matrix[:, place].sum(axis=1) - matrix[:, lost])
    alone = Weighing(8, TUNING.decision, Mates(coax, TUNING)).best(sums, nobody, 0.0, place)
    assert alone is not None
    best = works_again.beside(alone, sums, place, nobody, 0.0, TUNING.decision)
    named = best.motors if decision.convincing(best) and not best.overruled else ()
    assert named in ((), (lost,)), best
    assert again or named


def test_a_part_more_than_one_of_the_two_is_not_the_other_one_too(coax: Vehicle) -> None:
    """One that turned the wrong way seemed 0.62 more than lost, and its whole arm was taken off."""
    state = DecisionState(failed=np.zeros(8, bool), either=(3, 6))
    found = Hypothesis((3,), (0.65,), 200.0, 20.0, 0.97, 0.2, beside=20.0, place=(3, 6))
    after, named = weighed(coax, 40, state, found)
    assert (named, after.either) == ([], (3, 6))
    _, named = weighed(coax, 40, state, replace(found, loss=(0.95,)))
    assert named[:2] == [4, 7]


def test_while_a_motor_pulls_more_no_other_two_are_doubted(coax: Vehicle) -> None:
    pulls = Among(((1, 4),), 4.0, 5.0, told=True)
    state = DecisionState(failed=np.zeros(8, bool), more=pulls)
    found = Hypothesis((6,), (0.9,), 100.0, 20.0, 0.9, 0.2, beside=20.0, place=(3, 6))
    after, named = weighed(coax, 40, state, found)
    assert (named, after.either) == ([], ())
