"""What may be wrong in an airframe file: each quantity moves what it should, and nothing is drawn unasked."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import vehicle
from sitl import airframe
from sitl.faults import Faulty
from sitl.fleet import Fleet, FleetOptions, learned_hover_throttle
from sitl.noise import vehicle_generators
from sitl.plant import Plant, initial_state
from sitl.serve.physics import Physics, PhysicsOptions
from sitl.uncertainty import Uncertainty

OCTO = vehicle.path_of("octo-x")
SEEDS = list(range(1, 201))
DT = 1 / 1200
FULL = Uncertainty.estimated()


def nominal(vehicles: int = 1) -> airframe.PlantParameters:
    return airframe.load(OCTO, vehicles=vehicles)


def drawn(uncertainty: Uncertainty, seeds: list[int] = SEEDS) -> airframe.PlantParameters:
    return uncertainty.drawn(nominal(len(seeds)), vehicle_generators(seeds, 3))


def flown(seconds: float = 1.0, **options: Any) -> Fleet:
    seeds = [1, 2, 3]
    fleet = Fleet(nominal(len(seeds)), FleetOptions(seeds=seeds, height_m=10.0, wind_m_s=3.0, **options))
    for _ in range(round(400 * seconds)):
        fleet.step()
    return fleet


def first_motion(parameters: airframe.PlantParameters, output: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angular acceleration (N, 3) in the first step from rest, rotors at the thrust that ``output`` asks."""
    plant = Plant(parameters, DT)
    state = initial_state(parameters, height_m=100.0)
    state.thrust_n[:] = parameters.max_thrust_n * plant.thrust_fraction(output)
    plant.step(state, output, np.zeros((parameters.vehicles, 3)))
    return state.rate_rad_s / DT


# -- nothing drawn -----------------------------------------------------------------------------------------------------


def test_nothing_is_drawn_by_default_and_every_bit_stays() -> None:
    fleet, same = flown(model_error=0.1), flown(model_error=0.1, uncertainty=Uncertainty())
    assert fleet.parameters.position_m is fleet.nominal.position_m
    assert not fleet.parameters.output_delay_s.any()
    for name in ("position_m", "quaternion", "thrust_n"):
        np.testing.assert_array_equal(getattr(fleet.state, name), getattr(same.state, name))
    assert Uncertainty.exact() == Uncertainty()


def test_geometry_and_constants_of_each_vehicle_do_what_those_of_all_do() -> None:
    shared = airframe.load(OCTO, vehicles=3)
    own = dataclasses.replace(
        shared,
        position_m=np.tile(shared.position_m, (3, 1, 1)),
        pressure_centre_m=np.tile(shared.pressure_centre_m, (3, 1)),
        time_constant_up_s=np.tile(shared.time_constant_up_s[:, None], (1, 8)),
        time_constant_down_s=np.tile(shared.time_constant_down_s[:, None], (1, 8)),
        torque_per_thrust_m=np.tile(shared.torque_per_thrust_m[:, None], (1, 8)),
    )
    states = []
    for parameters in (shared, own):
        plant, state = Plant(parameters, DT), initial_state(parameters, height_m=20.0)
        for k in range(1200):
            output = 0.55 + 0.02 * np.sin(0.01 * k * np.arange(1, 25).reshape(3, 8))
            wind = np.array([[5.0, 1.0, 0.0], [0.0, 0.0, 0.0], [-3.0, 2.0, 0.5]])
            plant.step(state, output, wind)
        states.append(state)
    assert states[0].rate_rad_s.any()
    for name in ("position_m", "quaternion", "rate_rad_s", "thrust_n"):
        np.testing.assert_allclose(getattr(states[1], name), getattr(states[0], name), rtol=1e-9, atol=1e-9)


def test_what_else_is_drawn_of_a_seed_does_not_move_with_it() -> None:
    without, with_it = flown(model_error=0.1), flown(model_error=0.1, uncertainty=FULL)
    for name in ("mass_kg", "inertia_kg_m2"):
        np.testing.assert_array_equal(getattr(without.parameters, name), getattr(with_it.parameters, name))
    np.testing.assert_array_equal(without.wind.step(2.0), with_it.wind.step(2.0))


# -- widths ------------------------------------------------------------------------------------------------------------


def test_an_estimate_is_within_its_ranges_and_reaches_towards_their_ends() -> None:
    true, told = drawn(FULL), nominal()

    def spread(values: NDArray[np.float64], low: float, high: float) -> None:
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high

    lag = np.sqrt(true.time_constant_up_s * true.time_constant_down_s) / 0.045
    spread(lag, 0.6, 1.6)
    spread(np.sqrt(true.time_constant_up_s / true.time_constant_down_s), 0.9, 1.1)
    spread(true.torque_per_thrust_m / 0.018, 0.6, 1.5)
    spread(true.thrust_expo, 0.35, 0.95)
    spread(true.spin_min, 0.09, 0.21)
    spread(true.max_thrust_n / told.max_thrust_n, 0.92, 1.08)
    spread(true.output_delay_s, 0.0, 0.010)
    off = (true.position_m - told.position_m).mean(axis=1)
    assert 0.015 < np.hypot(off[:, 0], off[:, 1]).max() < 0.02 + 0.025
    own = dataclasses.replace(FULL, centre_of_mass=0.0)
    spread(drawn(own).position_m - told.position_m, -0.025, 0.025)
    spread(drawn(own).imu_m, -0.03, 0.03)
    for turn in (true.gyro_turn_rad, true.accelerometer_turn_rad):
        spread(np.degrees(turn), -2.0, 2.0)
    spread(true.gyro_filter_hz / told.gyro_filter_hz, 0.7, 1.4)
    spread(true.accelerometer_filter_hz / told.accelerometer_filter_hz, 0.7, 1.4)


def test_the_imu_stays_where_it_is_when_the_mass_is_elsewhere() -> None:
    moved = drawn(Uncertainty(centre_of_mass=0.04))
    np.testing.assert_allclose(moved.imu_m[:, :2], moved.position_m[:, 0] - nominal().position_m[0], atol=1e-12)


def test_a_calibrated_file_leaves_a_fifth_of_it() -> None:
    calibrated = Uncertainty.calibrated()
    assert calibrated.lag_factor == pytest.approx((0.92, 1.12))
    assert calibrated.torque_factor == pytest.approx((0.92, 1.10))
    for field in dataclasses.fields(Uncertainty):
        if not field.name.endswith("factor"):
            assert getattr(calibrated, field.name) == pytest.approx(0.2 * getattr(FULL, field.name))


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(Uncertainty)])
def test_each_width_moves_its_own_quantities_alone(field: str) -> None:
    moves = {
        "lag_factor": {"time_constant_up_s", "time_constant_down_s"},
        "lag_split": {"time_constant_up_s", "time_constant_down_s"},
        "torque_factor": {"torque_per_thrust_m"},
        "motor_thrust": {"max_thrust_n"},
        "place": {"position_m"},
        "centre_of_mass": {"position_m", "pressure_centre_m", "imu_m"},
        "imu_place": {"imu_m"},
        "sensor_turn_rad": {"gyro_turn_rad", "accelerometer_turn_rad"},
        "filter_factor": {"gyro_filter_hz", "accelerometer_filter_hz"},
    }
    told, alone, all_of_it = nominal(3), drawn(Uncertainty(**{field: getattr(FULL, field)}), [1, 2, 3]), drawn(FULL)
    changed = {f.name for f in dataclasses.fields(told) if not np.all(getattr(alone, f.name) == getattr(told, f.name))}
    assert changed == moves.get(field, {field})
    if field in ("torque_factor", "thrust_expo", "spin_min", "motor_thrust", "output_delay_s"):
        (name,) = changed
        np.testing.assert_array_equal(getattr(alone, name), getattr(all_of_it, name)[:3])


def test_a_linear_and_a_quadratic_curve_and_no_idle_stay_within_what_a_motor_can_do() -> None:
    for expo, idle in ((0.0, 0.0), (1.0, 0.5)):
        told = dataclasses.replace(
            nominal(len(SEEDS)), thrust_expo=np.full(len(SEEDS), expo), spin_min=np.full(len(SEEDS), idle)
        )
        true = FULL.drawn(told, vehicle_generators(SEEDS, 3))
        assert 0.0 <= true.thrust_expo.min() <= true.thrust_expo.max() <= 1.0
        assert 0.0 <= true.spin_min.min() <= true.spin_min.max() <= told.spin_max - 0.1


def test_a_wrong_number_of_generators_is_refused() -> None:
    with pytest.raises(ValueError, match="2 generators for 3 vehicles"):
        FULL.drawn(nominal(3), vehicle_generators([1, 2], 3))


# -- what it does to the motion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0025, 0.010, 0.0101])
def test_a_step_of_the_output_shows_later_by_the_delay(delay_s: float) -> None:
    parameters = dataclasses.replace(nominal(2), output_delay_s=np.array([0.0, delay_s]))
    plant, state = Plant(parameters, DT), initial_state(parameters, height_m=100.0)
    rows = []
    for k in range(1200):
        output = np.full((2, 8), 0.3 if k < 600 else 0.8)
        plant.step(state, output, np.zeros((2, 3)))
        rows.append(state.thrust_n[:, 0])
    rise = np.array(rows)[600:]
    end = rise[-1].max()
    crossed = [float(np.interp(0.5 * end, rise[:250, k], np.arange(250) * DT)) for k in (0, 1)]
    assert crossed[1] - crossed[0] == pytest.approx(delay_s, abs=0.15 * DT)


def test_a_stuck_motor_holds_what_it_heard_last() -> None:
    parameters = dataclasses.replace(nominal(), output_delay_s=np.array([0.01]))
    plant, state = Plant(parameters, DT), initial_state(parameters, height_m=100.0)
    faulty = Faulty.none(1, 8)
    for k in range(40):
        faulty.stuck[0, 2] = k >= 30
        plant.step(state, np.full((1, 8), 0.01 * k), np.zeros((1, 3)), faulty)
    assert state.held_command[0, 2] == pytest.approx(0.01 * (29 - 12))
    assert state.held_command[0, 3] == pytest.approx(0.01 * (39 - 12))


def test_a_centre_of_mass_off_gives_the_torque_of_the_weight_beside_it() -> None:
    told = nominal()
    hover = np.full((1, 8), 0.55)
    offset = np.array([0.02, -0.01])
    moved = dataclasses.replace(told, position_m=(told.position_m - offset)[None])
    lift = float((told.max_thrust_n * Plant(told, DT).thrust_fraction(hover)).sum())
    ix, iy, _ = told.inertia_kg_m2[0]
    gained = (first_motion(moved, hover) - first_motion(told, hover))[0]
    # All lift at the old centre, which is at -offset from the new one: roll -y F, pitch x F.
    np.testing.assert_allclose(gained[:2], [offset[1] * lift / ix, -offset[0] * lift / iy], rtol=0.01)


def test_rotor_places_motor_thrust_and_torque_ratio_give_the_moments_they_should() -> None:
    output = np.zeros((len(SEEDS), 8))
    output[:, 4] = 0.6
    true = drawn(dataclasses.replace(FULL, output_delay_s=0.0))
    fraction = Plant(true, DT).thrust_fraction(output)[:, 4]
    thrust = true.max_thrust_n[:, 4] * fraction
    x, y = true.position_m[:, 4].T
    found = first_motion(true, output) * true.inertia_kg_m2
    # The battery's sag and the lag of one step take less than 2 %; what the others' drag adds is nothing at rest.
    np.testing.assert_allclose(found[:, 0], -y * thrust, rtol=0.02)
    np.testing.assert_allclose(found[:, 1], x * thrust, rtol=0.02, atol=1e-3)
    speed_change = 0.05 * true.torque_per_thrust_m * thrust
    np.testing.assert_array_less(np.abs(found[:, 2] - true.torque_per_thrust_m * thrust), speed_change + 0.01)


def test_the_autopilot_goes_on_using_what_the_file_says() -> None:
    fleet, exact = flown(0.1, uncertainty=FULL), flown(0.1)
    true, told = fleet.parameters, fleet.nominal
    assert true.position_m.shape == (3, 8, 2)
    np.testing.assert_array_equal(fleet.autopilot._stock, exact.autopilot._stock)
    for vehicle_index in range(3):
        fleet.autopilot.disarm(vehicle_index)
        fleet.autopilot.arm(vehicle_index)
    idle = fleet.autopilot.step(fleet.sensors.measured, fleet.time_s)
    assert (idle == told.spin_min[0]).all()
    assert (true.spin_min != told.spin_min[0]).all()


def test_the_learned_hover_throttle_carries_the_vehicle_through_the_wrong_curve() -> None:
    true, told = drawn(FULL), nominal()
    throttle = learned_hover_throttle(told, true)
    e, idle = 0.65, 0.15
    command = (np.sqrt((1 - e) ** 2 + 4 * e * throttle) - (1 - e)) / (2 * e)
    output = np.tile((idle + (0.95 - idle) * command)[:, None], (1, 8))
    lift = (true.max_thrust_n * Plant(true, DT).thrust_fraction(output)).sum(axis=1)
    np.testing.assert_allclose(lift, true.mass_kg * 9.80665, rtol=1e-9)


def test_a_vehicle_of_many_flies_as_it_does_alone() -> None:
    def fly(seeds: list[int]) -> Fleet:
        options = FleetOptions(seeds=seeds, height_m=10.0, wind_m_s=3.0, turbulence_m_s=0.5, uncertainty=FULL)
        fleet = Fleet(nominal(len(seeds)), options)
        for _ in range(100):
            fleet.step()
        return fleet

    many, alone = fly([4, 5, 6]), fly([5])
    np.testing.assert_allclose(many.state.position_m[1], alone.state.position_m[0], atol=1e-12)
    np.testing.assert_allclose(many.state.rate_rad_s[1], alone.state.rate_rad_s[0], atol=1e-11)


def test_the_served_physics_takes_it_too() -> None:
    exact, wrong = (Physics(nominal(), PhysicsOptions(seed=2, uncertainty=u)) for u in (Uncertainty.exact(), FULL))
    for physics in (exact, wrong):
        for _ in range(200):
            physics.step(np.full(8, 0.7), 1 / 400)
    assert wrong.parameters.position_m.shape == (1, 8, 2)
    assert np.abs(wrong.state.rate_rad_s - exact.state.rate_rad_s).max() > 0.01
