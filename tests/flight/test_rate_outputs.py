"""Motor outputs of ArduPilot logs from the demands of the rate loops, against the firmware's mixer line by line."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ardupilot_motors import HOVER, LOOP_HZ, Array, RateFlight, factors, lively, stabilized
from conftest import DATA

from nff_companion.core import toml_file
from nff_companion.core import vehicle as vehicles
from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NotJudged
from nff_companion.frames import ardupilot, catalogue, draft
from nff_companion.replay import dataflash, rate_outputs
from nff_companion.replay.ardupilot_mixer import mixer_of
from nff_companion.replay.flight import Reading

OCTO = {"FRAME_CLASS": 3.0, "FRAME_TYPE": 1.0}
HEXA = {"FRAME_CLASS": 2.0, "FRAME_TYPE": 1.0}
QUAD = {"FRAME_CLASS": 1.0, "FRAME_TYPE": 1.0}
FRAMES = [(frame.name, *frame.ardupilot[0]) for frame in catalogue.frames().values() if frame.ardupilot]
FAST = "RATE and RCOU"


def read(path: Path, vehicle: Vehicle) -> tuple[Reading, list[str]]:
    (flight,) = dataflash.flights(path)
    reading = flight.read(vehicle)
    return reading, flight.notes


def errors(reading: Reading, flight: RateFlight, after_s: float = 0.01) -> Array:
    """(N,) of the worst motor of each sample from the first record of RCOU on, against what the motors were given;
    between two loops by both."""
    out = []
    for time_s, sample in reading.rows:
        if not after_s <= time_s < flight.seconds - 0.15:
            continue
        loop = np.floor(time_s * LOOP_HZ) / LOOP_HZ
        here, then = (np.array(flight.output(at_s)) for at_s in (loop, loop + 1.0 / LOOP_HZ))
        given = here + (time_s - loop) * LOOP_HZ * (then - here)
        out.append(np.abs(sample.output - given).max())
    return np.array(out)


@pytest.mark.parametrize(("name", "frame_class", "frame_type"), FRAMES)
def test_the_mixer_is_the_firmwares_with_too_little_room_as_well(
    name: str, frame_class: int, frame_type: int, rng: np.random.Generator
) -> None:
    values = {"FRAME_CLASS": float(frame_class), "FRAME_TYPE": float(frame_type), "MOT_YAW_HEADROOM": 150.0}
    frame = catalogue.by_name(name)
    if frame.without or name in ("quad-v", "coax-v8"):
        with pytest.raises(NotJudged, match="is not known"):
            mixer_of(values)
        return
    key = next(
        line.removeprefix("frame ").strip()
        for line in (DATA / "frames_ardupilot.txt").read_text(encoding="utf-8").splitlines()
        if line.startswith(f"frame {frame_class} ") and str(frame_type) in line.split()[2:]
    )
    demand = rng.normal(0.0, 0.5, (300, 4))
    demand[:, 3] = rng.uniform(-0.1, 1.1, 300)
    average = rng.uniform(0.0, 1.0, 300)
    found = mixer_of(values).thrusts(demand, average)
    table = factors(key)
    # A throttle above all there is is cut by the firmware beforehand.
    demand[:, 3] = np.minimum(demand[:, 3], 1.0)
    wanted = [
        stabilized(table, roll, pitch, yaw, throttle, high, 1.0, 0.15)
        for (roll, pitch, yaw, throttle), high in zip(demand.tolist(), average, strict=True)
    ]
    assert found == pytest.approx(np.array(wanted), abs=2e-3 if name == "y6" else 1e-6)  # its places are rounded


def of_frame(name: str) -> Vehicle:
    """What is drafted of a frame alone."""
    text = draft.draft(ardupilot.defaults(catalogue.by_name(name)), draft.Size(0.25), "drafted", "a frame").text
    return Vehicle(toml_file.converted(tomllib.loads(text), AirframeFile, Path("drafted.toml"), "airframe"))


@pytest.mark.parametrize(("frame", "parameters"), [("octo-x", OCTO), ("quad-x", QUAD), ("hexa-x", HEXA)])
def test_outputs_are_those_of_every_loop(
    frame: str, parameters: dict[str, float], tmp_path: Path, rng: np.random.Generator
) -> None:
    vehicle = of_frame(frame)
    key = f"{parameters['FRAME_CLASS']:.0f} {parameters['FRAME_TYPE']:.0f}"
    flight = RateFlight(vehicle=vehicle, table=factors(key), demand=lively(rng), parameters=parameters)
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert notes == []
    assert reading.outputs == FAST
    assert reading.outputs_hz == pytest.approx(LOOP_HZ, rel=0.01)
    assert errors(reading, flight).max() < 2e-3
    flight.leave_out = ("RATE",)
    seldom, notes = read(flight.write(tmp_path / "b.bin"), vehicle)
    assert (seldom.outputs, notes) == ("RCOU", [])
    assert np.median(errors(seldom, flight)) > 5e-3, "a flight that ten records a second do not tell of"


@pytest.mark.parametrize("leave_out", [(), ("MOTB",)])
def test_compensation_of_the_battery_and_of_thin_air_is_made_up_for(
    leave_out: tuple[str, ...], tmp_path: Path, rng: np.random.Generator
) -> None:
    vehicle = vehicles.load("octo-x")

    def voltage(time_s: float) -> float:
        return 0.95 - 0.01 * time_s

    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=lively(rng), parameters=OCTO, voltage=voltage)
    flight.thin_air, flight.leave_out = 1.15, leave_out
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert (reading.outputs, notes) == (FAST, [])
    found = errors(reading, flight, 1.0)
    assert np.median(found) < 5e-3
    assert found.max() < (2e-3 if not leave_out else 2e-2)


def wild(rng: np.random.Generator, throttle: float, climbs: float) -> Callable[[float], Array]:
    """One second of three is flown with more than the motors can give."""
    calm, fast = lively(rng), lively(rng, 1.2)

    def demand(time_s: float) -> Array:
        if time_s % 3.0 >= 1.0:
            return calm(time_s)
        found = fast(time_s)
        found[3] = throttle + climbs * (found[3] - HOVER)
        return found

    return demand


def test_motors_at_their_limits_are_as_the_firmware_limits_them(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=wild(rng, 0.7, 0.2), parameters=OCTO)
    given = np.array([flight.output(k / LOOP_HZ) for k in range(12 * LOOP_HZ)])
    limits = (given < vehicle.command.spin_min + 1e-6) | (given > vehicle.command.spin_max - 1e-6)
    assert limits.any(axis=1).mean() > 0.03
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert (reading.outputs, notes) == (FAST, [])
    assert errors(reading, flight).max() < 2e-3


def test_with_too_little_throttle_to_know_what_was_flown_rcou_counts(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=wild(rng, 0.15, 1.0), parameters=OCTO)
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert (reading.outputs, notes) == (FAST, [])
    flight.leave_out = ("RATE",)
    seldom, _ = read(flight.write(tmp_path / "b.bin"), vehicle)
    right = errors(reading, flight) < 0.02
    alone = [np.allclose(a.output, b.output) for (_, a), (_, b) in zip(reading.rows, seldom.rows, strict=True)]
    assert (right | alone[1 : 1 + len(right)]).all()
    assert right.mean() > 0.7


def another_frame(flight: RateFlight) -> None:
    flight.table = factors("3 0")


def reversed_yaw(flight: RateFlight) -> None:
    flight.table = flight.table * [1.0, 1.0, -1.0]


def by_a_script(flight: RateFlight) -> None:
    flight.parameters = {"FRAME_CLASS": 17.0}


def slewed(flight: RateFlight) -> None:
    flight.parameters = {**OCTO, "MOT_SLEW_UP_TIME": 0.2}


def without_frame(flight: RateFlight) -> None:
    flight.parameters = {}


@pytest.mark.parametrize("size", [0.12, 0.01], ids=["lively", "calm"])
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (another_frame, "not by RATE: it"),
        (reversed_yaw, "not by RATE: it"),
        (by_a_script, "FRAME_CLASS 17 is a mixer of a script"),
        (slewed, "MOT_SLEW_UP_TIME is set"),
        (without_frame, "FRAME_CLASS and FRAME_TYPE are not in the log"),
    ],
)
def test_what_was_mixed_otherwise_is_by_rcou_alone_and_says_why(
    change: Callable[[RateFlight], None], reason: str, size: float, tmp_path: Path, rng: np.random.Generator
) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=lively(rng, size), parameters=OCTO)
    change(flight)
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert reading.outputs == "RCOU"
    assert reading.outputs_hz == pytest.approx(10.0, rel=0.01)
    assert len(notes) == 1
    assert reason in notes[0]


def test_reading_again_says_it_once(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 0"), demand=lively(rng), parameters=OCTO)
    (found,) = dataflash.flights(flight.write(tmp_path / "a.bin"))
    for _ in range(3):
        found.read(vehicle)
    assert len(found.notes) == 1


@pytest.mark.parametrize(("rate_every", "rcou_hz"), [(LOOP_HZ // 10, 10), (1, 50)])
def test_where_rate_tells_no_more_it_is_not_looked_at(
    rate_every: int, rcou_hz: int, tmp_path: Path, rng: np.random.Generator
) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 0"), demand=lively(rng), parameters=OCTO)
    flight.rate_every, flight.rcou_hz = rate_every, rcou_hz
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert (reading.outputs, notes) == ("RCOU", [])
    assert reading.outputs_hz == pytest.approx(rcou_hz, rel=0.01)


def test_on_the_ground_and_where_rate_is_missing_rcou_counts(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=lively(rng), parameters=OCTO)
    flight.idle_s, flight.no_rate_s = 3.0, (6.0, 7.0)
    reading, _ = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert reading.outputs == FAST
    told = {time_s: sample.output for time_s, sample in reading.rows}
    idle = np.array([output for time_s, output in told.items() if 0.2 < time_s < 2.8])
    assert idle == pytest.approx(0.1, abs=2e-3)
    missing = np.array([output for time_s, output in told.items() if 6.1 < time_s < 6.9])
    assert np.isfinite(missing).all()
    flight.leave_out = ("RATE",)
    seldom, _ = read(flight.write(tmp_path / "b.bin"), vehicle)
    alone = np.array([sample.output for time_s, sample in seldom.rows if 6.1 < time_s < 6.9])
    assert missing == pytest.approx(alone, abs=1e-9)


def test_too_little_flight_to_compare_with_says_so(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    flight = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=lively(rng), parameters=OCTO, seconds=1.5)
    reading, notes = read(flight.write(tmp_path / "a.bin"), vehicle)
    assert reading.outputs == "RCOU"
    assert "records of RCOU in flight to compare with" in notes[0]


def test_a_stock_arducopter_mixes_like_that() -> None:
    """Six seconds of a square at speed, 1500 m up, while its battery falls; records of RCOU that were left out."""
    vehicle = vehicles.load("arducopter-octa-x")
    log = dataflash._read(DATA / "arducopter_rate.bin")
    told, motors = log.tables["RCOU"], slice(1, 1 + vehicle.motors)
    outputs = vehicle.output_of_pwm(told[:, motors] + 0.5)
    values = log.parameters.at(np.inf)
    found = rate_outputs.reconstructed(log.tables["RATE"], log.tables["MOTB"], told[::2, 0], outputs[::2], values)
    left_out = told[1::2]
    newest = np.searchsorted(found.time_s, left_out[:, 0], side="right") - 1
    error = np.abs(found.output[newest] - outputs[1::2]).max(axis=1)
    assert found.at(left_out[:-1, 0]).mean() > 0.9
    assert np.percentile(error, 90) < 1e-3, "a pulse is a whole number of microseconds"
    between = np.stack([np.interp(left_out[:, 0], told[::2, 0], column) for column in outputs[::2].T], axis=1)
    assert np.median(np.abs(between - outputs[1::2]).max(axis=1)) > 5e-3


def test_a_record_of_rate_that_lacks_fields_is_passed_over(tmp_path: Path, rng: np.random.Generator) -> None:
    vehicle = vehicles.load("octo-x")
    path = RateFlight(vehicle=vehicle, table=factors("3 1"), demand=lively(rng), parameters=OCTO).write(
        tmp_path / "a.bin"
    )
    path.write_bytes(path.read_bytes().replace(b"TimeUS,ROut,POut,YOut,AOut", b"TimeUS,ROut,POut,YOut,Xxxx"))
    reading, notes = read(path, vehicle)
    assert (reading.outputs, notes) == ("RCOU", [])
