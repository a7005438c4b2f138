"""What is allocated around of a motor that has lost a part comes and goes seldom, and is of one motor."""

from __future__ import annotations

import numpy as np
import pytest
from estimates import hovering
from numpy.typing import NDArray

from nff_companion.allocation.partial import Partial, PartialState
from nff_companion.core import vehicle
from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import PlannerTuning

TUNING = PlannerTuning()
DT_S = 0.01
WHOLE = np.ones(8)


def estimate_of(effectiveness: NDArray[np.float64], failed: tuple[int, ...] = (), deviation: float = 0.05) -> Estimate:
    return hovering(vehicle.load("octo-x"), effectiveness, failed=failed, deviation=np.full(8, deviation))


def less(motor: int, left: float) -> NDArray[np.float64]:
    return np.where(np.arange(8) == motor, left, 1.0)


class Course:
    """Steps, and when what is held of each motor came or went."""

    def __init__(self) -> None:
        self.state, self.time_s = PartialState.start(8), 0.0
        self.changes: list[tuple[float, int]] = []

    def fly(self, seconds: float, estimate: Estimate, *, trusted: bool = True) -> None:
        for _ in range(round(seconds / DT_S)):
            self.time_s += DT_S
            before = self.state.held < 1.0
            self.state = Partial(TUNING).step(self.state, self.time_s, estimate, trusted=trusted)
            self.changes += [(self.time_s, int(i)) for i in np.flatnonzero((self.state.held < 1.0) != before)]


def test_a_lasting_loss_is_held_and_followed_and_ends_with_it() -> None:
    course = Course()
    course.fly(0.15, estimate_of(less(2, 0.6)))
    assert not course.state.any
    course.fly(0.2, estimate_of(less(2, 0.6)))
    assert course.state.held.tolist() == less(2, 0.6).tolist()
    course.fly(0.1, estimate_of(less(2, 0.5)))
    assert course.state.held[2] == 0.5
    course.fly(6.0, estimate_of(WHOLE))
    assert not course.state.any
    assert [motor for _, motor in course.changes] == [2, 2]


def test_whatever_a_motor_does_it_changes_once_in_its_time(rng: np.random.Generator) -> None:
    course = Course()
    for _ in range(200):
        motor, left = int(rng.integers(3)), float(rng.uniform(0.3, 0.7))
        effectiveness = less(motor, left) if rng.random() < 0.6 else WHOLE
        if rng.random() < 0.2:
            effectiveness = effectiveness * less(int(rng.integers(8)), 0.5)
        course.fly(float(rng.uniform(0.05, 1.0)), estimate_of(effectiveness))
        assert int((course.state.held < 1.0).sum()) <= 1
    assert len(course.changes) > 6
    for motor in range(8):
        times = [time_s for time_s, changed in course.changes if changed == motor]
        assert all(np.diff(times) >= TUNING.partial_hold_s - 1e-6), (motor, times)


def test_a_motor_that_is_declared_is_held_no_longer() -> None:
    course = Course()
    course.fly(1.0, estimate_of(less(2, 0.5)))
    course.fly(DT_S, estimate_of(less(2, 0.0), failed=(2,)))
    assert not course.state.any


@pytest.mark.parametrize(
    ("effectiveness", "deviation", "trusted"),
    [(less(2, 0.6), 0.05, False), (less(2, 0.6), 0.5, True), (less(2, 0.6) * less(5, 0.6), 0.05, True)],
)
def test_what_is_doubtful_begins_nothing_and_ends_nothing(
    effectiveness: NDArray[np.float64], deviation: float, trusted: bool
) -> None:
    doubtful = estimate_of(effectiveness, deviation=deviation)
    course = Course()
    course.fly(2.0, doubtful, trusted=trusted)
    assert not course.state.any
    course.fly(1.0, estimate_of(less(2, 0.5)))
    course.fly(10.0, doubtful, trusted=trusted)
    assert course.state.held[2] < 1.0


def test_what_is_held_stays_over_a_gap_for_its_time() -> None:
    course = Course()
    course.fly(1.0, estimate_of(less(2, 0.5)))
    course.state = course.state.interrupted()
    course.time_s = 1000.0  # another clock
    course.fly(TUNING.partial_hold_s - 0.1, estimate_of(WHOLE))
    assert course.state.held[2] == 0.5
    course.fly(0.2, estimate_of(WHOLE))
    assert not course.state.any


def test_of_one_of_two_above_each_other_nothing_is_held() -> None:
    course = Course()
    course.fly(1.0, estimate_of(less(2, 0.5)))
    either = hovering(vehicle.load("coax-x8"), np.where(np.isin(np.arange(8), (2, 7)), 0.5, 1.0), either=(2, 7))
    course.fly(0.1, either)
    assert not course.state.any


def test_what_no_matrix_would_be_made_for_is_not_held_and_stands_in_nobodys_way() -> None:
    course = Course()
    course.fly(1.0, estimate_of(less(2, 0.74)))
    assert not course.state.any
    course.fly(0.3, estimate_of(less(5, 0.4)))
    assert course.state.held[5] == 0.4


def test_a_loss_before_a_pause_is_not_a_lasting_one() -> None:
    course = Course()
    course.fly(0.1, estimate_of(less(2, 0.5)))
    course.time_s += 3.0  # a set stood, and nothing was looked at
    course.fly(0.1, estimate_of(less(2, 0.5)))
    assert not course.state.any
    course.fly(0.2, estimate_of(less(2, 0.5)))
    assert course.state.any
