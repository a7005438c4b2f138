"""What steady flight shows of lift and centre of mass."""

from __future__ import annotations

import tomllib

import msgspec
import numpy as np
import pytest

from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.balance import Balance, of_vehicle
from nff_companion.core.decision import Decision, DecisionState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import GRAVITY_M_S2, PITCH, ROLL, THRUST, Vehicle, path_of
from nff_companion.core.weighing import Hypothesis

TUNING = Tuning()
CORRELATION_S = TUNING.disturbance.correlation_s
VARIANCE = np.array([0.1, 1.0, 1.0, 0.05])


def learnt(octo: Vehicle, true: np.ndarray, rng: np.random.Generator, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Share (n,) and deviation (n,) after a flight in which B has ``true`` times the thrust row beside it."""
    balance = Balance(octo, TUNING.balance, CORRELATION_S)
    state = balance.start(0.0)
    for k in range(1, round(seconds / 0.005)):
        thrust = octo.hover * (1.0 + 0.1 * rng.standard_normal(octo.motors))
        whole = (octo.acceleration_effectiveness + true[:, None] * octo.acceleration_effectiveness[THRUST]) @ thrust
        residual = whole + np.sqrt(VARIANCE) * rng.standard_normal(4) - state.matrix @ thrust
        if balance.due(state, 0.005 * k):
            state = balance.learn(state, 0.005 * k, residual, balance.lift_m_s2(thrust), VARIANCE)
    return state.share, np.sqrt(state.variance)


def test_a_centre_of_mass_beside_the_middle_is_learnt_within_its_deviation(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    beside_m = np.array([0.02, -0.015])
    inertia = octo.inertia_kg_m2
    true = np.array([0.1, octo.mass_kg * beside_m[0] / inertia[0], octo.mass_kg * beside_m[1] / inertia[1], 0.0])
    share, deviation = learnt(octo, true, rng, 10.0)
    assert (np.abs(share - true) < 5.0 * deviation).all()
    assert (deviation[[THRUST, ROLL, PITCH]] * GRAVITY_M_S2 < 0.1 * np.sqrt(VARIANCE)[[THRUST, ROLL, PITCH]]).all()
    assert np.abs(share - true)[ROLL] < 0.1 * abs(true[ROLL])


def test_shares_are_told_as_lift_and_centre_of_mass(octo: Vehicle) -> None:
    """A vehicle with its centre of mass 2 cm forward and 1 cm to the right, and a tenth more of everything."""
    text = path_of("octo-x").read_text(encoding="utf-8")
    moved_text = text.replace("mass_kg = 6.0", "mass_kg = 6.0\ncentre_of_mass_m = [0.02, 0.01, 0.0]")
    moved = Vehicle(msgspec.convert(tomllib.loads(moved_text), AirframeFile))
    lift = octo.acceleration_effectiveness[THRUST]
    difference = 1.1 * moved.acceleration_effectiveness - octo.acceleration_effectiveness
    share = (difference @ lift) / (lift @ lift)
    told, (forward_m, right_m) = of_vehicle(share, octo)
    assert told == pytest.approx(1.1)
    assert (forward_m, right_m) == pytest.approx((0.02, 0.01), rel=1e-6)


def test_what_is_learnt_has_a_limit_and_a_motor_lost_is_beyond_it(octo: Vehicle, rng: np.random.Generator) -> None:
    """Two motors less on one side would be a centre of mass outside of what any file has wrong."""
    lost = octo.acceleration_effectiveness[:, [2, 7]].sum(axis=1) * octo.hover / GRAVITY_M_S2
    share, _ = learnt(octo, -lost, rng, 2.0)
    assert np.abs(share[ROLL]) < 0.8 * np.abs(lost[ROLL])


def test_slow_changes_alone_are_followed_later(octo: Vehicle, rng: np.random.Generator) -> None:
    """A motor that fails within seconds is not learnt as a centre of mass that moves."""
    balance = Balance(octo, TUNING.balance, CORRELATION_S)
    state = balance.start(0.0)
    for k in range(1, 400):
        state = balance.learn(state, CORRELATION_S * k, np.zeros(4), GRAVITY_M_S2, VARIANCE)
    begun_s = state.learnt_s
    lost = octo.acceleration_effectiveness[:, 2] * octo.hover
    while state.learnt_s < begun_s + 1.0:
        residual = lost - state.share * GRAVITY_M_S2
        state = balance.learn(state, state.learnt_s + CORRELATION_S, residual, GRAVITY_M_S2, VARIANCE)
    assert np.abs(state.share[ROLL] * GRAVITY_M_S2) < 0.15 * np.abs(lost[ROLL])


@pytest.mark.parametrize(("turned", "named"), [(0.4, True), (0.05, False)])
def test_a_motor_that_hardly_turns_is_not_named(octo: Vehicle, turned: float, named: bool) -> None:
    """What it could lose is within what the others may be wrong by."""
    decision, best = Decision(8, 4, TUNING.decision), Hypothesis((6,), (0.8,), 40.0, 20.0, 0.9, 0.09)
    state, events = DecisionState.start(8), []
    shown = np.full(8, 0.4)
    shown[6] = turned
    for k in range(20):
        state, new = decision.step(state, 0.005 * k, best, np.ones(8), np.ones(8), np.full(8, 0.4), turned=shown)
        events += new
    assert {event.motor for event in events} == ({7} if named else set())


def test_gains_are_followed_slowly_and_hold_the_centre_of_mass(octo: Vehicle) -> None:
    balance = Balance(octo, TUNING.balance, CORRELATION_S)
    state = balance.start(0.0)
    thrust = np.linspace(0.3, 0.5, octo.motors)
    assert not np.any(balance.turned(state, thrust))
    gains = np.array([1.0, 1.0, 0.95, 0.7])
    for k in range(1, round(1.0 / CORRELATION_S) + 1):
        state = balance.learn(state, CORRELATION_S * k, np.zeros(4), GRAVITY_M_S2, VARIANCE, gains)
    assert state.gain is not None
    assert state.gain[3] == pytest.approx(1.0 - TUNING.balance.gain_per_s, abs=0.02)
    for k in range(round(1.0 / CORRELATION_S) + 1, round(5.0 / CORRELATION_S)):
        state = balance.learn(state, CORRELATION_S * k, np.zeros(4), GRAVITY_M_S2, VARIANCE, gains)
    assert state.gain is not None
    np.testing.assert_allclose(state.gain, gains)
    np.testing.assert_allclose(state.matrix, gains[:, None] * octo.acceleration_effectiveness, atol=1e-12)
    np.testing.assert_allclose(
        balance.turned(state, thrust), (gains - 1.0) * (octo.acceleration_effectiveness @ thrust), atol=1e-12
    )
    kept = balance.learn(state, state.learnt_s + 1.0, np.zeros(4), GRAVITY_M_S2, VARIANCE)
    assert kept.gain is not None
    np.testing.assert_allclose(kept.gain, gains)
