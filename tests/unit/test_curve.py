"""What flight on fewer motors shows of the thrust curve."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.core.curve import Curve, CurveState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle

TUNING = Tuning()
CORRELATION_S = TUNING.disturbance.correlation_s
VARIANCE = np.array([0.1, 1.0, 1.0, 0.05])


def flown(octo: Vehicle, thrust: np.ndarray, bend: float, seconds: float, rng: np.random.Generator) -> CurveState:
    """With a true ``bend``, at thrusts (m,) of motors, 0: declared."""
    curve, matrix = Curve(TUNING.curve, CORRELATION_S), octo.acceleration_effectiveness
    state = curve.start(0.0)
    for k in range(1, round(seconds / 0.005)):
        w = np.where(thrust > 0.0, thrust + 0.01 * rng.standard_normal(octo.motors), 0.0)
        share = curve.shown(matrix, w)
        residual = (bend - state.bend) * share + np.sqrt(VARIANCE) * rng.standard_normal(4)
        state = curve.learn(state, 0.005 * k, residual, share, VARIANCE)
    return state


def uneven(octo: Vehicle) -> np.ndarray:
    """Motor 3 lost, 5 across it low, its neighbours high."""
    thrust = np.full(octo.motors, octo.hover)
    thrust[[2, 4, 6, 7]] = 0.0, 0.15, 0.7, 0.65
    return thrust


@pytest.mark.parametrize("bend", [-0.4, 0.5])
def test_a_bent_curve_is_learnt_where_motors_work_unevenly(
    octo: Vehicle, bend: float, rng: np.random.Generator
) -> None:
    state = flown(octo, uneven(octo), bend, 9.0, rng)
    assert state.bend == pytest.approx(bend, abs=5.0 * state.variance**0.5)
    assert state.bend == pytest.approx(bend, abs=0.15)


def test_what_hover_is_does_not_hang_on_the_bend(octo: Vehicle) -> None:
    matrix = octo.acceleration_effectiveness
    assert np.abs(Curve.shown(matrix, np.full(octo.motors, octo.hover))).max() < 1e-9
    assert np.abs(Curve.shown(matrix, uneven(octo))).max() > 0.5
    assert np.isfinite(Curve.shown(matrix, np.zeros(octo.motors))).all()


def test_it_is_learnt_no_quicker_than_a_second_motor_is_named_and_within_limits(octo: Vehicle) -> None:
    curve, matrix = Curve(TUNING.curve, CORRELATION_S), octo.acceleration_effectiveness
    share = curve.shown(matrix, uneven(octo))
    state, time_s = curve.start(0.0), 0.0
    while time_s < 0.08:
        time_s += CORRELATION_S
        state = curve.learn(state, time_s, share * (2.0 - state.bend), share, VARIANCE)
    assert state.bend < 0.5
    while time_s < 20.0:
        time_s += CORRELATION_S
        state = curve.learn(state, time_s, share * (2.0 - state.bend), share, VARIANCE)
    assert state.bend == pytest.approx(TUNING.curve.deviations_max * TUNING.curve.bend_deviation)


def test_samples_that_follow_too_soon_say_nothing(octo: Vehicle) -> None:
    curve = Curve(TUNING.curve, CORRELATION_S)
    state = curve.start(1.0)
    assert curve.learn(state, 1.0 + 0.5 * CORRELATION_S, VARIANCE, VARIANCE, VARIANCE) is state
