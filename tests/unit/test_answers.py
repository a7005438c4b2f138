"""A motor that keeps its thrust whatever it is told is found by what the others do, and no other one is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.core.answers import Answers, AnswersState
from nff_companion.core.tuning import FitTuning
from nff_companion.core.vehicle import Vehicle

TUNING = FitTuning()
LOOK_S, LOOKS = 0.02, 50
FIRST = 7  # three accelerations, three rates, and one more before the thrusts


def looks(
    airframe: Vehicle,
    rng: np.random.Generator,
    answers: NDArray[np.float64],
    *,
    gain: NDArray[np.float64] | None = None,
    late_s: float = 0.0,
    lift: float = 2.0,
) -> NDArray[np.float64]:
    """A second (., 7 + m + 3) of a vehicle that is turned about all axes by its pseudo-inverse; each motor makes the
    share ``answers`` (m,) of its changes, what flies turns ``gain`` (3,) of what the file says, ``late_s`` later;
    ``lift``: changes of the upward acceleration, m/s^2."""
    whole = airframe.acceleration_effectiveness
    wanted = rng.normal(0.0, 1.0, (LOOKS, 4)) @ np.diag([lift, 2.0, 2.0, 1.0])
    thrust, rows = wanted @ np.linalg.pinv(whole).T, whole[1:]
    change = np.gradient(thrust, LOOK_S, axis=0)
    turned = (thrust - late_s * change) @ (rows * answers).T * (np.ones(3) if gain is None else gain)
    turned += rng.normal(0.0, 1.0, turned.shape) * [0.2, 0.2, 0.05]
    rates = rng.normal(0.0, 1.0, (LOOKS, 3))
    return np.hstack([turned, rates, rng.normal(size=(LOOKS, 1)), thrust, change @ rows.T])


def flown(
    airframe: Vehicle, rng: np.random.Generator, answers: NDArray[np.float64], seconds: int = 12, **off: Any
) -> AnswersState:
    monitor = Answers(airframe.acceleration_effectiveness, FIRST, TUNING)
    state = monitor.start()
    for _ in range(seconds):
        state = monitor.step(state, looks(airframe, rng, answers, **off), LOOK_S)
    return state


@pytest.mark.parametrize("name", ["octo-x", "octo-plus", "coax-x8", "hexa-x"])
def test_the_motor_that_does_not_answer_is_told(name: str, rng: np.random.Generator) -> None:
    airframe = vehicle.load(name)
    for motor in range(airframe.motors):
        answers = np.where(np.arange(airframe.motors) == motor, 0.0, 1.0)
        assert flown(airframe, rng, answers).told == motor


def test_two_that_turn_the_same_in_opposite_ways_are_not_told_apart(rng: np.random.Generator) -> None:
    """Of a hexarotor that neither climbs nor sinks, motors opposite each other."""
    airframe = vehicle.load("hexa-x")
    for motor in range(6):
        assert flown(airframe, rng, np.where(np.arange(6) == motor, 0.0, 1.0), lift=0.0).told == -1


@pytest.mark.parametrize("late_s", [0.0, 0.02])
def test_motors_that_answer_are_not_told_by_a_file_that_is_off(
    octo: Vehicle, late_s: float, rng: np.random.Generator
) -> None:
    for _ in range(10):
        gain, answers = rng.uniform(0.6, 1.6, 3), rng.uniform(0.85, 1.15, 8)
        assert flown(octo, rng, answers, gain=gain, late_s=late_s).told == -1


def test_half_a_motor_is_a_partial_loss_and_answers(octo: Vehicle, rng: np.random.Generator) -> None:
    for motor in range(8):
        assert flown(octo, rng, np.where(np.arange(8) == motor, 0.5, 1.0)).told == -1


def test_it_is_believed_after_some_judgements_and_until_it_answers_again(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    monitor, silent = Answers(octo.acceleration_effectiveness, FIRST, TUNING), np.where(np.arange(8) == 2, 0.0, 1.0)
    state, told = monitor.start(), list[int]()
    for second in range(60):
        state = monitor.step(state, looks(octo, rng, silent if second < 12 else np.ones(8)), LOOK_S)
        told.append(state.told)
    assert set(told[: TUNING.answers_alike - 1]) == {-1}
    assert told[11] == 2
    assert told[-1] == -1
    assert (np.diff(told) != 0).sum() == 2, "it comes once and goes once"


def test_a_vehicle_that_does_not_move_says_nothing(octo: Vehicle) -> None:
    monitor = Answers(octo.acceleration_effectiveness, FIRST, TUNING)
    state = monitor.step(monitor.start(), np.zeros((LOOKS, 18)), LOOK_S)
    assert (state.told, state.motor) == (-1, -1)
    lost, improvement = monitor.lost(replace(state, sums=state.sums))
    assert not lost.any()
    assert not improvement.any()
