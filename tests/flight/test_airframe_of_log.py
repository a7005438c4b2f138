"""A vehicle made of a log turns, and hovers, as the one that flew."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from flown_logs import Flight, log_flight

from nff_companion.core.airframe_file import AirframeFile, LogTable
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NotJudged
from nff_companion.frames import ardupilot, catalogue
from nff_companion.frames.draft import Size, draft
from nff_companion.replay.airframe_of_log import vehicle_of
from nff_companion.replay.flight import Reading

TYPES = {"FRAME_CLASS": 1.0, "FRAME_TYPE": 1.0}


def flying(
    frame: str, *, arm_m: float = 0.16, agility: float = 1.8, hover: float = 0.3, lag_s: float = 0.03
) -> Vehicle:
    """Of ``agility`` times less inertia than is usual."""
    text = draft(ardupilot.defaults(catalogue.by_name(frame)), Size(0.16), frame, "a test").text
    data = msgspec.convert(tomllib.loads(text), AirframeFile)
    inertia = tuple(value / agility for value in data.airframe.inertia_kg_m2)
    thrust = data.airframe.mass_kg * 9.80665 / (len(data.rotor) * hover)
    return Vehicle(
        msgspec.structs.replace(
            data,
            airframe=msgspec.structs.replace(data.airframe, inertia_kg_m2=inertia),
            motor=msgspec.structs.replace(
                data.motor, max_thrust_n=thrust, time_constant_up_s=lag_s, time_constant_down_s=lag_s
            ),
            telemetry=msgspec.structs.replace(data.telemetry, gyro_filter_hz=0.0, accelerometer_filter_hz=0.0),
        )
    )


UNFILTERED = {"INS_GYRO_FILTER": 0.0, "INS_ACCEL_FILTER": 0.0}


@pytest.mark.parametrize(("frame", "types"), [("quad-x", (1, 1)), ("hexa-x", (2, 1)), ("octo-plus", (3, 0))])
def test_hover_inertia_and_lag_are_those_of_the_flight(
    frame: str, types: tuple[int, int], rng: np.random.Generator
) -> None:
    true = flying(frame)
    parameters = {"FRAME_CLASS": float(types[0]), "FRAME_TYPE": float(types[1]), **UNFILTERED}
    made, how = vehicle_of(log_flight(Flight(true, seconds=80.0, finer=True).rows(rng), parameters))
    assert made.hover == pytest.approx(true.hover, rel=0.03)
    mine, theirs = (v.acceleration_effectiveness * v.hover for v in (made, true))
    assert (np.abs(mine - theirs) <= 0.1 * np.abs(theirs).max(axis=1, keepdims=True)).all()
    assert made.motor.time_constant_up_s == pytest.approx(0.03, abs=0.006)
    assert any(frame in line and "parameters" in line for line in how)


@pytest.mark.parametrize("lag_s", [0.024, 0.04])
def test_gain_and_lag_do_not_depend_on_which_lags_are_tried(lag_s: float, rng: np.random.Generator) -> None:
    """They go together: the nearest lag of a grid leaves gains 16 % off."""
    true, parameters = flying("hexa-x", lag_s=lag_s), {"FRAME_CLASS": 2.0, "FRAME_TYPE": 1.0, **UNFILTERED}
    made, _ = vehicle_of(log_flight(Flight(true, seconds=80.0, finer=True).rows(rng), parameters))
    mine, theirs = (np.abs(v.acceleration_effectiveness[1:]).max(axis=1) * v.hover for v in (made, true))
    assert mine == pytest.approx(theirs, rel=0.1)
    assert made.motor.time_constant_up_s == pytest.approx(lag_s, abs=0.006)


@pytest.mark.parametrize("frame", ["quad-x", "quad-x-clockwise", "quad-plus", "hexa-plus", "hexa-x-clockwise"])
def test_a_frame_that_the_log_does_not_say_is_the_one_that_explains_the_motion(
    frame: str, rng: np.random.Generator
) -> None:
    true = flying(frame)
    made, how = vehicle_of(log_flight(Flight(true).rows(rng), UNFILTERED, motors=true.motors))
    assert made.name == frame
    assert "explains the motion" in how[0]


def test_without_frame_and_motors_it_is_said_what_to_give(rng: np.random.Generator) -> None:
    rows = Flight(flying("quad-x")).rows(rng)
    with pytest.raises(NotJudged, match="does not say which frame: give --frame"):
        vehicle_of(log_flight(rows))
    made, how = vehicle_of(log_flight(rows), "quad-x")
    assert (made.name, made.motors) == ("quad-x", 4)
    assert "as given" in how[0]


def test_a_calm_flight_shows_no_frame_and_none_is_guessed(rng: np.random.Generator) -> None:
    rows = Flight(flying("quad-x"), noise_rad_s=2.0).rows(rng)
    with pytest.raises(NotJudged, match="no frame of 4 motors explains the motion"):
        vehicle_of(log_flight(rows, UNFILTERED, motors=4))


def test_a_frame_that_contradicts_the_log_is_refused(rng: np.random.Generator) -> None:
    rows = Flight(flying("quad-x")).rows(rng)
    with pytest.raises(NotJudged, match="quad-x, and octo-x was given"):
        vehicle_of(log_flight(rows, TYPES), "octo-x")
    with pytest.raises(NotJudged, match="tricopter"):
        vehicle_of(log_flight(rows, {"FRAME_CLASS": 7.0, "FRAME_TYPE": 0.0}))


def test_outputs_at_10_hz_teach_nothing_of_inertia(rng: np.random.Generator) -> None:
    rows = Flight(flying("quad-x")).rows(rng)
    made, how = vehicle_of(log_flight(rows, {**TYPES, **UNFILTERED}, outputs_hz=10.0))
    assert made.hover == pytest.approx(0.3, rel=0.03)
    assert any("guessed" in line for line in how)


def test_thrusts_in_newtons_say_the_mass(rng: np.random.Generator) -> None:
    true = flying("quad-x-clockwise")
    rows = Flight(true).rows(rng)
    forces = [true.thrust_fraction(sample.output) * true.motor.max_thrust_n for _, sample in rows]

    def read(vehicle: Vehicle) -> Reading:
        shares = [np.clip(force / vehicle.motor.max_thrust_n, 0.0, 1.0) for force in forces]
        told = [(stamp, replace(sample, thrust=share)) for (stamp, sample), share in zip(rows, shares, strict=True)]
        return Reading(told, "mine", 200.0)

    flight = replace(log_flight(rows, autopilot="px4"), read=read)
    made, _ = vehicle_of(flight, "quad-x-clockwise", LogTable("mine", "thrust[{}]", "N"))
    assert made.mass_kg == pytest.approx(true.mass_kg, rel=0.03)
    assert made.hover == pytest.approx(0.4, abs=0.01)


def test_samples_that_are_no_numbers_are_left_out(rng: np.random.Generator) -> None:
    rows = Flight(flying("quad-x"), seconds=40.0).rows(rng)
    for k in (900, 1300):
        rows[k][1].gyro_rad_s[:] = np.nan
        rows[k + 50][1].specific_force_m_s2[:] = np.inf
        rows[k + 90][1].output[1] = np.nan
    made, how = vehicle_of(log_flight(rows, {**TYPES, **UNFILTERED}))
    assert made.hover == pytest.approx(0.3, rel=0.03)
    assert any("by how the flight answers its outputs: roll, pitch" in line for line in how)
