"""What turns the vehicle and takes no lift away is a load, not a motor."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.core.slid_load import SlidLoad, SlidLoadState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import THRUST, Vehicle

TUNING = Tuning()
WHOLE = np.zeros(8, bool)
DEVIATION = np.array([0.37, 1.07, 1.07, 0.1])
WEIGHT = 1.0 / (DEVIATION**2 * TUNING.disturbance.correlation_s)


def watch() -> SlidLoad:
    return SlidLoad(8, TUNING.slid_load, TUNING.estimator.clear_loss, TUNING.decision.loss_sudden)


def seen(
    octo: Vehicle, loss: float, lift_share: float, seconds: float, rng: np.random.Generator | None = None
) -> SlidLoadState | None:
    """Motor 5 seems to have lost ``loss``; the lift lacks ``lift_share`` of what that takes away."""
    lost = octo.acceleration_effectiveness * octo.hover
    effectiveness = 1.0 - loss * np.eye(8)[4]
    state = watch().looked(None, 0.0, effectiveness, WHOLE)
    noise = 0.0
    for k in range(1, round(seconds / 0.005)):
        if rng is not None:  # correlated over a tenth of a second, as the residual is
            noise += 0.05 * (-noise) + np.sqrt(0.1) * 0.37 * rng.standard_normal()
        residual = -lost[:, 4] * loss
        residual[THRUST] = lift_share * residual[THRUST] + noise
        assert state is not None
        state = watch().grown(state, lost, residual, WEIGHT, 0.005)
        state = watch().looked(state, 0.005 * k, effectiveness, WHOLE)
    return state


@pytest.mark.parametrize("loss", [0.2, 0.3, 0.5])
def test_what_takes_no_lift_away_is_a_load(octo: Vehicle, loss: float) -> None:
    state = seen(octo, loss, 0.0, 2.5)
    assert state is not None
    assert state.slid


@pytest.mark.parametrize("loss", [0.2, 0.3, 0.5])
@pytest.mark.parametrize("share", [0.5, 1.0, 1.4])
def test_what_takes_lift_away_is_a_motor(octo: Vehicle, loss: float, share: float) -> None:
    state = seen(octo, loss, share, 2.5)
    assert state is not None
    assert not state.slid


def test_in_rough_air_a_motor_is_seldom_a_load(octo: Vehicle, rng: np.random.Generator) -> None:
    """One in 18, of 300 draws."""
    found = [seen(octo, 0.3, 1.0, 1.5, rng) for _ in range(40)]
    assert sum(state is not None and state.slid for state in found) <= 12


def test_a_large_loss_is_no_load(octo: Vehicle) -> None:
    state = seen(octo, 0.7, 0.0, 2.5)
    assert state is not None
    assert not state.slid


def test_without_a_loss_nothing_is_looked_at_and_the_next_one_is_seen_anew(octo: Vehicle) -> None:
    load, whole = watch(), np.ones(8)
    assert load.looked(None, 0.0, whole, WHOLE) is None
    state = seen(octo, 0.3, 0.0, 2.5)
    assert state is not None
    held = load.looked(state, state.seen_s + 0.05, whole, WHOLE)
    assert held is not None
    assert load.grown(held, np.ones((4, 8)), np.ones(4), WEIGHT, 0.005) is held, "what comes now is not of the loss"
    assert load.looked(held, state.seen_s + 0.2, whole, WHOLE) is None


def test_what_declared_motors_give_is_no_loss(octo: Vehicle) -> None:
    effectiveness = 1.0 - np.eye(8)[2]
    assert watch().looked(None, 0.0, effectiveness, np.eye(8, dtype=bool)[2]) is None


def test_a_larger_loss_is_another_one(octo: Vehicle) -> None:
    """Else what the lift did not show of a small one would be held against it."""
    load, lost = watch(), octo.acceleration_effectiveness * octo.hover
    state = seen(octo, 0.15, 0.0, 4.0)
    assert state is not None
    assert state.slid
    for k in range(1, 200):
        state = load.grown(state, lost, -lost[:, 4] * 0.5, WEIGHT, 0.005)
        state = load.looked(state, 4.0 + 0.005 * k, 1.0 - 0.5 * np.eye(8)[4], WHOLE)
        assert state is not None
        assert not state.slid
