"""A motor that pulls more than it is asked to: told from the loss of those on the other side; while it is said, nobody
else is blamed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import hypotheses
from nff_companion.core import vehicle as vehicles
from nff_companion.core.decision import Decision, DecisionState, Event
from nff_companion.core.mates import Mates
from nff_companion.core.onset import OnsetSums
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis, Weighing

TUNING = Tuning().decision
NOBODY = np.zeros(8, bool)
QUIET = (np.ones(8), np.full(8, 0.05), np.full(8, 0.5))


def sums_of(octo: Vehicle, thrust: NDArray[np.float64]) -> OnsetSums:
    """One window in which motors give ``thrust`` (8,), of full thrust, beyond what they are asked to, at hover."""
    matrix = octo.acceleration_effectiveness
    weight = 10.0 / np.array([0.5, 1.5, 1.5, 0.2]) ** 2
    y, driven = matrix @ thrust, matrix * octo.hover
    pulls, weighted = (part * weight[:, None] for part in (matrix, driven))
    return OnsetSums(
        matrix=(weighted.T @ driven)[None],
        vector=(weighted.T @ y)[None],
        energy=np.array([float(weight @ y**2)]),
        age_s=np.array([0.2]),
        more=(pulls.T @ y)[None],
        more_square=(pulls * matrix).sum(axis=0)[None],
    )


@pytest.mark.parametrize("motor", range(8))
def test_full_thrust_is_told_from_the_loss_of_the_opposite_motor(octo: Vehicle, motor: int) -> None:
    best = Weighing(8, TUNING).best(sums_of(octo, 0.5 * np.eye(8)[motor]), NOBODY, 0.0)
    assert best is not None
    assert best.more == motor
    assert best.margin < 0.0
    assert not Decision(8, 4, TUNING).convincing(best)


@pytest.mark.parametrize("motor", range(8))
def test_a_loss_is_not_taken_for_the_opposite_motor_pulling_more(octo: Vehicle, motor: int) -> None:
    best = Weighing(8, TUNING).best(sums_of(octo, -octo.hover * np.eye(8)[motor]), NOBODY, 0.0)
    assert best is not None
    assert (best.motors, best.more) == ((motor,), -1)
    assert Decision(8, 4, TUNING).convincing(best)


def test_while_it_is_said_nobody_else_is_declared(octo: Vehicle) -> None:
    decision, state, events = Decision(8, 4, TUNING), DecisionState.start(8), list[Event]()
    more = Weighing(8, TUNING).best(sums_of(octo, 0.5 * np.eye(8)[2]), NOBODY, 0.0)
    for k in range(60):
        state, new = decision.step(state, 0.005 * k, more, *QUIET)
        events += new
        assert state.more is not None
        assert state.more.told == (0.005 * k >= TUNING.among_after_s - 1e-9)
        assert state.more.sets == ((2,),)
    lost = Hypothesis((5,), (1.0,), 60.0, 30.0, 0.95, 0.09)
    for k in range(60, 120):
        state, new = decision.step(state, 0.005 * k, lost, *QUIET)
        events += new
    assert events == []
    for k in range(120, 400):  # not seen any more, and then it is over
        state, new = decision.step(state, 0.005 * k, None, *QUIET)
    assert state.more is None
    for k in range(400, 410):
        state, new = decision.step(state, 0.005 * k, lost, *QUIET)
        if new:
            break
    assert [event.motor for event in new] == [6]


def test_of_two_above_each_other_both_are_said() -> None:
    coaxial = vehicles.load("coax-x8")
    mates = Mates(coaxial, Tuning())
    decision, state = Decision(8, 4, TUNING, mates), DecisionState.start(8)
    best = Hypothesis((0,), (0.5,), 200.0, -100.0, 0.8, 0.2, more=2)
    for k in range(40):
        state, events = decision.step(state, 0.005 * k, best, *QUIET)
        assert events == []
    assert state.more is not None
    assert state.more.sets == ((2, mates.of[2]),)


def test_what_is_known_already_is_not_found_again(octo: Vehicle) -> None:
    sums = sums_of(octo, 0.5 * np.eye(8)[2])
    best = Weighing(8, TUNING).best(sums, NOBODY, 0.0, (2,))
    assert best is None or best.more != 2
    assert hypotheses.more(np.zeros((1, 8)), np.ones((1, 8)))[0].max() == 0.0
    plain = Weighing(8, TUNING).best(replace(sums, more=None, more_square=None), NOBODY, 0.0)
    assert plain is not None
    assert plain.more == -1
