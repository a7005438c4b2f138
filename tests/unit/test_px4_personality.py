"""What the emulated PX4 answers: parameters, commands, streams."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from desk import Desk

from nff_companion.core import vehicle
from nff_companion.errors import ConfigError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import decode, encode, name_of
from sitl import airframe
from sitl.autopilot.autopilot import Mode
from sitl.fleet import Fleet, FleetOptions
from sitl.personality import spokesman

REAL, WHOLE = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32
OK, UNSUPPORTED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_UNSUPPORTED
MOTOR, OFF = float(dialect.FAILURE_UNIT_SYSTEM_MOTOR), float(dialect.FAILURE_TYPE_OFF)


@pytest.fixture
def desk() -> Iterator[Desk]:
    made = Desk("px4-octo-x", px4={})
    yield made
    made.server.close()


def put(desk: Desk, name: str, value: float, kind: int = REAL) -> list[Message]:
    sent = encode(value, kind, bytewise=True)
    return desk.say(dialect.MAVLink_param_set_message(1, 1, name.encode(), sent, kind))


def value_of(message: Message) -> float:
    return decode(message.param_value, message.param_type, bytewise=True)


def test_a_parameter_is_written_and_read_back_as_it_is_kept(desk: Desk) -> None:
    (answer,) = put(desk, "CA_ROTOR3_CT", 1.3)
    assert (name_of(answer), value_of(answer)) == ("CA_ROTOR3_CT", float(np.float32(1.3)))
    (answer,) = put(desk, "CA_METHOD", 0, WHOLE)
    assert (answer.param_type, value_of(answer)) == (WHOLE, 0.0)
    (read,) = desk.say(dialect.MAVLink_param_request_read_message(1, 1, b"CA_ROTOR3_CT", -1))
    assert value_of(read) == float(np.float32(1.3))
    (again,) = desk.say(dialect.MAVLink_param_request_read_message(1, 1, b"", read.param_index))
    assert name_of(again) == "CA_ROTOR3_CT"
    assert not desk.server.refused


def test_all_parameters_are_listed_once_with_their_types(desk: Desk) -> None:
    heard = desk.say(dialect.MAVLink_param_request_list_message(1, 1))
    found = {name_of(m): value_of(m) for m in heard}
    assert [m.param_index for m in heard] == list(range(heard[0].param_count))
    assert len(found) == len(heard)
    assert found["CA_ROTOR_COUNT"] == 8.0
    assert found["PWM_MAIN_FUNC8"] == 108.0
    assert found["CA_ROTOR0_KM"] < 0.0 < found["CA_ROTOR2_KM"], "motor 1 turns clockwise"
    assert found["THR_MDL_FAC"] == pytest.approx(0.65)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_answered_with_the_value_in_force(desk: Desk, bad: float) -> None:
    (answer,) = desk.say(dialect.MAVLink_param_set_message(1, 1, b"CA_ROTOR3_CT", bad, REAL))
    assert value_of(answer) == 6.5
    assert desk.server.refused["PARAM_SET"] == 1


def test_a_parameter_of_another_type_is_not_taken(desk: Desk) -> None:
    (answer,) = put(desk, "CA_ROTOR3_CT", 2, WHOLE)
    assert value_of(answer) == 6.5


def test_an_unknown_parameter_is_said_in_a_text_and_never_answered(desk: Desk) -> None:
    (answer,) = put(desk, "CA_ROTOR9_CT", 1.0)
    assert answer.get_type() == "STATUSTEXT"
    assert "CA_ROTOR9_CT" in answer.text
    assert desk.say(dialect.MAVLink_param_request_read_message(1, 1, b"CA_ROTOR9_CT", -1)) == []
    assert desk.say(dialect.MAVLink_param_request_read_message(1, 1, b"", 30_000)) == []


def test_it_says_who_it_is() -> None:
    fleet = Fleet(airframe.load(vehicle.path_of("px4-octo-x")), FleetOptions(seeds=[1]))
    makers = spokesman(fleet, px4={}).telemetry.makers
    heartbeat = makers[dialect.MAVLINK_MSG_ID_HEARTBEAT]()
    assert (heartbeat.autopilot, heartbeat.type) == (dialect.MAV_AUTOPILOT_PX4, dialect.MAV_TYPE_OCTOROTOR)
    assert makers[dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION]().flight_sw_version == 0x011000FF
    assert dialect.MAVLINK_MSG_ID_NFF_APPLIED not in makers


def test_our_dialect_is_dropped_and_a_tunnel_too(desk: Desk) -> None:
    assert desk.say(dialect.MAVLink_nff_motor_declaration_message(1_010_000, 1, 4, 1, 1)) == []
    assert desk.say(dialect.MAVLink_tunnel_message(1, 1, 40_000, 1, [1] * 128)) == []
    assert not desk.fleet.autopilot.ports[0].failed.any()


def test_an_injected_failure_stops_the_output_and_not_the_motor() -> None:
    desk = Desk("px4-octo-x", px4={"SYS_FAILURE_EN": 1})
    assert desk.command_long(dialect.MAV_CMD_INJECT_FAILURE, MOTOR, OFF, 3.0) == OK
    desk.server.cycle()
    assert np.flatnonzero(desk.fleet.autopilot.output[0] == 0.0).tolist() == [2]
    assert desk.fleet.faults.faults == []
    assert desk.command_long(dialect.MAV_CMD_INJECT_FAILURE, MOTOR, OFF, 9.0) == UNSUPPORTED
    assert desk.command_long(dialect.MAV_CMD_INJECT_FAILURE, MOTOR, math.nan, 3.0) == UNSUPPORTED
    assert desk.command_long(dialect.MAV_CMD_INJECT_FAILURE, MOTOR, float(dialect.FAILURE_TYPE_OK), 0.0) == OK
    desk.server.cycle()
    assert desk.fleet.autopilot.output[0].min() > 0.2
    desk.server.close()


def test_without_sys_failure_en_nobody_answers_an_injection(desk: Desk) -> None:
    values = MOTOR, OFF, 3.0, 0.0, 0.0, 0.0, 0.0
    message = dialect.MAVLink_command_long_message(1, 1, dialect.MAV_CMD_INJECT_FAILURE, 0, *values)
    assert desk.say(message) == []
    assert desk.fleet.autopilot.output[0].min() > 0.2


def test_modes_are_main_and_sub_and_acknowledged_also_when_refused() -> None:
    desk = Desk("px4-octo-x", height_m=0.0, px4={})
    makers = desk.server.telemetry.makers
    assert desk.command_long(dialect.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 6.0) == OK
    assert makers[dialect.MAVLINK_MSG_ID_HEARTBEAT]().custom_mode == 4 << 16 | 3 << 24, "it stands: it does not land"
    assert desk.command_long(dialect.MAV_CMD_DO_SET_MODE, 1.0, 4.0, 2.0) == OK
    assert desk.command_long(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == OK
    assert desk.fleet.autopilot.mode[0] == Mode.GUIDED
    assert desk.say(dialect.MAVLink_set_mode_message(1, 1, 4 << 16 | 6 << 24)) == []
    assert desk.fleet.autopilot.mode[0] == Mode.LAND
    assert desk.command_long(dialect.MAV_CMD_DO_SET_MODE, 1.0, math.nan, 6.0) == dialect.MAV_RESULT_DENIED
    desk.server.close()


@pytest.mark.parametrize(
    ("integration", "message_id", "interval_us", "cycles"),
    [
        (200, dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 4000.0, 2),
        (200, dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 5000.0, 2),
        (200, dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 5100.0, 4),
        (100, dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 4000.0, 4),
        (400, dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 2500.0, 1),
        (200, dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 2500.0, 1),
        (200, dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 4000.0, 2),
        (200, dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 20_000.0, 8),
    ],
)
def test_a_stream_comes_no_faster_than_its_topic(
    integration: int, message_id: int, interval_us: float, cycles: int
) -> None:
    fleet = Fleet(airframe.load(vehicle.path_of("px4-octo-x")), FleetOptions(seeds=[1]))
    telemetry = spokesman(fleet, px4={"IMU_INTEG_RATE": integration}).telemetry
    assert telemetry.cycles(message_id, interval_us) == cycles
    for bad in (math.nan, math.inf, -5.0):
        assert telemetry.cycles(message_id, bad) is None


def test_streams_say_what_px4_says(desk: Desk) -> None:
    desk.server.cycle()
    makers = desk.server.telemetry.makers
    servos = makers[dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW]()
    pulses = [getattr(servos, f"servo{k}_raw") for k in range(1, 10)]
    expected = [round(1000.0 + 1000.0 * v) for v in desk.fleet.autopilot.output[0].tolist()]
    assert pulses == [*expected, 0]
    status = makers[dialect.MAVLINK_MSG_ID_ACTUATOR_OUTPUT_STATUS]()
    assert status.active == 0xFF
    assert status.actuator[:8] == pytest.approx(expected, abs=0.51)
    before = desk.server.px4
    assert before is not None
    before.step()
    sample = desk.fleet.sensors.measured.gyro_rad_s[0].copy()
    desk.fleet.step()
    imu = makers[dialect.MAVLINK_MSG_ID_HIGHRES_IMU]()
    mean = 0.5 * (sample + desk.fleet.sensors.measured.gyro_rad_s[0])
    assert [imu.xgyro, imu.ygyro, imu.zgyro] == pytest.approx(mean.tolist(), abs=1e-6), "integrated over 5 ms"
    desk.fleet.autopilot.disarm(0)
    desk.server.cycle()
    assert makers[dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW]().servo1_raw == 900


def test_an_airframe_whose_outputs_px4_does_not_drive_is_refused() -> None:
    fleet = Fleet(airframe.load(vehicle.path_of("octo-x")), FleetOptions(seeds=[1]))
    with pytest.raises(ConfigError, match=r"spin_min 0 .* not 0\.15 and 0\.95"):
        spokesman(fleet, px4={})
