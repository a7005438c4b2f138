"""A vehicle's numbers come out of its own flight as they are, with deviations that say how well."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from flown_logs import RATE_HZ, Flight, log_flight
from numpy.typing import NDArray
from scipy.signal import lfilter

from nff_companion.autopilots.ardupilot import checks
from nff_companion.autopilots.px4 import outputs
from nff_companion.calibration import air, airframe, chain, excitation, fit, model, order
from nff_companion.calibration.record import Record, record
from nff_companion.core import vehicle as vehicles
from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.residual import ResidualFilter
from nff_companion.core.tuning import DEFAULT
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NotJudged
from nff_companion.replay import calibrate
from nff_companion.replay.flight import Reading

SMOOTHING_S = DEFAULT.residual.smoothing_s
FILTERS = chain.Filters(0.0, 0.0, SMOOTHING_S)
OCTO = vehicles.path_of("octo-x").read_text(encoding="utf-8")


def inertia(vehicle: Vehicle) -> tuple[float, float, float]:
    jx, jy, jz = vehicle.inertia_kg_m2.tolist()
    return jx, jy, jz


def changed(text: str, *changes: tuple[str, str]) -> Vehicle:
    """The vehicle of an airframe file with lines replaced."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return Vehicle(msgspec.convert(tomllib.loads(text), AirframeFile))


UNFILTERED = (
    ("gyro_filter_hz = 20", "gyro_filter_hz = 0"),
    ("accelerometer_filter_hz = 20", "accelerometer_filter_hz = 0"),
)


def flown(vehicle: Vehicle, rng: np.random.Generator, seconds: float = 25.0) -> Record:
    return record([sample for _, sample in Flight(vehicle, seconds=seconds).rows(rng)])


def fitted(flight: Record, start: Vehicle, prior: model.Prior | None = None) -> fit.Fit:
    layout = model.Layout.of(start)
    begin = model.start(layout, start.motor.time_constant_up_s, start.command.thrust_expo, start.command.spin_min)
    return fit.fit(flight, layout, FILTERS, inertia(start), begin, prior or model.Prior(), rounds=2)


@pytest.mark.parametrize(("up", "down", "gyro_hz"), [(0.045, 0.045, 20.0), (0.03, 0.06, 20.0), (0.03, 0.03, 0.0)])
def test_the_chain_over_a_record_is_the_one_that_flies(
    up: float, down: float, gyro_hz: float, rng: np.random.Generator
) -> None:
    vehicle = changed(
        OCTO,
        ("time_constant_up_s = 0.045", f"time_constant_up_s = {up}"),
        ("time_constant_down_s = 0.045", f"time_constant_down_s = {down}"),
        ("gyro_filter_hz = 20", f"gyro_filter_hz = {gyro_hz}"),
    )
    rows = [sample for _, sample in Flight(vehicle, seconds=6.0).rows(rng)]
    piece = record(rows).pieces[0]
    filters = chain.Filters(gyro_hz, 20.0, SMOOTHING_S)
    shape = chain.Motors(0.0, up, down, 0.65, 0.15, 0.95)
    thrust = chain.shown(piece, [shape, shape], filters)
    measured = chain.measured(piece, filters, inertia(vehicle))
    flying = ResidualFilter(vehicle, piece.dt_s, DEFAULT.residual)
    command = vehicle.thrust_fraction(piece.output)
    state = flying.start(piece.gyro_rad_s[0], piece.specific_force_m_s2[0], command[0])
    shown, seen = [state.thrust_shown], [state.measured]
    for k in range(1, piece.samples):
        state = flying.step(state, piece.gyro_rad_s[k], piece.specific_force_m_s2[k], command[k], piece.dt_s)
        shown.append(state.thrust_shown)
        seen.append(state.measured)
    later = slice(200, None)  # how they begin differs: the flying one knows the sample before
    np.testing.assert_allclose(thrust[1][later], np.array(shown)[later], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(measured[later, :4], np.array(seen)[later], rtol=0.0, atol=1e-6)


def test_gains_lag_and_delay_come_out_of_a_flight(rng: np.random.Generator) -> None:
    true = changed(
        OCTO,
        ("inertia_kg_m2 = [0.17, 0.17, 0.32]", "inertia_kg_m2 = [0.12, 0.21, 0.32]"),
        ("time_constant_up_s = 0.045", "time_constant_up_s = 0.07"),
        ("time_constant_down_s = 0.045", "time_constant_down_s = 0.07"),
        ("torque_per_thrust_m = 0.018", "torque_per_thrust_m = 0.025"),
        *UNFILTERED,
    )
    flight = flown(true, rng, 25.0)
    shapes = []
    for late in (0, 2):  # samples
        pieces = [replace(p, output=np.roll(p.output, -late, axis=0)) for p in flight.pieces]
        found = fitted(Record(pieces), changed(OCTO, *UNFILTERED))
        shapes.append(model.shape_of(found.x, 0.95))
        assert shapes[-1].lag_up_s == pytest.approx(0.07, abs=0.005)
    assert shapes[1].delay_s - shapes[0].delay_s == pytest.approx(2.0 / RATE_HZ, abs=5e-4)
    mine = model.accelerations(found.x, found.layout)[1:]
    theirs = (true.acceleration_effectiveness * true.thrust_fraction(np.array(found.mean_output)))[1:]
    scale = np.abs(theirs).max(axis=1)
    assert (np.abs(mine - theirs).max(axis=1) / scale < 0.1).all(), mine / scale[:, None]


def test_a_curve_that_is_not_known_makes_the_gains_uncertain_and_not_what_a_command_does(
    rng: np.random.Generator,
) -> None:
    """By 8 to 24 % on the flights of the campaign, where what a command does was right to 4 %."""
    flight, start = flown(changed(OCTO, *UNFILTERED), rng, 20.0), changed(OCTO, *UNFILTERED)
    free, held = fitted(flight, start), fitted(flight, start, model.Prior(expo=0.0, idle=0.0))
    turning = [model.SHAPE + axis for axis in (model.ROLL, model.PITCH, model.YAW)]
    assert (free.deviation[turning] > 0.07).all()
    assert (free.deviation[turning] > 1.5 * held.deviation[turning]).all()
    np.testing.assert_allclose(held.command_deviation, held.deviation[turning])
    np.testing.assert_allclose(free.command_deviation, held.command_deviation, rtol=0.25)


def test_a_centre_of_mass_beside_the_middle_is_found(rng: np.random.Generator) -> None:
    # Held level, the motors of the heavy side give more; the autopilot's integrals do that in a real flight.
    true = changed(OCTO, ("mass_kg = 6.0", "mass_kg = 6.0\ncentre_of_mass_m = [0.03, -0.03, 0.0]"), *UNFILTERED)
    found = fitted(flown(true, rng), changed(OCTO, *UNFILTERED))
    centre_m = 0.5 * found.x[model.centre_of(found.layout)]
    deviation_m = 0.5 * found.deviation[model.centre_of(found.layout)]
    np.testing.assert_allclose(centre_m, [0.03, -0.03], atol=0.015)
    assert (np.abs(centre_m - [0.03, -0.03]) < 2.5 * deviation_m).all()


def test_motors_and_centre_of_mass_that_no_owner_has_are_not_believed(rng: np.random.Generator) -> None:
    """Air that turns the vehicle as its outputs grow was taken for motors that lift 0.4 to 1.5 of the others', and the
    file that came out hid failures."""
    vehicle = changed(OCTO, *UNFILTERED)
    unlike = np.array([1.5, 0.45, 1.5, 0.5, 1.4, 0.6, 1.3, 0.75])
    rotors = OCTO.split("\n[[rotor]]")
    text = rotors[0] + "".join(f"\n[[rotor]]{r}\nthrust = {t}\n" for r, t in zip(rotors[1:], unlike, strict=True))
    found = fitted(flown(changed(text, *UNFILTERED), rng), vehicle)
    trim = np.r_[model.motors_of(found.layout), model.centre_of(found.layout)]
    np.testing.assert_array_equal(found.x[trim], 0.0)
    np.testing.assert_allclose(found.deviation[trim], model.Prior().deviations(8)[trim])
    told = {number.key for number in calibrate.numbers(vehicle, found)}
    assert not told & {"airframe.centre_of_mass_m", "rotor.thrust"}


def test_a_trim_that_is_not_believed_bends_no_curve(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Held to motors all alike, only a flat curve explained that their outputs differ: 0.08 for 0.54 on a flight."""
    vehicle = changed(OCTO, *UNFILTERED)
    unlike = np.array([1.25, 0.8, 1.2, 0.75, 1.25, 0.8, 1.2, 0.75])
    rotors = OCTO.split("\n[[rotor]]")
    text = rotors[0] + "".join(f"\n[[rotor]]{r}\nthrust = {t}\n" for r, t in zip(rotors[1:], unlike, strict=True))
    flight = flown(changed(text, *UNFILTERED), rng)
    monkeypatch.setattr(fit, "_NO_VEHICLE", 0.5)
    found = fitted(flight, vehicle)
    assert not found.x[model.motors_of(found.layout)].any()
    monkeypatch.setattr(fit, "_NO_VEHICLE", np.inf)
    beside = fitted(flight, vehicle)
    assert beside.x[model.motors_of(beside.layout)].any()
    curve = [model.EXPO, model.IDLE]
    np.testing.assert_array_equal(found.x[curve], beside.x[curve])
    np.testing.assert_allclose(found.deviation[curve], beside.deviation[curve])
    assert (found.deviation[[model.SHAPE + model.ROLL, model.SHAPE + model.PITCH]] > 0.05).all()


def test_the_derivatives_are_those_of_what_is_foretold(rng: np.random.Generator) -> None:
    layout = model.Layout.of(vehicles.load("hexa-x"))
    free = np.arange(model.SHAPE)
    x = model.start(layout, 0.05, 0.5, 0.1) + 0.02 * rng.standard_normal(layout.parameters)
    thrust = 1.0 + 0.1 * rng.standard_normal((1, 40, layout.motors))
    relative = np.concatenate([thrust] * (1 + len(free)))
    _, slopes = model.foretold(x, layout, relative, free, 0.005)
    for k in range(model.SHAPE, layout.parameters):
        ends: list[NDArray[np.float64]] = []
        for step in (-1e-6, 1e-6):
            moved = x.copy()
            moved[k] += step
            ends.append(model.foretold(moved, layout, relative, free, 0.005)[0])
        np.testing.assert_allclose(slopes[:, :, k], (ends[1] - ends[0]) / 2e-6, atol=1e-6)


def blown(flight: Record, vehicle: Vehicle, rng: np.random.Generator, lead_s: float, share: float) -> Record:
    """The flight with what the motors do to yaw beside their drag: each turns the vehicle as it gathers speed, ahead of
    its drag by ``lead_s``; and it drags sideways, each by its speed, ``share`` of the lateral specific force."""
    pieces = []
    for piece in flight.pieces:
        share_of_lag = 1.0 - np.exp(-piece.dt_s / vehicle.motor.time_constant_up_s)
        asked = vehicle.thrust_fraction(piece.output)
        thrust = lfilter([share_of_lag], [1.0, share_of_lag - 1.0], asked - asked[0], axis=0) + asked[0]
        ahead = 0.5 * (thrust + np.concatenate([thrust[1:], thrust[-1:]]))  # at the sample; ``thrust``: until then
        side = np.cumsum(rng.standard_normal((piece.samples, 2)), axis=0) * 0.05
        speed = np.sqrt(thrust)
        x, y = (speed @ vehicle.position_m / speed.sum(axis=1, keepdims=True)).T
        dragged = share * vehicle.mass_kg / vehicle.inertia_kg_m2[2] * (x * side[:, 1] - y * side[:, 0])
        gyro, force = piece.gyro_rad_s.copy(), piece.specific_force_m_s2.copy()
        gyro[:, 2] += lead_s * ahead @ vehicle.acceleration_effectiveness[model.YAW] + np.cumsum(dragged) * piece.dt_s
        force[:, :2] += side
        pieces.append(replace(piece, gyro_rad_s=gyro, specific_force_m_s2=force))
    return Record(pieces)


def test_yaw_is_found_beside_what_else_the_rotors_do_to_it(rng: np.random.Generator) -> None:
    vehicle = changed(OCTO, *UNFILTERED)
    flight = flown(vehicle, rng, 15.0)
    still = fitted(flight, vehicle)
    found = fitted(blown(flight, vehicle, rng, 0.045, 1.0), vehicle)
    yaw = model.SHAPE + model.YAW
    assert found.x[yaw] == pytest.approx(still.x[yaw], abs=0.02)
    assert found.deviation[yaw] < 2.0 * still.deviation[yaw]
    assert found.x[model.LEAD] == pytest.approx(0.045, abs=0.01)


def test_what_rotors_of_uneven_speed_drag_sideways_is_taken_off_yaw(rng: np.random.Generator) -> None:
    vehicle = changed(OCTO, *UNFILTERED)
    flight, shape = flown(vehicle, rng, 15.0), chain.Motors(0.0, 0.045, 0.045, 0.65, 0.15, 0.95)
    still, moved = (r.pieces[0] for r in (flight, blown(flight, vehicle, rng, 0.0, 1.0)))
    values, before = (chain.measured(piece, FILTERS, inertia(vehicle)) for piece in (moved, still))
    turned = values[:, model.YAW] - before[:, model.YAW]
    thrust = chain.shown(moved, [shape], FILTERS)[0]
    rest = air.taken_off(
        turned, air.columns(values, thrust, model.Layout.of(vehicle), moved.dt_s, climbs=False)[model.YAW]
    )
    assert rest.var() < 0.05 * turned.var()


def test_noise_is_learnt_without_what_the_air_does(rng: np.random.Generator) -> None:
    """With it still in, slow motion counts for little, of which yaw has most: its errors were four times as large."""
    vehicle = changed(OCTO, *UNFILTERED)
    layout = model.Layout.of(vehicle)
    piece = flown(vehicle, rng, 15.0).pieces[0]
    side = np.cumsum(rng.standard_normal(piece.samples)) * 0.05
    force, gyro = piece.specific_force_m_s2.copy(), piece.gyro_rad_s.copy()
    force[:, 1] += side
    gyro[:, 2] += np.cumsum(2.0 * side) * piece.dt_s  # it turns into the wind
    x = model.start(layout, 0.045, 0.65, 0.15)
    slow: list[float] = []
    for each in (piece, replace(piece, gyro_rad_s=gyro, specific_force_m_s2=force)):
        deviations = model.Prior().deviations(layout.motors)
        problem = fit.Problem(Record([each]), layout, FILTERS, inertia(vehicle), x, deviations)
        x = x if slow else problem.suggested(x)
        problem.colour(x)
        slow.append(float(problem._whitening[model.YAW].sum()))  # of the slowest motion, what counts
    assert slow[1] > 0.7 * slow[0]


def with_turning(layout: model.Layout, rows: NDArray[np.float64]) -> model.Layout:
    """The layout with other rows (3, m) of roll, pitch and yaw."""
    return replace(layout, rows=np.vstack([layout.rows[:1], rows]))


@pytest.mark.parametrize("name", vehicles.names())
def test_every_two_motors_swapped_and_every_spin_reversed_are_named(name: str, rng: np.random.Generator) -> None:
    vehicle = vehicles.load(name)
    filters = chain.Filters(vehicle.telemetry.gyro_filter_hz, vehicle.telemetry.accelerometer_filter_hz, SMOOTHING_S)
    motor, command = vehicle.motor, vehicle.command
    shape = chain.Motors(
        0.0,
        motor.time_constant_up_s,
        motor.time_constant_down_s,
        command.thrust_expo,
        command.spin_min,
        command.spin_max,
    )
    layout = model.Layout.of(vehicle)
    found = order.shares(flown(vehicle, rng, 12.0), layout, filters, shape, inertia(vehicle))
    found = replace(found, turned=True)  # no air turns this vehicle, so that its yaw tells though it is small
    wrong = []
    for changed_in_file in order.considered(layout):
        weighed = order.weigh(found, with_turning(layout, changed_in_file.rows))
        if not np.allclose(weighed.best.rows, layout.rows[1:]):
            wrong.append((changed_in_file.text, weighed.best.text))
        named = weighed.best.text
        assert bool(named) == bool(changed_in_file.text)
    assert wrong == []


def test_spins_are_not_judged_of_a_flight_that_never_turned(rng: np.random.Generator) -> None:
    vehicle = changed(OCTO, *UNFILTERED)
    layout = model.Layout.of(vehicle)
    shape = model.shape_of(model.start(layout, 0.045, 0.65, 0.15), layout.full)
    found = order.shares(flown(vehicle, rng, 12.0), layout, FILTERS, shape, inertia(vehicle))
    assert not found.turned
    for each in order.considered(layout):
        assert not order.weigh(found, with_turning(layout, each.rows)).best.reversed


def test_a_number_that_the_flight_does_not_show_keeps_its_deviation_and_what_to_fly_is_said(
    rng: np.random.Generator,
) -> None:
    vehicle = changed(OCTO, *UNFILTERED)
    calm = [
        replace(p, output=np.broadcast_to(p.output.mean(axis=0), p.output.shape).copy())
        for p in flown(vehicle, rng, 20.0).pieces
    ]
    found = fitted(Record(calm), vehicle)
    verdicts = {v.name: v for v in excitation.verdicts(found)}
    assert not verdicts["motor lag"].enough
    assert "left" in verdicts["motor lag"].advice
    assert not verdicts["thrust curve"].enough


def test_the_file_keeps_what_was_not_measured_and_flies_as_the_fit_says(rng: np.random.Generator) -> None:
    start = changed(OCTO, *UNFILTERED)
    found = fitted(flown(start, rng), start)
    text = airframe.written(OCTO, airframe.numbers(start, found), "mine", "calibrated from a test")
    made = Vehicle(msgspec.convert(tomllib.loads(text), AirframeFile))
    assert made.name == "mine"
    assert made.network == ""  # trained with other numbers
    assert made.confirmed == "calibrated from a test"  # it may be acted upon from the first second
    assert made.mass_kg == 6.0
    assert "[aerodynamics]" in text
    assert "calibrated, +-" in text
    at_mean = made.acceleration_effectiveness * made.thrust_fraction(np.array(found.mean_output))
    np.testing.assert_allclose(at_mean, model.accelerations(found.x, found.layout), rtol=2e-3, atol=2e-3)


def test_a_flight_with_a_failure_too_short_ones_and_another_order_are_refused(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    vehicle = vehicles.load("octo-x")
    unfiltered = {"INS_GYRO_FILTER": 0.0, "INS_ACCEL_FILTER": 0.0}
    logs = {
        "failed": Flight(vehicle, seconds=30.0, fail_s=25.0, lost={3: 0.0}).rows(rng),
        "short": Flight(vehicle, seconds=10.0).rows(rng),
        "whole": Flight(vehicle, seconds=60.0).rows(rng),
    }
    monkeypatch.setattr(calibrate, "flights", lambda path: [log_flight(logs[path.name], unfiltered, motors=8)])
    before, one, two, three, *rest = OCTO.replace('network = "octo-x"', "").split("\n[[rotor]]\n")
    swapped = tmp_path / "swapped.toml"
    swapped.write_text("\n[[rotor]]\n".join([before, three, two, one, *rest]), encoding="utf-8")
    for log, file, reason in (
        ("failed", "octo-x", "motor 3 fails|a motor fail in it"),
        ("short", "octo-x", "20 s or more"),
        ("whole", str(swapped), "motors 1, 3 swapped"),
    ):
        with pytest.raises(NotJudged, match=reason):
            calibrate.calibrate([Path(log)], calibrate.Start(airframe=file), "mine")


@pytest.mark.parametrize(
    ("told", "held"),
    [
        ({"MOT_THST_EXPO": 0.65, "MOT_SPIN_MIN": 0.15}, ("thrust_expo", "spin_min")),
        ({"THR_MDL_FAC": 0.65}, ("thrust_expo",)),
    ],
)
def test_a_curve_that_the_autopilot_was_told_is_that_of_the_file(
    told: dict[str, float], held: tuple[str, ...], rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With another one the vehicle's own link would refuse the file, and so would the reader of the log."""
    unfiltered = {"INS_GYRO_FILTER": 0.0, "INS_ACCEL_FILTER": 0.0}
    log = log_flight(Flight(vehicles.load("octo-x"), seconds=26.0).rows(rng), unfiltered | told, motors=8)

    def read(vehicle: Vehicle) -> Reading:
        wrong = [*checks.misfits(told, vehicle), *filter(None, [outputs.contradiction(told, vehicle)])]
        if wrong:
            raise NotJudged("; ".join(wrong))
        return log.read(vehicle)

    monkeypatch.setattr(calibrate, "flights", lambda path: [replace(log, read=read)])
    found = calibrate.calibrate([Path("whole")], calibrate.Start(airframe="octo-x"), "mine")
    command = tomllib.loads(found.text)["command"]
    start = vehicles.load("octo-x").command
    assert [command[key] for key in held] == [getattr(start, key) for key in held]
    assert not {f"command.{key}" for key in held} & {number.key for number in found.numbers}


def test_pieces_with_and_without_velocity_are_calibrated_together(rng: np.random.Generator) -> None:
    vehicle = changed(OCTO, *UNFILTERED)
    (first,), (second,) = (flown(vehicle, rng, 12.0).pieces for _ in range(2))
    moving = replace(second, velocity_m_s=0.1 * rng.standard_normal((second.samples, 3)))
    for pieces in ([first, moving], [moving, first]):
        assert np.isfinite(fitted(Record(pieces), vehicle).x).all()


@pytest.mark.parametrize("beyond_s", [0.03, 0.5, 1.0, 2.9])
def test_no_piece_is_cut_so_short_that_nothing_can_be_made_of_it(beyond_s: float, rng: np.random.Generator) -> None:
    piece = flown(changed(OCTO, *UNFILTERED), rng, 12.0).pieces[0]
    length_s = piece.samples * piece.dt_s
    cut = calibrate._shortened(Record([piece, piece]), length_s + beyond_s)
    assert [p.samples for p in cut.pieces] == [piece.samples]
    cut = calibrate._shortened(Record([piece, piece]), length_s + 3.5)
    assert cut.duration_s == pytest.approx(length_s + 3.5, abs=0.01)
