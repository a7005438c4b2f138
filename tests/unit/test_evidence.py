"""Which of a set of losses it is, by how the residual moves: not by its size, of which the model may be off."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core.decision import Decision
from nff_companion.core.evidence import Evidence, Sums
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis

TUNING = Tuning().decision
SETS = ((0, 1), (6, 7), (2, 5))
DEVIATION = np.array([0.4, 1.1, 1.1, 0.1])
DT_S, BLOCK_S = 0.005, TUNING.among_block_s
WEIGHT = DT_S / (0.012 * DEVIATION**2)


def flown(
    octo: Vehicle,
    rng: np.random.Generator,
    loss: NDArray[np.float64],
    *,
    seconds: float = 0.96,
    moved: float = 0.08,
    off: NDArray[np.float64] | None = None,
) -> Evidence:
    """Motors that move each in its own way, by ``moved`` of their full thrust, while they lose ``loss`` (m,) and the
    residual is ``off`` (n,) besides."""
    evidence, matrix = Evidence.none(octo.axes, octo.motors, 0.0), octo.acceleration_effectiveness
    phase, turns = rng.uniform(0.0, 2.0 * np.pi, octo.motors), rng.uniform(2.0, 5.0, octo.motors)
    for k in range(round(seconds / DT_S)):
        w = octo.hover + moved * np.sin(2.0 * np.pi * turns * DT_S * k + phase)
        y = -matrix @ (loss * w) + rng.normal(0.0, 1.5 * DEVIATION) + (0.0 if off is None else off)
        evidence = evidence.grown(DT_S * k, matrix * w, y, WEIGHT, BLOCK_S)
    return evidence


def lost(*motors: int) -> NDArray[np.float64]:
    return np.isin(np.arange(8), motors).astype(float)


@pytest.mark.parametrize("motors", SETS)
def test_the_motors_that_are_lost_are_told_by_what_moves(
    octo: Vehicle, motors: tuple[int, int], rng: np.random.Generator
) -> None:
    for _ in range(5):
        best, loss, ahead, _ = flown(octo, rng, lost(*motors)).told(SETS, 0.0)
        assert best == motors
        assert ahead > TUNING.moved_margin_min
        assert min(loss) > 0.8


def test_what_is_off_all_the_time_is_no_evidence(octo: Vehicle, rng: np.random.Generator) -> None:
    """By the model's error the residual is that of the other pair."""
    matrix = octo.acceleration_effectiveness * octo.hover
    misleading = matrix @ (lost(0, 1) - lost(6, 7))
    best, _, ahead, _ = flown(octo, rng, lost(0, 1), off=misleading).told(SETS, 0.0)
    assert best == (0, 1) or ahead < TUNING.moved_margin_min


def test_without_movement_there_is_no_evidence(octo: Vehicle, rng: np.random.Generator) -> None:
    for _ in range(5):
        _, _, ahead, _ = flown(octo, rng, lost(0, 1), moved=0.0).told(SETS, 0.0)
        assert abs(ahead) < 1.0


def test_motors_that_work_are_not_named_whatever_the_residual_is(octo: Vehicle, rng: np.random.Generator) -> None:
    """It is the air that pushes, and nothing answers when the motors move."""
    pushed = -(octo.acceleration_effectiveness * octo.hover) @ lost(0, 1)
    for _ in range(5):
        evidence = flown(octo, rng, np.zeros(8), off=pushed, seconds=2.4)
        assert evidence.told(SETS, 0.0).ahead < 1.0
        assert evidence.told(SETS[:2], 0.0).improvement < -TUNING.among_refuted_min


@pytest.mark.parametrize("motors", [*SETS, (3, 4)])
def test_what_is_lost_is_not_refuted(octo: Vehicle, motors: tuple[int, int], rng: np.random.Generator) -> None:
    """Nor by half as much movement, nor while the file has wrong what the motors give."""
    gains = 1.0 + rng.uniform(-0.2, 0.2, 8)
    for moved in (0.04, 0.08):
        found = flown(octo, rng, lost(*motors) * gains, moved=moved).told((*SETS, (3, 4)), 0.0)
        assert found.improvement > -0.25 * TUNING.among_refuted_min


def test_changes_are_what_is_left_when_the_mean_is_taken_off(octo: Vehicle, rng: np.random.Generator) -> None:
    sums, n, m = Sums.none(octo.axes, octo.motors), octo.axes, octo.motors
    lost_s, y_s = rng.normal(size=(40, n, m)), rng.normal(size=(40, n))
    for x, y in zip(lost_s, y_s, strict=True):
        sums = sums.grown(x, y, WEIGHT)
    matrix, vector = sums.changes()
    x, y = lost_s - lost_s.mean(axis=0), y_s - y_s.mean(axis=0)
    assert np.allclose(matrix, np.einsum("kai,a,kaj->ij", x, WEIGHT, x))
    assert np.allclose(vector, np.einsum("kai,a,ka->i", x, WEIGHT, y))
    none = Sums.none(n, m).changes()
    assert not none[0].any()
    assert not none[1].any()


@pytest.mark.parametrize(("moved", "convincing"), [(True, True), (False, False)])
def test_what_moved_needs_no_lead_that_grows_with_the_residual(moved: bool, convincing: bool) -> None:
    found = Hypothesis((0, 1), (0.95, 0.95), 1000.0, TUNING.moved_margin_min + 1.0, 0.95, 0.2, moved=moved)
    assert Decision(8, 4, TUNING).convincing(found) == convincing
    less = Hypothesis((0, 1), (0.95, 0.95), 1000.0, TUNING.moved_margin_min - 1.0, 0.95, 0.2, moved=moved)
    assert not Decision(8, 4, TUNING).convincing(less)


def test_what_was_seen_before_a_loss_does_not_speak_of_it(octo: Vehicle, rng: np.random.Generator) -> None:
    before = flown(octo, rng, np.zeros(8), seconds=3.0)
    pushed = np.array([-2.5, 7.0, 0.0, 0.0])
    suspected = flown(octo, rng, np.zeros(8), seconds=3.0, off=pushed)
    matrix = octo.acceleration_effectiveness * octo.hover
    for motors in ((0, 1), (2, 5), (3, 4)):
        loss = -matrix @ lost(*motors)
        assert before.over(loss, DEVIATION**2, 3.0)
        assert suspected.over(pushed + loss, DEVIATION**2, 3.0)
    assert not before.over(rng.normal(0.0, 0.5 * DEVIATION), DEVIATION**2, 3.0)
    assert not suspected.over(1.3 * pushed, DEVIATION**2, 3.0), "motors that move make as much of it"
    assert not Evidence.none(4, 8, 0.0).over(pushed, DEVIATION**2, 3.0)
