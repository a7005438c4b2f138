"""A motor just declared is taken back where two others explain all that was seen; else it stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core.ambiguity import Among
from nff_companion.core.decision import Decision, DecisionState
from nff_companion.core.estimate import EstimatorState, Measurement
from nff_companion.core.estimator import Estimator
from nff_companion.core.evidence import Evidence
from nff_companion.core.onset import OnsetSums
from nff_companion.core.second_look import SecondLook
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis, Weighing

TUNING = Tuning().decision
DT_S = 0.005
NOBODY = np.zeros(8, bool)
BETWEEN = ((2, (0, 7)), (6, (4, 5)))  # of octo-x: a motor, and the two on both sides of it
DEVIATION = np.array([0.5, 1.5, 1.5, 0.2])


def sums_of(octo: Vehicle, loss: NDArray[np.float64], noise: NDArray[np.float64], seconds: float = 0.2) -> OnsetSums:
    """Of one window in which motors lose ``loss`` (8,); ``noise`` (4,) of the mean residual in deviations."""
    matrix = octo.acceleration_effectiveness * octo.hover
    weight = seconds / 0.012 / DEVIATION**2
    y = -matrix @ loss + noise * DEVIATION * np.sqrt(0.012 / seconds)
    weighted = matrix * weight[:, None]
    energy = float(weight @ y**2)
    return OnsetSums((weighted.T @ matrix)[None], (weighted.T @ y)[None], np.array([energy]), np.array([seconds]))


@pytest.mark.parametrize(("motor", "pair"), BETWEEN)
def test_what_two_others_explain_is_taken_back(
    octo: Vehicle, motor: int, pair: tuple[int, int], rng: np.random.Generator
) -> None:
    weighing = Weighing(8, TUNING)
    for _ in range(50):
        both = sums_of(octo, np.isin(np.arange(8), pair).astype(float), rng.normal(size=4))
        assert weighing.behind(both, NOBODY, motor, 1.0) > 0.0
        for one in pair:  # each of the two is believed: with the other one
            assert weighing.behind(both, NOBODY, one, 1.0) < 0.0


@pytest.mark.parametrize("motor", range(8))
def test_a_motor_that_is_lost_stays_declared(octo: Vehicle, motor: int, rng: np.random.Generator) -> None:
    weighing = Weighing(8, TUNING)
    for _ in range(50):
        alone = sums_of(octo, np.eye(8)[motor], rng.normal(size=4), float(rng.uniform(0.05, 0.2)))
        assert weighing.behind(alone, NOBODY, motor, 1.0) < 0.0


def test_the_residual_is_that_of_a_vehicle_whose_motor_may_work(octo: Vehicle, rng: np.random.Generator) -> None:
    matrix, w, motor = octo.acceleration_effectiveness, rng.uniform(0.2, 0.8, 8), int(rng.integers(8))
    whole = rng.normal(size=4)  # measured - B0 w
    without = whole + matrix[:, motor] * w[motor]  # with the motor declared it is expected to give nothing
    onset = Estimator(octo, DT_S).start(0.0, np.zeros(3), np.zeros(3), w).onset
    look = SecondLook(onset=onset, failed=NOBODY, motor=motor, until_s=0.0)
    assert np.allclose(look.residual(without, matrix, w), whole)


def flying(octo: Vehicle) -> tuple[Estimator, EstimatorState]:
    """In hover, a second look at motor 3 under way, and a set standing."""
    estimator = Estimator(octo, DT_S)
    command = np.full(8, octo.hover)
    state = estimator.start(0.0, np.zeros(3), np.array([0.0, 0.0, -9.81]), command)
    declared = replace(
        state.decision, failed=np.isin(np.arange(8), (2, 5)), among=Among(((0, 1), (6, 7)), 0.0, 0.0, told=True)
    )
    look = SecondLook(state.onset, np.isin(np.arange(8), (5,)), 2, 1.0)
    return estimator, replace(state, decision=declared, second_look=look, evidence=Evidence.none(4, 8, 0.0))


def measured(octo: Vehicle, failed: tuple[int, ...], stopped: tuple[int, ...] = ()) -> Measurement:
    return Measurement(
        time_s=DT_S,
        dt_s=DT_S,
        gyro=np.zeros(3),
        specific_force=np.array([0.0, 0.0, -9.81]),
        command=np.full(8, octo.hover),
        failed=np.isin(np.arange(8), failed),
        stopped=np.isin(np.arange(8), stopped),
    )


def test_what_is_declared_goes_on_being_looked_at(octo: Vehicle) -> None:
    estimator, state = flying(octo)
    state, _ = estimator.step(state, measured(octo, (2, 5)))
    assert state.second_look is not None
    assert state.decision.among is not None


@pytest.mark.parametrize("failed", [(2,), (5,), (2, 4, 5)])
def test_an_order_ends_what_was_being_told_apart_or_looked_at(octo: Vehicle, failed: tuple[int, ...]) -> None:
    """Else a motor that the operator lifted would be declared again without a word."""
    estimator, state = flying(octo)
    state, estimate = estimator.step(state, measured(octo, failed))
    assert (state.second_look, state.evidence, state.decision.among) == (None, None, None)
    assert np.flatnonzero(estimate.failed).tolist() == list(failed)


def test_a_motor_that_stands_still_by_its_speed_is_not_taken_back(octo: Vehicle) -> None:
    estimator, state = flying(octo)
    state, _ = estimator.step(state, measured(octo, (2, 5), stopped=(2,)))
    assert state.second_look is None
    assert state.decision.failed[2]


def declared_at(state: DecisionState, best: Hypothesis, *, direct: bool = False) -> tuple[list[int], DecisionState]:
    """Motors declared within 0.1 s of 10 s."""
    whole = (np.ones(8), np.full(8, 0.05), np.full(8, 0.5))
    for k in range(20):
        state, events = Decision(8, 4, TUNING).step(state, 10.0 + DT_S * k, best, *whole, best if direct else None)
        if events:
            return [event.motor for event in events], state
    return [], state


@pytest.mark.parametrize(("until_s", "declared"), [(10.0, [3]), (14.0, [])])
def test_a_motor_that_was_taken_back_is_not_named_alone_again_at_once(until_s: float, declared: list[int]) -> None:
    """In forward flight one whose neighbour had lost a part was named and taken back four times in a second."""
    doubted = replace(DecisionState.start(8), doubted_until_s={2: until_s})
    alone = Hypothesis((2,), (0.95,), 100.0, 50.0, 0.95, 0.08)
    found, after = declared_at(doubted, alone)
    assert found == declared
    assert after.doubted_until_s == {2: until_s}
    assert declared_at(doubted, replace(alone, motors=(2, 4), loss=(0.95, 0.95)))[0] == [3, 5]
    assert declared_at(doubted, alone, direct=True)[0] == [3]
    whole = (np.ones(8), np.full(8, 0.05), np.full(8, 0.5))
    kept, _ = Decision(8, 4, TUNING).step(replace(doubted, candidate=(2,)), 11.0, None, *whole)
    assert kept.doubted_until_s == {2: until_s}
