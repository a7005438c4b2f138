"""A flight confirms the airframe file or contradicts it: on motions made of a mixer's torques."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from itertools import combinations

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from other_airframes import altered, swapped

from nff_companion.core import vehicle
from nff_companion.core.fit import Factor, Fit, FitVerdict, Seen, judged
from nff_companion.core.fit_monitor import FitMonitor, FitState
from nff_companion.core.motor_order import orders
from nff_companion.core.residual import ResidualFilter, ResidualState
from nff_companion.core.tuning import FitTuning
from nff_companion.core.vehicle import Vehicle

DT_S = 0.005
SECONDS = 12.0
AIRFRAMES = ("octo-x", "hexa-x", "coax-x8")


def shown(
    model: Vehicle, rng: np.random.Generator, *, yaw: float = 1.0, seconds: float = SECONDS
) -> list[ResidualState]:
    """What the residual's chain shows of ``model`` whose mixer is asked for torques that wander, and a little noise."""
    b = model.acceleration_effectiveness
    mixer = np.linalg.pinv(b)
    start = ResidualFilter(model, DT_S).start(np.zeros(3), np.array([0.0, 0.0, -9.8]), np.full(model.motors, 0.4))
    demand, rate, out = np.zeros(4), np.zeros(3), []
    for _ in range(int(seconds / DT_S)):
        wanted = rng.normal(size=4) * [1.0, 40.0, 40.0, 12.0 * yaw]
        demand = demand + 0.08 * (wanted - demand)
        w = mixer @ (demand + np.array([9.8, 0.0, 0.0, 0.0]))
        acceleration = b[1:] @ w - 0.5 * rate
        rate = 0.98 * (rate + DT_S * acceleration)
        measured = np.concatenate([[b[0] @ w], acceleration + 0.05 * rng.normal(size=3)])
        smoothed = np.concatenate([measured, np.zeros(2), rate, np.zeros(2)])
        out.append(replace(start, smoothed=smoothed, thrust_shown=w))
    return out


def watched(model: Vehicle, flight: list[ResidualState], state: FitState | None = None) -> FitState:
    monitor = FitMonitor(model, DT_S, FitTuning())
    state = state or monitor.start()
    for sample in flight:
        state = monitor.step(state, sample)
    return state


def heavier(model: Vehicle, factor: float) -> Vehicle:
    other = altered(model)
    other.mass_kg = model.mass_kg * factor
    return other


def stiffer(model: Vehicle, factor: NDArray[np.float64]) -> Vehicle:
    other = altered(model)
    other.inertia_kg_m2 = model.inertia_kg_m2 * factor
    return other


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_right_file_fits(name: str, rng: np.random.Generator) -> None:
    model = vehicle.load(name)
    fit = watched(model, shown(model, rng)).fit
    assert fit.verdict == FitVerdict.FITS, fit.text
    assert fit.seen.thrust is not None
    assert fit.seen.thrust.middle == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_every_two_motors_that_are_swapped_are_named(name: str, rng: np.random.Generator) -> None:
    model = vehicle.load(name)
    flight = shown(model, rng)
    for one, other in combinations(range(model.motors), 2):
        fit = watched(swapped(model, one, other), flight).fit
        assert fit.verdict == FitVerdict.DOES_NOT_FIT, (one, other, fit.text)
        assert fit.short in (f"motors {one + 1}, {other + 1} swapped", "motors in another order")


@pytest.mark.parametrize("name", AIRFRAMES)
def test_spins_that_are_reversed_are_named(name: str, rng: np.random.Generator) -> None:
    model = vehicle.load(name)
    flight = shown(model, rng)
    assert watched(altered(model, spin=-model.spin), flight).fit.short == "all spins reversed"
    for motor in range(model.motors):
        spin = model.spin.copy()
        spin[motor] *= -1.0
        fit = watched(altered(model, spin=spin), flight).fit
        assert fit.verdict == FitVerdict.DOES_NOT_FIT, fit.text
        assert fit.short in (f"motor {motor + 1} spin reversed", "motors in another order")


def test_a_frame_turned_by_half_a_motor_is_found(rng: np.random.Generator) -> None:
    fit = watched(vehicle.load("octo-x"), shown(vehicle.load("octo-plus"), rng)).fit
    assert fit.verdict == FitVerdict.DOES_NOT_FIT
    assert "nose" in fit.short


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_half_or_twice_the_mass_does_not_fit_and_the_factor_is_said(factor: float, rng: np.random.Generator) -> None:
    model = vehicle.load("octo-x")
    fit = watched(heavier(model, factor), shown(model, rng)).fit
    assert fit.verdict == FitVerdict.DOES_NOT_FIT
    assert fit.short == f"thrust is {factor:.2f} times its"


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_third_off_is_said_and_does_not_contradict(factor: float, rng: np.random.Generator) -> None:
    model = vehicle.load("octo-x")
    flight = shown(model, rng)
    fit = watched(heavier(model, factor), flight).fit
    assert fit.verdict != FitVerdict.DOES_NOT_FIT
    assert any(short.startswith("thrust is") for short, _ in fit.differs)
    fit = watched(stiffer(model, np.array([factor, 1.0, 1.0])), flight).fit
    assert fit.verdict != FitVerdict.DOES_NOT_FIT
    assert [short.split()[0] for short, _ in fit.differs] == ["roll"]
    assert fit.seen.turns[0] is not None
    assert fit.seen.turns[0].middle == pytest.approx(factor, rel=0.08)


def test_gains_of_the_rows_are_what_turns_over_the_file_between_file_and_flight(rng: np.random.Generator) -> None:
    model, tuning = vehicle.load("octo-x"), FitTuning()
    flight = shown(model, rng)
    state = watched(stiffer(model, np.array([0.8, 1.0, 1.5])), flight)
    assert state.gains is not None
    thrust, roll, pitch, yaw = state.gains.tolist()
    assert thrust == 1.0  # what lifts is learnt elsewhere (core/balance.py)
    assert 0.8 < roll < 0.9, "nearer to the file's than what was seen: files are right to 15 %"
    assert pitch == pytest.approx(1.0, abs=0.05)
    assert yaw == pytest.approx(1.0, abs=0.05), "in fast flight the rotors' side drag looks like it"
    far = watched(stiffer(model, np.array([4.0, 1.0, 1.0])), flight).gains
    assert far is not None
    assert far[1] == pytest.approx(math.exp(tuning.gain_deviations_max * tuning.gain_deviation), rel=0.02)
    lifted = watched(heavier(model, 1.2), flight).gains
    assert lifted is not None
    np.testing.assert_allclose(lifted[1:], [1.0, 1.0, 1.2], atol=0.12)
    assert watched(model, shown(model, rng, seconds=2.0)).gains is None, "nothing is known so soon"


def test_without_a_turn_about_yaw_nothing_is_known_of_the_spins(rng: np.random.Generator) -> None:
    model = vehicle.load("coax-x8")
    for seen_by in (model, altered(model, spin=-model.spin)):
        fit = watched(seen_by, shown(model, rng, yaw=0.0)).fit
        assert fit.verdict == FitVerdict.UNKNOWN, fit.text
        assert fit.text.startswith("not yet known: too little yaw")


def test_what_has_fitted_once_is_not_contradicted_later_in_the_flight(rng: np.random.Generator) -> None:
    model = vehicle.load("octo-x")
    state = watched(model, shown(model, rng))
    assert state.proven
    state = watched(model, shown(swapped(model, 0, 3), rng, seconds=30.0), state)
    assert state.proven
    assert state.fit.verdict != FitVerdict.DOES_NOT_FIT


def test_a_break_leaves_what_was_gathered_and_starts_the_filters_anew(rng: np.random.Generator) -> None:
    model = vehicle.load("octo-x")
    monitor = FitMonitor(model, DT_S, FitTuning())
    state = monitor.paused(watched(model, shown(model, rng, seconds=4.0)))
    assert state.fast is None
    assert state.count > 0.0
    state = watched(model, shown(model, rng), state)
    assert state.fit.verdict == FitVerdict.FITS


def test_a_vehicle_that_flies_by_half_the_thrust_of_its_file_is_told_by_that_alone() -> None:
    model = vehicle.load("octo-x")
    monitor = FitMonitor(model, DT_S, FitTuning())
    state = monitor.start()
    for _ in range(int(6.0 / DT_S)):
        state = monitor.lifted(state, 9.81, np.full(model.motors, 0.5 * model.hover))
    assert state.fit.short == "thrust is 2.00 times its"


def test_states_are_replaced_and_never_written_to(rng: np.random.Generator) -> None:
    model = vehicle.load("octo-x")
    monitor = FitMonitor(model, DT_S, FitTuning())
    flight = shown(model, rng, seconds=5.0)
    state = watched(model, flight)
    kept = copy.deepcopy((state.sums, state.total, state.count))
    for sample in flight:
        monitor.step(state, sample)
    np.testing.assert_array_equal(state.sums, kept[0])
    np.testing.assert_array_equal(state.total, kept[1])
    assert state.count == kept[2]


def test_no_order_is_there_twice() -> None:
    for name in AIRFRAMES:
        rows = vehicle.load(name).acceleration_effectiveness[1:]
        unit = [order.rows / np.linalg.norm(order.rows, axis=1, keepdims=True) for order in orders(rows)]
        assert all(not np.allclose(a, unit[0]) for a in unit[1:]), name


def test_a_factor_is_off_by_its_nearer_end() -> None:
    assert Factor(1.1, 1.4).least == 1.1
    assert Factor(0.5, 0.7).least == 0.7
    assert Factor(0.8, 1.5).least == 1.0
    assert Factor(1.3, 1.6).beyond(1.2)
    assert not Factor(0.9, 1.6).beyond(1.2)
    assert Factor(0.5, 0.7).beyond(1.4)


def test_words_are_short_enough_for_the_pilot() -> None:
    third = Factor(3.0, 3.2)
    wrong: list[Fit] = [
        judged(Seen(seconds=9.0, thrust=third), FitTuning()),
        judged(Seen(seconds=9.0, thrust=third, turns=(third, third, third)), FitTuning()),
        judged(Seen(seconds=9.0, margin=-99.0, ambiguous=True), FitTuning()),
        judged(Seen(seconds=9.0, margin=-99.0, order="motor 12 spin reversed"), FitTuning()),
        judged(Seen(seconds=9.0, misfit=999.0), FitTuning()),
    ]
    for fit in wrong:
        assert fit.verdict == FitVerdict.DOES_NOT_FIT
        assert len(f"NFF: wrong airframe file: {fit.short}") <= 50, fit.short


def test_a_vehicle_whose_thrusts_stand_still_says_nothing_and_ends_nothing(octo: Vehicle) -> None:
    # Outputs held for seconds, as by an autopilot that is driven by hand: no product with them is more than 0.
    monitor = FitMonitor(octo, DT_S, FitTuning())
    filters = ResidualFilter(octo, DT_S)
    command = np.full(8, octo.hover)
    state, residual = monitor.start(), filters.start(np.zeros(3), np.array([0.0, 0.0, -9.8]), command)
    for k in range(4000):
        gyro = 0.1 * np.sin(0.03 * k * np.array([1.0, 1.3, 0.7]))
        residual = filters.step(residual, gyro, np.array([0.0, 0.0, -9.8]), command, DT_S)
        state = monitor.step(state, residual)
    assert state.fit.verdict == FitVerdict.UNKNOWN


@pytest.mark.parametrize("spoilt", [np.nan, np.inf, 1e200])
def test_sums_that_are_no_numbers_are_forgotten_and_the_flight_goes_on(
    octo: Vehicle, rng: np.random.Generator, spoilt: float
) -> None:
    monitor, seen = FitMonitor(octo, DT_S, FitTuning()), shown(octo, rng)
    state = monitor.start()
    sums, total = np.full_like(state.sums, spoilt), np.full_like(state.total, spoilt)
    state = msgspec.structs.replace(state, sums=sums, total=total, count=100.0)
    for residual in seen:
        state = monitor.step(state, residual)
    assert np.isfinite(state.sums).all()
    assert state.fit.verdict != FitVerdict.DOES_NOT_FIT


def test_an_autopilot_whose_motors_stand_still_has_no_factor_of_thrust(octo: Vehicle) -> None:
    monitor = FitMonitor(octo, DT_S, FitTuning())
    state = monitor.start()
    for _ in range(4000):
        state = monitor.lifted(state, 9.8, np.zeros(octo.motors))
    assert monitor.seen(state).thrust is None
    assert state.fit.verdict == FitVerdict.UNKNOWN
