"""Rotors of any kind: tilted, raised, unlike, measured; what the companion and the plant each make of one file."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from unlike_rotors import OCTO, every, first_alone, having, loaded, measured_octo, tilted_octo, written

from nff_companion.core import vehicle
from nff_companion.core.filters import lag_share
from nff_companion.core.residual import ResidualFilter
from nff_companion.core.vehicle import PITCH, ROLL, THRUST, YAW, Vehicle
from nff_companion.errors import NffError
from sitl import airframe
from sitl.fleet import Fleet, FleetOptions
from sitl.plant import Plant, initial_state
from sitl.trials.virtual import sample_of

DT = 0.005


def measured_by_the_plant(path: Path, fraction: NDArray[np.float64], **options: Any) -> NDArray[np.float64]:
    """Upward specific force and angular accelerations (4,) of the plant at rest, its rotors at ``fraction``."""
    never = np.full((1, 8), 1e12)
    parameters = dataclasses.replace(
        airframe.load(path, **options), time_constant_up_s=never, time_constant_down_s=never
    )
    plant, state = Plant(parameters, 1e-4), initial_state(parameters, height_m=100.0)
    state.thrust_n[:] = parameters.max_thrust_n * fraction
    plant.step(state, np.zeros((1, 8)), np.zeros((1, 3)))
    return np.concatenate([-plant.specific_force(state)[0, 2:], state.rate_rad_s[0] / 1e-4])


# -- B0 ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", vehicle.names())
def test_upright_rotors_make_the_same_bits_as_ever(name: str) -> None:
    model = vehicle.load(name)
    x, y = model.position_m.T
    plain = np.stack([np.ones_like(x), -y, x, model.motor.torque_per_thrust_m * model.spin]) * model.motor.max_thrust_n
    assert model.effectiveness_si.tobytes() == plain.tobytes()
    assert model.hover == model.mass_kg * 9.80665 / (model.motors * model.motor.max_thrust_n)
    assert model.lag_s == (model.motor.time_constant_up_s, model.motor.time_constant_down_s)


def test_the_defaults_written_out_change_no_bit(tmp_path: Path) -> None:
    octo = vehicle.load("octo-x")
    line = "z_m = 0.0\naxis = [0, 0, -1]\nthrust = 1\ntime_constant_up_s = 0.045\ntime_constant_down_s = 0.045"
    told = loaded(tmp_path, having(every(line), head=["centre_of_mass_m = [0, 0, 0]"], delay="0"))
    assert told.effectiveness_si.tobytes() == octo.effectiveness_si.tobytes()
    assert told.effectiveness.tobytes() == octo.effectiveness.tobytes()
    assert (told.hover, told.lag_s, told.telemetry) == (octo.hover, octo.lag_s, octo.telemetry)


def test_a_tilted_rotor_gives_the_cross_product_of_place_and_push(tmp_path: Path) -> None:
    # r = (0.461940, 0.191342, -0.1) - (0.02, 0, 0.05), a = (0.3, -0.4, -1.2) / 1.3, F = 1.1 * 18.387 N, clockwise.
    text = having(
        first_alone("z_m = -0.1\naxis = [0.3, -0.4, -1.2]\nthrust = 1.1"), head=["centre_of_mass_m = [0.02, 0.0, 0.05]"]
    )
    force = 1.1 * 18.387 * np.array([0.3, -0.4, -1.2]) / 1.3
    place = np.array([0.441940, 0.191342, -0.15])
    # By hand: y fz - z fy, z fx - x fz, x fy - y fx; drag of a clockwise rotor turns the airframe about +a.
    turn = [
        0.191342 * force[2] - (-0.15) * force[1],
        -0.15 * force[0] - 0.441940 * force[2],
        0.441940 * force[1] - 0.191342 * force[0],
    ]
    np.testing.assert_allclose(turn, np.cross(place, force))
    column = loaded(tmp_path, text).effectiveness_si[:, 0]
    np.testing.assert_allclose(column, [-force[2], *(np.array(turn) + 0.018 * force)], rtol=1e-5)


def test_the_length_of_an_axis_is_of_no_matter(tmp_path: Path) -> None:
    one, other = (
        loaded(tmp_path, having(first_alone(f"axis = {axis}"))) for axis in ([0.1, 0.2, -1.0], [0.15, 0.3, -1.5])
    )
    np.testing.assert_allclose(one.effectiveness_si, other.effectiveness_si, rtol=1e-12)


def test_the_centre_of_mass_moves_all_places_and_nothing_else(tmp_path: Path) -> None:
    octo = vehicle.load("octo-x")
    moved = loaded(tmp_path, having(every(""), head=["centre_of_mass_m = [0.03, -0.02, 0.1]"]))
    np.testing.assert_allclose(moved.position_m, octo.position_m - [0.03, -0.02], atol=1e-12)
    for row in (THRUST, YAW):
        np.testing.assert_array_equal(moved.effectiveness_si[row], octo.effectiveness_si[row])
    full = octo.motor.max_thrust_n
    np.testing.assert_allclose(moved.effectiveness_si[ROLL] - octo.effectiveness_si[ROLL], -0.02 * full)
    np.testing.assert_allclose(moved.effectiveness_si[PITCH] - octo.effectiveness_si[PITCH], -0.03 * full)


def test_stronger_rotors_hover_with_less(tmp_path: Path) -> None:
    octo, strong = vehicle.load("octo-x"), loaded(tmp_path, having(every("thrust = 1.25")))
    assert strong.hover == pytest.approx(octo.hover / 1.25)
    assert strong.full_thrust_n == pytest.approx(octo.full_thrust_n * 1.25)


def test_accelerations_are_taken_as_they_are_given(tmp_path: Path) -> None:
    model = loaded(tmp_path, measured_octo())
    expected = vehicle.load("octo-x").acceleration_effectiveness * np.linspace(0.9, 1.1, 8)
    expected[1:3] *= 1.05
    np.testing.assert_allclose(model.acceleration_effectiveness, expected, atol=1e-6)
    np.testing.assert_allclose(model.effectiveness_si[ROLL], model.inertia_kg_m2[0] * expected[ROLL], atol=1e-5)
    assert model.hover == pytest.approx(9.80665 / expected[0].sum(), rel=1e-6)


@pytest.mark.parametrize("text", [tilted_octo(), measured_octo()], ids=["tilted", "measured"])
def test_thrust_to_weight_is_that_of_all_rotors_together(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    assert vehicle.load(str(path), thrust_to_weight=2.2).hover == pytest.approx(1 / 2.2)
    assert airframe.load(path, thrust_to_weight=2.2).lift_n[0] == pytest.approx(2.2 * 6.0 * 9.80665)


@pytest.mark.parametrize("text", [tilted_octo(), measured_octo()], ids=["tilted", "measured"])
@pytest.mark.parametrize("turns", [1, 2, 3])
def test_nothing_depends_on_where_the_nose_is(tmp_path: Path, text: str, turns: int) -> None:
    model = loaded(tmp_path, text)
    turned = model.renumbered(turns)
    u = np.linspace(0.2, 0.6, 8)
    given, now = model.effectiveness_si @ u, turned.effectiveness_si @ np.roll(u, turns)
    for _ in range(turns):  # what was forward is to the right
        given = np.array([given[0], -given[2], given[1], given[3]])
    np.testing.assert_allclose(now, given, atol=1e-9)
    np.testing.assert_allclose(np.sort(turned.rotors.time_constant_down_s), np.sort(model.rotors.time_constant_down_s))
    assert turned.hover == pytest.approx(model.hover)


def test_rotors_of_one_spin_may_yaw_by_their_tilt(tmp_path: Path) -> None:
    octo, lines = vehicle.load("octo-x"), []
    for i in range(8):
        (x, y), side = octo.position_m[i] / 0.5, (0.2 if i % 2 else -0.3)
        lines.append(f"axis = [{-y * side:.6f}, {x * side:.6f}, -1.0]")
    model = loaded(tmp_path, having(lines).replace('"cw"', '"ccw"'))
    assert model.effectiveness_si[YAW].min() < 0.0 < model.effectiveness_si[YAW].max()


# -- refused -----------------------------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[str, str]] = {
    "too low": (having(first_alone("z_m = 11.0")), r"rotor\[1\]\.z_m = 11\.0 is not allowed: give a number from -10"),
    "no number for a height": (having(first_alone("z_m = nan")), r"rotor\[1\]\.z_m = nan"),
    "no direction": (having(first_alone("axis = [0, 0, 0]")), r"rotor\[1\]\.axis = .*direction"),
    "a direction of no length": (having(first_alone("axis = [0, 0, -0.1]")), r"rotor\[1\]\.axis = .*length"),
    "sideways": (having(first_alone("axis = [0, 1.0, -0.5]")), r"rotor\[1\]\.axis = .*0\.45 of the thrust pushes up"),
    "downwards": (having(first_alone("axis = [0, 0, 1]")), r"rotor\[1\]\.axis = .*-1 of the thrust pushes up"),
    "an axis that is not finite": (having(first_alone("axis = [0, inf, -1]")), r"rotor\[1\]\.axis = .*inf"),
    "an axis out of range": (having(first_alone("axis = [0, 0, -9]")), r"rotor\[1\]\.axis = .*a list of 3 numbers"),
    "an axis in a plane": (having(first_alone("axis = [0, -1]")), r"rotor\[1\]\.axis"),
    "hardly any thrust": (having(first_alone("thrust = 0.2")), r"rotor\[1\]\.thrust = 0\.2 .* from 0\.3 to 3"),
    "too much thrust": (having(first_alone("thrust = 3.5")), r"rotor\[1\]\.thrust = 3\.5"),
    "a lag below nought": (having(first_alone("time_constant_up_s = -0.1")), r"rotor\[1\]\.time_constant_up_s"),
    "a lag of seconds": (having(first_alone("time_constant_down_s = 2")), r"rotor\[1\]\.time_constant_down_s = 2 .* s"),
    "a centre of mass elsewhere": (
        having(every(""), head=["centre_of_mass_m = [0, 20, 0]"]),
        r"airframe\.centre_of_mass_m = \[0, 20, 0\] is not allowed: give a list of 3 numbers from -10 to 10 m",
    ),
    "a centre of mass on a plane": (having(every(""), head=["centre_of_mass_m = [0, 0]"]), r"centre_of_mass_m"),
    "a centre of mass beside the rotors": (
        having(every(""), head=["centre_of_mass_m = [0.6, 0, 0]"]),
        "the centre of mass must lie well within the rotors",
    ),
    "outputs ahead of time": (having(every(""), delay="-0.001"), r"telemetry\.output_delay_s = -0\.001"),
    "outputs far too late": (having(every(""), delay="0.2"), r"telemetry\.output_delay_s = 0\.2 .* from 0 to 0\.1 s"),
    "accelerations of one rotor": (
        having(first_alone("acceleration = [3.0, -4.0, 9.0, -1.0]")),
        r"rotor\[2\]\.acceleration is missing: give it of all rotors, or of none",
    ),
    "an acceleration downwards": (
        having(first_alone("acceleration = [-3.0, -4.0, 9.0, -1.0]")),
        r"rotor\[1\]\.acceleration = .*above 0",
    ),
    "an acceleration beyond all": (
        having(first_alone("acceleration = [3.0, -4.0, 9e9, -1.0]")),
        r"rotor\[1\]\.acceleration = .* a list of 4 numbers",
    ),
    "an acceleration and an axis": (
        having(first_alone("axis = [0, 0.1, -1]\nacceleration = [3.0, -4.0, 9.0, -1.0]")),
        r"rotor\[1\]\.acceleration: .*axis and thrust",
    ),
    "accelerations that hover with nothing": (
        re.sub(r"acceleration = \[[^,]+,", "acceleration = [60.0,", measured_octo()),
        r"rotor\.acceleration: 8 rotors hover .* at 0\.0204",
    ),
    "accelerations without yaw": (
        measured_octo(yaw=np.zeros(8)),
        "thrust, roll, pitch and yaw cannot be set one by one",
    ),
    "yaw of all in one direction": (
        measured_octo(yaw=np.linspace(0.5, 1.5, 8) ** 2),
        "no thrusts within 0..1 hold the vehicle level",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_rotor_that_cannot_be_is_refused_by_file_key_and_value(tmp_path: Path, name: str) -> None:
    text, message = REFUSED[name]
    path = written(tmp_path, text)
    with pytest.raises(NffError, match=message) as refused:
        vehicle.load(str(path))
    assert str(path) in str(refused.value)
    assert len(str(refused.value)) < 500


# -- the chain of the residual -----------------------------------------------------------------------------------------


def run(chain: ResidualFilter, commands: NDArray[np.float64]) -> NDArray[np.float64]:
    """w (K, m) as it shows, of commands (K, m)."""
    state, still = chain.start(np.zeros(3), np.array([0.0, 0.0, -9.8]), commands[0]), np.array([0.0, 0.0, -9.8])
    shown = []
    for command in commands:
        state = chain.step(state, np.zeros(3), still, command, DT)
        shown.append(state.thrust_shown)
    return np.array(shown)


@pytest.mark.parametrize("samples", [0.2, 1.0, 2.6, 20.0])
def test_commands_show_later_by_the_delay_of_the_file(
    tmp_path: Path, octo: Vehicle, rng: np.random.Generator, samples: float
) -> None:
    late = ResidualFilter(loaded(tmp_path, having(every(""), delay=f"{samples * DT:.6f}")), DT)
    commands = rng.uniform(0.2, 0.7, (120, 8))
    times = np.arange(120.0)
    delayed = np.stack([np.interp(times - samples, times, commands[:, k]) for k in range(8)], axis=1)
    np.testing.assert_allclose(run(late, commands), run(ResidualFilter(octo, DT), delayed), atol=1e-9)
    assert np.abs(run(late, commands) - run(ResidualFilter(octo, DT), commands)).max() > 1e-3


def test_without_a_delay_no_command_is_kept(octo: Vehicle) -> None:
    chain, command = ResidualFilter(octo, DT), np.full(8, 0.4)
    state = chain.start(np.zeros(3), np.zeros(3), command)
    assert state.sent == ()
    assert chain.step(state, np.zeros(3), np.zeros(3), command, DT).sent == ()


def test_other_filters_leave_the_delay_of_the_outputs(tmp_path: Path) -> None:
    model = loaded(tmp_path, having(every(""), delay="0.012"))
    told = model.with_telemetry(vehicle.TelemetryTable(40.0, 30.0)).telemetry
    assert (told.gyro_filter_hz, told.accelerometer_filter_hz, told.output_delay_s) == (40.0, 30.0, 0.012)
    assert model.renumbered(1).telemetry == model.telemetry


@pytest.mark.parametrize(
    ("ups", "downs"),
    [
        ([0.02, 0.05, 0.03, 0.08], [0.06, 0.03, 0.03, 0.02]),
        ([0.02, 0.03, 0.04, 0.05], [0.06, 0.06, 0.06, 0.06]),
        ([0.06, 0.06, 0.06, 0.06], [0.02, 0.03, 0.04, 0.05]),
    ],
    ids=["some up faster, some down", "all up faster", "all down faster"],
)
def test_each_rotor_lags_by_its_own_time(
    tmp_path: Path, rng: np.random.Generator, ups: list[float], downs: list[float]
) -> None:
    lines = [f"time_constant_up_s = {u}\ntime_constant_down_s = {d}" for u, d in zip(2 * ups, 2 * downs, strict=True)]
    model = loaded(tmp_path, having(lines))
    assert model.rotors.time_constant_up_s.tolist() == 2 * ups
    model = model.with_telemetry(vehicle.TelemetryTable(0.0, 0.0))
    chain, commands = ResidualFilter(model, DT), rng.uniform(0.2, 0.7, (60, 8))
    state = chain.start(np.zeros(3), np.zeros(3), commands[0])
    lagged, before = commands[0], commands[0]
    up, down = (np.array([lag_share(DT, t) for t in 2 * lags]) for lags in (ups, downs))
    for command in commands:
        state = chain.step(state, np.zeros(3), np.zeros(3), command, DT)
        ahead = 0.5 * (before + command) - lagged
        lagged, before = lagged + np.where(ahead > 0.0, up, down) * ahead, command
        np.testing.assert_allclose(state.lagged, lagged, atol=1e-12)


# -- the plant ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [OCTO, tilted_octo(), measured_octo()], ids=["upright", "tilted", "measured"])
@pytest.mark.parametrize("ratio", [None, 2.2])
def test_plant_and_companion_read_the_same_accelerations_out_of_a_file(
    tmp_path: Path, rng: np.random.Generator, text: str, ratio: float | None
) -> None:
    path = written(tmp_path, text)
    model = vehicle.load(str(path), thrust_to_weight=ratio)
    for fraction in (np.full(8, model.hover), rng.uniform(0.1, 0.8, 8)):
        seen = measured_by_the_plant(path, fraction, thrust_to_weight=ratio)
        np.testing.assert_allclose(seen, model.acceleration_effectiveness @ fraction, rtol=1e-4, atol=2e-3)


@pytest.mark.parametrize("text", [tilted_octo(), measured_octo()], ids=["tilted", "measured"])
def test_the_plants_matrix_is_the_companions(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    model, plant = vehicle.load(str(path)), airframe.load(path, vehicles=3)
    assert not plant.alike
    np.testing.assert_allclose(plant.effectiveness_si(), model.effectiveness_si, atol=1e-4)
    np.testing.assert_allclose(
        np.broadcast_to(plant.time_constant_down_s.T, (8, 3))[:, 0], model.rotors.time_constant_down_s
    )


def test_what_an_autopilot_is_told_of_places_does_not_know_the_centre_of_mass(tmp_path: Path) -> None:
    plain = airframe.load(vehicle.path_of("octo-x"))
    for text in (tilted_octo(), measured_octo()):
        told = airframe.load(written(tmp_path, text))
        np.testing.assert_allclose(told.frame_m, plain.position_m, atol=1e-12)
        assert np.abs(told.position_m - plain.position_m).max() > 0.01


def test_hubs_at_their_own_heights_drag_there(tmp_path: Path) -> None:
    high, low = (airframe.load(written(tmp_path, having(every(f"z_m = {z}")))) for z in (-0.24, -0.04))
    plain = airframe.load(vehicle.path_of("octo-x"))
    rates = []
    for parameters in (plain, low, high):
        plant, state = Plant(parameters, 1e-3), initial_state(parameters, height_m=50.0)
        state.thrust_n[:] = 7.0
        plant.step(state, np.full((1, 8), 0.5), np.array([[4.0, 0.0, 0.0]]))
        rates.append(state.rate_rad_s[0])
    np.testing.assert_allclose(rates[1], rates[0], atol=1e-12)
    speed = np.sqrt(7.0 / 18.387)
    # 20 cm higher: wind from behind pushes all hubs forward, nose down.
    gained = -0.2 * 8 * 0.3 * speed * 4.0 / 0.17 * 1e-3
    assert rates[2][1] - rates[1][1] == pytest.approx(gained, rel=0.02)


def test_a_delay_that_is_told_leaves_less_of_the_residual(tmp_path: Path) -> None:
    path = written(tmp_path, having(every(""), delay="0.03"))
    fleet = Fleet(airframe.load(path), FleetOptions(seeds=[1], height_m=10.0))
    fleet.autopilot.position.goal[0, :2] = [6.0, -4.0]
    samples = []
    for _ in range(1200):
        fleet.step()
        samples.append(sample_of(fleet, 0))
    left = {}
    for model in (vehicle.load("octo-x"), vehicle.load(str(path))):
        chain = ResidualFilter(model, 1 / 400)
        first = samples[0]
        state = chain.start(first.gyro_rad_s, first.specific_force_m_s2, model.thrust_fraction(first.output))
        rows = []
        for sample in samples[1:]:
            command = model.thrust_fraction(sample.output)
            state = chain.step(state, sample.gyro_rad_s, sample.specific_force_m_s2, command, 1 / 400)
            rows.append((state.measured - model.acceleration_effectiveness @ state.thrust_shown)[ROLL : PITCH + 1])
        left[model.telemetry.output_delay_s] = float(np.std(np.array(rows)[200:]))
    assert left[0.03] < 0.7 * left[0.0], left


def test_the_plant_has_the_delay_of_the_file(tmp_path: Path) -> None:
    told = airframe.load(written(tmp_path, having(every(""), delay="0.012")), vehicles=2)
    assert told.output_delay_s.tolist() == [0.012, 0.012]
