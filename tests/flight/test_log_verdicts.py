"""``nff replay`` says what was found, or why nothing could be judged; never "no fault" of what it did not see."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path
from typing import Any

import log_files
import numpy as np
import pytest
from conftest import DATA
from log_files import GOOD_PARAMETERS, Outputs
from typer.testing import CliRunner

from nff_companion.cli.main import app
from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, dialect
from nff_companion.replay.run import read

OCTA = "arducopter-octa-x"
KEYS = {"file", "verdict", "reason", "frame", "duration_s", "judged_s", "refused_samples", "explained", "faults"}
QUAD = """
[airframe]
name = "quadx"
source = "made for a test"
mass_kg = 1.5
inertia_kg_m2 = [0.02, 0.021, 0.036]
[motor]
max_thrust_n = 10.51
time_constant_up_s = 0.04
time_constant_down_s = 0.04
torque_per_thrust_m = 0.016
[command]
thrust_expo = 0.65
spin_min = 0.15
spin_max = 0.95
pwm_min = 1000
pwm_max = 2000
[telemetry]
gyro_filter_hz = 20
accelerometer_filter_hz = 20
""" + "".join(
    f'[[rotor]]\nangle_deg = {angle}\narm_m = 0.225\nspin = "{spin}"\n'
    for angle, spin in ((45, "ccw"), (-135, "ccw"), (-45, "cw"), (135, "cw"))
)


class Said:
    """What the command has said."""

    def __init__(self, *logs: Path | str, airframe: str = OCTA) -> None:
        result = CliRunner().invoke(app, ["replay", *map(str, logs), "--airframe", airframe, "--json"])
        self.code, self.errors = result.exit_code, result.stderr
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        self.flights: list[dict[str, Any]] = json.loads(result.stdout)["flights"]

    @property
    def reason(self) -> str:
        (flight,) = self.flights
        return flight["reason"]

    def motors(self) -> list[int]:
        return [fault["motor"] for flight in self.flights for fault in flight["faults"]]


def names_motor_7(said: Said) -> None:
    assert said.code == 1, said.flights
    (flight,) = said.flights
    assert flight["verdict"] == "fault"
    (fault,) = flight["faults"]
    assert fault["motor"] == 7
    assert 0.0 < fault["time_s"] - log_files.FAIL_S < 0.15
    assert fault["lifted_s"] is None


def not_judged(said: Said, *words: str) -> None:
    assert said.code == 2, said.flights
    (flight,) = said.flights
    assert flight["verdict"] == "not_judged"
    assert flight["faults"] == []
    for word in words:
        assert word in flight["reason"], flight["reason"]
    assert flight["reason"] in " ".join(said.errors.split()), "it is said aloud too"


# -- the document -------------------------------------------------------------------------------------------------


def test_a_flight_in_the_document_has_all_its_keys(tmp_path: Path) -> None:
    said = Said(log_files.tlog(tmp_path / "flight.tlog"))
    names_motor_7(said)
    (flight,) = said.flights
    assert flight.keys() >= KEYS
    assert set(flight["faults"][0]) == {"motor", "time_s", "effectiveness", "confidence", "lifted_s"}
    assert set(flight["explained"]) == {"thrust", "roll", "pitch", "yaw"}
    assert 0.5 < flight["explained"]["pitch"] <= 1.0
    assert 2.0 < flight["judged_s"] < flight["duration_s"]


def test_a_healthy_flight_that_was_judged_has_no_fault() -> None:
    said = Said(DATA / "arducopter.bin")
    assert said.code == 0
    (flight,) = said.flights
    assert flight["verdict"] == "no_fault"
    assert flight["judged_s"] > 20.0


# -- nothing silent -----------------------------------------------------------------------------------------------


def test_a_flight_with_unix_time_is_judged(tmp_path: Path) -> None:
    names_motor_7(Said(log_files.ulog(tmp_path / "unix.ulg", offset_us=1_710_773_350_000_000)))


def test_motors_on_the_second_output_driver_are_found(tmp_path: Path) -> None:
    names_motor_7(Said(log_files.ulog(tmp_path / "second.ulg", Outputs(idle_instance=True))))


@pytest.mark.parametrize(
    ("name", "of_pwm"),
    [
        ("dshot", lambda pwm: (pwm - 1000) * 1.999),
        ("can", lambda pwm: (pwm - 1000) * 8.191),
        ("fraction", lambda pwm: (pwm - 1000) / 1000),
    ],
)
def test_outputs_in_other_units_are_understood(tmp_path: Path, name: str, of_pwm: Any) -> None:
    names_motor_7(Said(log_files.ulog(tmp_path / f"{name}.ulg", Outputs(of_pwm))))


def test_outputs_in_no_known_unit_are_not_judged(tmp_path: Path) -> None:
    strange = Outputs(lambda pwm: (pwm - 1000) * 40.0)
    not_judged(Said(log_files.ulog(tmp_path / "strange.ulg", strange)), "unit")


def test_a_slow_imu_is_not_judged(tmp_path: Path) -> None:
    not_judged(Said(log_files.ulog(tmp_path / "slow.ulg", imu_every=24)), "8 Hz")
    not_judged(Said(log_files.ulog(tmp_path / "slow.ulg", imu_every=15)), "13 Hz")


@pytest.mark.parametrize("topic", ["sensor_combined", "actuator_outputs"])
def test_a_ulog_without_a_topic_is_not_judged(tmp_path: Path, topic: str) -> None:
    not_judged(Said(log_files.ulog(tmp_path / "lacks.ulg", leave_out=(topic,))), topic)


@pytest.mark.parametrize("name", ["SERVO_OUTPUT_RAW", "HEARTBEAT", "HIGHRES_IMU"])
def test_a_tlog_without_a_message_is_not_judged(tmp_path: Path, name: str) -> None:
    path = log_files.tlog(tmp_path / "lacks.tlog", lambda message: message.get_type() != name)
    not_judged(Said(path), name)


@pytest.mark.parametrize("name", ["IMU", "RCOU"])
def test_an_ardupilot_log_without_a_message_is_not_judged(tmp_path: Path, name: str) -> None:
    not_judged(Said(log_files.dataflash(tmp_path / "lacks.bin", leave_out=(name,))), name)


def test_outputs_that_are_never_driven_are_not_judged(tmp_path: Path) -> None:
    not_judged(Said(log_files.ulog(tmp_path / "still.ulg", Outputs(lambda pwm: 1000.0))), "outputs")
    not_judged(Said(log_files.ulog(tmp_path / "zero.ulg", Outputs(lambda pwm: 0.0))), "outputs")


def test_outputs_that_come_too_seldom_are_not_judged(tmp_path: Path) -> None:
    rows = log_files.thinned(log_files.records(), "SERVO_OUTPUT_RAW", 50)  # 4 Hz, as a ground station asks for
    not_judged(Said(log_files.write_tlog(tmp_path / "seldom.tlog", rows)), "SERVO_OUTPUT_RAW", "4 Hz")
    not_judged(Said(log_files.ulog(tmp_path / "seldom.ulg", Outputs(every=50))), "actuator_outputs", "4 Hz")
    not_judged(Said(log_files.dataflash(tmp_path / "seldom.bin", outputs_every=50)), "RCOU", "4 Hz")


def test_a_vehicle_that_is_never_armed_is_not_judged(tmp_path: Path) -> None:
    def disarmed(message: Any) -> bool:
        if message.get_type() == "HEARTBEAT":
            message.base_mode = 81
        return True

    rows = [r for r in log_files.records() if disarmed(r[2])]
    path = log_files.write_tlog(tmp_path / "ground.tlog", log_files.of_system(rows, 1))
    not_judged(Said(path), "armed")


# -- the log's own parameters -------------------------------------------------------------------------------------


@pytest.fixture
def quad(tmp_path: Path) -> str:
    path = tmp_path / "quadx.toml"
    path.write_text(QUAD)
    return str(path)


def test_an_octorotors_log_is_not_taken_for_a_quadrotors(tmp_path: Path, quad: str) -> None:
    not_judged(Said(log_files.dataflash(tmp_path / "octa.bin"), airframe=quad), "FRAME_CLASS is 3", "4 motors")
    not_judged(Said(DATA / "arducopter.bin", airframe=quad), "4 motors")
    not_judged(Said(log_files.tlog(tmp_path / "octa.tlog"), airframe=quad), "motors")


@pytest.mark.parametrize(
    ("name", "value"), [("MOT_THST_EXPO", 0.3), ("MOT_SPIN_MIN", 0.3), ("MOT_PWM_MIN", 1100.0), ("FRAME_CLASS", 2.0)]
)
def test_parameters_that_contradict_the_airframe_are_said(tmp_path: Path, name: str, value: float) -> None:
    path = log_files.dataflash(tmp_path / "other.bin", {**GOOD_PARAMETERS, name: value})
    not_judged(Said(path), name, "airframe")
    parameter = dialect.MAVLink_param_value_message(name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32, 1, 0)
    not_judged(Said(log_files.tlog(tmp_path / "other.tlog", extra=[parameter])), name, "airframe")


def test_a_log_of_another_frame_of_as_many_motors_is_not_judged(tmp_path: Path) -> None:
    """FRAME_TYPE 0 is octa plus; of a class that a script makes, what the applet says was flown before."""
    said = "FRAME_CLASS 3, FRAME_TYPE 0 (octo-plus)"
    applets = {**GOOD_PARAMETERS, "FRAME_CLASS": 17.0, "NFF_FRAME": 300.0}
    for name, values in (("type", {**GOOD_PARAMETERS, "FRAME_TYPE": 0.0}), ("applet", applets)):
        not_judged(Said(log_files.dataflash(tmp_path / f"{name}.bin", values)), said, "motor 1")
    extra = [
        dialect.MAVLink_param_value_message(key.encode(), value, dialect.MAV_PARAM_TYPE_REAL32, 1, 0)
        for key, value in (("FRAME_CLASS", 3.0), ("FRAME_TYPE", 0.0))
    ]
    not_judged(Said(log_files.tlog(tmp_path / "type.tlog", extra=extra)), said, "motor 1")
    names_motor_7(Said(log_files.dataflash(tmp_path / "same.bin", {**applets, "NFF_FRAME": 301.0})))


def test_a_parameter_counts_as_it_was_at_take_off(tmp_path: Path) -> None:
    later = [(4.0, "SERVO5_FUNCTION", 0.0), (4.0, "MOT_THST_EXPO", 0.1)]
    names_motor_7(Said(log_files.dataflash(tmp_path / "relay.bin", changes=later)))


def test_motors_on_other_channels_are_found(tmp_path: Path) -> None:
    channels = (8, 9, 10, 11, 4, 5, 6, 7)
    parameters = {name: value for name, value in GOOD_PARAMETERS.items() if not name.startswith("SERVO")}
    parameters |= {f"SERVO{channel + 1}_FUNCTION": 33.0 + motor for motor, channel in enumerate(channels)}
    names_motor_7(Said(log_files.dataflash(tmp_path / "moved.bin", parameters, channels=channels)))


def test_without_a_range_of_its_own_a_motor_has_the_throttle_sticks(tmp_path: Path) -> None:
    unset = {**GOOD_PARAMETERS, "MOT_PWM_MIN": 0.0, "MOT_PWM_MAX": 0.0}
    names_motor_7(Said(log_files.dataflash(tmp_path / "unset.bin", unset)))
    names_motor_7(Said(log_files.dataflash(tmp_path / "same.bin", {**unset, "RC3_MIN": 999.0, "RC3_MAX": 2000.0})))
    other = {**unset, "RCMAP_THROTTLE": 2.0, "RC2_MIN": 1100.0, "RC2_MAX": 1900.0}
    not_judged(Said(log_files.dataflash(tmp_path / "other.bin", other)), "RC2_MIN is 1100", "airframe")


def test_px4s_parameters_are_looked_at_too(tmp_path: Path) -> None:
    not_judged(Said(log_files.ulog(tmp_path / "count.ulg", parameters={"CA_ROTOR_COUNT": 4})), "CA_ROTOR_COUNT is 4")
    expo = {"THR_MDL_FAC": 0.1}
    not_judged(Said(log_files.ulog(tmp_path / "curve.ulg", parameters=expo)), "THR_MDL_FAC is 0.1")
    width = {f"PWM_MAIN_FUNC{k}": 100 + k for k in range(1, 9)} | {"PWM_MAIN_MIN3": 1100}
    not_judged(Said(log_files.ulog(tmp_path / "width.ulg", parameters=width)), "1100")
    octa = vehicle.load(OCTA)
    rotors: dict[str, float] = {"CA_ROTOR_COUNT": 8}
    for i, k in enumerate((0, 2, 1, 3, 4, 5, 6, 7)):
        place = dict(zip(("PX", "PY"), map(float, octa.position_m[k]), strict=True))
        rest = {"PZ": 0.0, "AX": 0.0, "AY": 0.0, "AZ": -1.0, "CT": 6.5, "KM": 0.05 * float(octa.spin[k])}
        rotors |= {f"CA_ROTOR{i}_{suffix}": value for suffix, value in (place | rest).items()}
    swapped = Said(log_files.ulog(tmp_path / "swapped.ulg", parameters=rotors))
    not_judged(swapped, "motor 2: the airframe file has it at -158 deg, cw", "and its motor 3 there")


def test_px4s_output_functions_say_where_the_motors_are(tmp_path: Path) -> None:
    functions = {f"PWM_AUX_FUNC{k + 5}": 101 + k for k in range(8)}
    functions |= {f"PWM_MAIN_FUNC{k}": 0 for k in range(1, 9)}
    path = log_files.ulog(tmp_path / "aux.ulg", Outputs(first=4, idle_instance=True), parameters=functions)
    names_motor_7(Said(path))


def test_an_ardupilot_log_from_before_the_servo_functions_is_read_or_refused_in_words(tmp_path: Path) -> None:
    old = {"FRAME": 1.0, "MOT_SPIN_ARMED": 70.0}
    not_judged(Said(log_files.dataflash(tmp_path / "old.bin", old, old=True)), "SERVO1_FUNCTION")


def test_a_ulog_with_actuator_motors_is_read_from_there(tmp_path: Path) -> None:
    motors = Outputs(lambda pwm: (pwm - 1000) / 1000, "actuator_motors")
    names_motor_7(Said(log_files.ulog(tmp_path / "motors.ulg", motors)))


def test_rotor_speeds_in_the_log_name_a_motor_as_they_do_in_flight(tmp_path: Path) -> None:
    without = Said(log_files.ulog(tmp_path / "without.ulg")).flights[0]["faults"][0]
    path = log_files.ulog(tmp_path / "with.ulg", escs=True)
    said = Said(path)
    names_motor_7(said)
    assert said.flights[0]["faults"][0]["confidence"] == 1.0
    assert said.flights[0]["faults"][0]["time_s"] <= without["time_s"]
    _, rows = read(path, vehicle.load(OCTA))
    speeds = rows[-1][1].rotor_speed_rad_s
    assert speeds is not None
    assert speeds[6] == 0.0


# -- several vehicles ---------------------------------------------------------------------------------------------


def test_two_vehicles_in_one_tlog_are_two_flights(tmp_path: Path) -> None:
    rows = log_files.records()
    both = [(t, frame) for t, frame, _ in rows] + log_files.of_system(rows, 2, later_s=3.1)
    said = Said(log_files.write_tlog(tmp_path / "two.tlog", sorted(both)))
    assert said.code == 1
    assert [(flight["system"], flight["faults"][0]["motor"]) for flight in said.flights] == [(1, 7), (2, 7)]
    assert [flight["faults"][0]["time_s"] for flight in said.flights] == pytest.approx([6.04, 9.14], abs=0.02)
    assert [flight["refused_samples"] for flight in said.flights] == [0, 0]
    lines = CliRunner().invoke(app, ["replay", str(tmp_path / "two.tlog"), "--airframe", OCTA]).stderr
    assert "system 1" in lines
    assert "system 2" in lines


@pytest.mark.parametrize("kind", [dialect.MAV_TYPE_ANTENNA_TRACKER, dialect.MAV_TYPE_GIMBAL])
def test_a_tracker_in_the_tlog_is_no_vehicle(tmp_path: Path, kind: int) -> None:
    rows = log_files.records()
    codec, first = Codec(2, 1), rows[0][0]
    heartbeat = dialect.MAVLink_heartbeat_message(kind, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 81, 0, 3, 3)
    more = [(first + k + 0.37, codec.pack(heartbeat)) for k in range(8)]
    said = Said(log_files.write_tlog(tmp_path / "tracker.tlog", sorted([(t, f) for t, f, _ in rows] + more)))
    names_motor_7(said)
    assert said.flights[0]["system"] == 1


# -- texts of others, and broken files ----------------------------------------------------------------------------


def test_a_file_name_is_no_markup(tmp_path: Path) -> None:
    gone = CliRunner().invoke(app, ["replay", "none[/x].tlog", "--airframe", OCTA])
    assert gone.exit_code == 2
    assert "none[/x].tlog is not a file" in gone.stderr
    path = log_files.tlog(tmp_path / "[lab] flight.tlog")
    assert "[lab] flight.tlog" in CliRunner().invoke(app, ["replay", str(path), "--airframe", OCTA]).stderr
    h250 = CliRunner().invoke(app, ["replay", str(log_files.ulog(tmp_path / "a.ulg")), "--airframe", "h250"])
    assert h250.exit_code == 2
    assert "set [log] in the airframe file" in " ".join(h250.stderr.split())


def test_a_reader_that_prints_does_not_spoil_the_document(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    head = b"\xa3\x95"

    def described(kind: int, length: int, name: bytes, layout: bytes, columns: bytes) -> bytes:
        return head + b"\x80" + struct.pack("<BB4s16s64s", kind, length, name, layout, columns)

    data = described(128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    data += described(10, 7, b"TEST", b"QB", b"TimeUS,V")  # 9 bytes of fields, 4 of payload
    (tmp_path / "short.bin").write_bytes(data + head + bytes([10]) + bytes(20))
    said = Said(tmp_path / "short.bin")
    assert said.code == 2
    assert capfd.readouterr() == ("", ""), "nor is each byte behind the records told, by compiled code"


@pytest.mark.parametrize("junk", [b"\xff" * 4096, bytes(200_000), b"\xa3\x95\x63" + bytes(4093)])
def test_a_corrupt_log_gives_one_line_and_a_count(
    tmp_path: Path, junk: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    path = log_files.dataflash(tmp_path / "corrupt.bin", junk_at_s=2.0, junk=junk)
    said = Said(path)
    names_motor_7(said)
    assert f"{len(junk)} bytes" in said.errors
    written = said.errors + "".join(capfd.readouterr())  # by compiled code too
    assert len(written.splitlines()) <= 3


@pytest.mark.parametrize("lost", [1, 7, 30, 300])
def test_a_torn_tlog_is_read_up_to_the_tear_and_after_it(tmp_path: Path, lost: int, rng: np.random.Generator) -> None:
    data = log_files.tlog(tmp_path / "whole.tlog").read_bytes()
    at = len(data) // 5
    (tmp_path / "torn.tlog").write_bytes(data[:at] + data[at + lost :])
    names_motor_7(Said(tmp_path / "torn.tlog"))
    (tmp_path / "junk.tlog").write_bytes(data[:at] + rng.bytes(lost) + data[at:])
    names_motor_7(Said(tmp_path / "junk.tlog"))
    (tmp_path / "end.tlog").write_bytes(data[:-lost])
    names_motor_7(Said(tmp_path / "end.tlog"))


# -- the reports themselves ---------------------------------------------------------------------------------------

REPORTS = Path(os.environ.get("NFF_DATA", "/nowhere")) / "reports"
needs_reports = pytest.mark.skipif(not REPORTS.is_dir(), reason="NFF_DATA/reports is not there")


@needs_reports
@pytest.mark.parametrize("name", ["quad_healthy_10hz.bin", "quad_dshot_fast_flight.ulg"])
def test_real_healthy_flights_with_sparse_outputs_declare_nothing(name: str) -> None:
    path = REPORTS / "false_declarations" / name
    said = Said(path, airframe=str(path.with_suffix(".toml")))
    assert said.motors() == []
    not_judged(said, "10 Hz")


@needs_reports
def test_a_quadrotor_that_spins_without_a_rotor_is_not_called_healthy() -> None:
    said = Said(REPORTS / "missed_spinning_rotor" / "rotor1.ulg", airframe="h250")
    if said.code == 1:
        assert said.motors() == [1]
    else:
        not_judged(said, "motors 1 and 3")
