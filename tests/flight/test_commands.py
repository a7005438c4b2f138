"""Commands, parameters and goals of a client at the emulated autopilot: what makes no sense is refused and counted."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from desk import Desk

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.autopilot import Mode

NAN, INF = math.nan, math.inf
NUMBERS = (NAN, INF, -INF, 1e30, -1e30, -1.0, 0.0, 1.0, 255.0, 2.0**31, 2.0**33, 0.5)
WHOLE = (0, 1, 255, 2**15 - 1, 2**31 - 1, 2**63)
OK, DENIED, UNSUPPORTED = (
    dialect.MAV_RESULT_ACCEPTED,
    dialect.MAV_RESULT_DENIED,
    dialect.MAV_RESULT_UNSUPPORTED,
)
COMMANDS = (
    dialect.MAV_CMD_COMPONENT_ARM_DISARM,
    dialect.MAV_CMD_NAV_TAKEOFF,
    dialect.MAV_CMD_NAV_LAND,
    dialect.MAV_CMD_DO_SET_MODE,
    dialect.MAV_CMD_DO_REPOSITION,
    dialect.MAV_CMD_DO_CHANGE_SPEED,
    dialect.MAV_CMD_INJECT_FAILURE,
    dialect.MAV_CMD_REQUEST_MESSAGE,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
)


@pytest.fixture
def desk() -> Iterator[Desk]:
    made = Desk()
    yield made
    made.server.close()


IDS = dialect


@pytest.mark.parametrize("bad", [NAN, INF, -INF, 1e30])
@pytest.mark.parametrize(
    ("command", "params"),
    [
        (IDS.MAV_CMD_COMPONENT_ARM_DISARM, lambda bad: (bad,)),
        (IDS.MAV_CMD_DO_SET_MODE, lambda bad: (1.0, bad)),
        (IDS.MAV_CMD_DO_REPOSITION, lambda bad: (0.0, 0.0, 0.0, NAN, bad, 149.165237, 20.0)),
        (IDS.MAV_CMD_DO_REPOSITION, lambda bad: (0.0, 0.0, 0.0, NAN, -35.363262, bad, 20.0)),
        (IDS.MAV_CMD_DO_CHANGE_SPEED, lambda bad: (1.0, bad)),
        (IDS.MAV_CMD_DO_CHANGE_SPEED, lambda bad: (bad, 5.0)),
        (IDS.MAV_CMD_INJECT_FAILURE, lambda bad: (bad, 1.0, 1.0)),
        (IDS.MAV_CMD_INJECT_FAILURE, lambda bad: (101.0, bad, 1.0)),
        (IDS.MAV_CMD_INJECT_FAILURE, lambda bad: (101.0, 1.0, bad)),
        (IDS.MAV_CMD_REQUEST_MESSAGE, lambda bad: (bad,)),
        (IDS.MAV_CMD_SET_MESSAGE_INTERVAL, lambda bad: (bad, 1e4)),
        (IDS.MAV_CMD_SET_MESSAGE_INTERVAL, lambda bad: (float(IDS.MAVLINK_MSG_ID_ATTITUDE), bad)),
    ],
)
def test_a_parameter_that_is_no_number_in_bounds_is_refused_and_changes_nothing(
    desk: Desk, command: int, params: Callable[[float], tuple[float, ...]], bad: float
) -> None:
    position = desk.fleet.autopilot.position
    before = position.goal.copy(), position.speed_xy.copy(), list(desk.fleet.faults.faults)
    assert desk.command_long(command, *params(bad)) in (DENIED, UNSUPPORTED)
    assert desk.server.refused["COMMAND_LONG"] == 1
    assert np.array_equal(position.goal, before[0])
    assert np.array_equal(position.speed_xy, before[1])
    assert desk.fleet.faults.faults == before[2]
    assert desk.fleet.autopilot.mode[0] == Mode.GUIDED
    assert not desk.server._clients[0].every


@pytest.mark.parametrize("bad", [INF, -INF, 1e30, -1e30])
def test_heights_and_headings_out_of_bounds_are_refused(desk: Desk, bad: float) -> None:
    here = (-35.363262, 149.165237)
    goal = desk.fleet.autopilot.position.goal.copy()
    yaw = desk.fleet.autopilot.position.goal_yaw.copy()
    assert desk.command_long(IDS.MAV_CMD_DO_REPOSITION, 0.0, 0.0, 0.0, NAN, *here, bad) == DENIED
    assert desk.command_long(IDS.MAV_CMD_DO_REPOSITION, 0.0, 0.0, 0.0, bad, *here, 20.0) == DENIED
    place = [round(1e7 * v) for v in here]
    assert desk.command_int(IDS.MAV_CMD_DO_REPOSITION, (0.0, 0.0, 0.0, bad), place[0], place[1], 20.0) == DENIED
    assert desk.command_int(IDS.MAV_CMD_DO_REPOSITION, (0.0, 0.0, 0.0, NAN), 2**31 - 1, place[1], 20.0) == DENIED
    assert np.array_equal(desk.fleet.autopilot.position.goal, goal)
    assert np.array_equal(desk.fleet.autopilot.position.goal_yaw, yaw)
    ground = Desk(height_m=0.0)
    assert ground.command_long(IDS.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == OK
    assert ground.command_long(IDS.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, bad) == DENIED
    assert ground.fleet.autopilot.mode[0] == Mode.GROUND
    ground.server.close()


def test_what_mavlink_leaves_open_with_nan_is_kept(desk: Desk) -> None:
    """NaN for yaw and altitude means: as it is."""
    position = desk.fleet.autopilot.position
    yaw, height = float(position.goal_yaw[0]), float(position.goal[0, 2])
    assert desk.command_long(IDS.MAV_CMD_DO_REPOSITION, 0, 0, 0, NAN, -35.3632, 149.165237, NAN) == OK
    assert position.goal[0, 0] == pytest.approx(6.9, abs=0.5)
    assert position.goal[0, 2] == height
    assert position.goal_yaw[0] == yaw
    assert desk.command_long(IDS.MAV_CMD_DO_CHANGE_SPEED, 1.0, -1.0) == OK, "no change"
    assert position.speed_xy[0] == 5.0
    assert desk.command_long(IDS.MAV_CMD_DO_CHANGE_SPEED, 1.0, 3.0) == OK
    assert position.speed_xy[0] == 3.0
    assert not desk.server.refused


@pytest.mark.parametrize(
    "garbage", [b"\xfd\xff", b"\xfd\xff\x00", b"\xfe\xff", b"\xfd\x40\x00\x00\x00\x01\x01\x00\x00\x00ab"]
)
def test_a_strangers_datagram_holds_up_no_command(desk: Desk, garbage: bytes) -> None:
    for _ in range(3):
        desk.disturb(garbage)
        assert desk.command_long(IDS.MAV_CMD_DO_CHANGE_SPEED, 1.0, 3.0) == OK


def test_arming_a_vehicle_that_flies_changes_nothing(desk: Desk) -> None:
    assert desk.command_long(IDS.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == OK
    assert desk.fleet.autopilot.mode[0] == Mode.GUIDED


@pytest.mark.parametrize("bad", [NAN, INF, -INF, 1e30])
def test_goals_out_of_bounds_are_ignored_and_counted(desk: Desk, bad: float) -> None:
    goal = desk.fleet.autopilot.position.goal.copy()
    for axis in range(3):
        place = [1.0, 2.0, -10.0]
        place[axis] = bad
        desk.say(position_target(place))
    assert np.array_equal(desk.fleet.autopilot.position.goal, goal)
    assert desk.server.refused["SET_POSITION_TARGET_LOCAL_NED"] == 3


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_parameters_that_are_no_numbers_are_answered_with_the_value_in_force(desk: Desk, bad: float) -> None:
    (answer,) = desk.say(dialect.MAVLink_param_set_message(1, 1, b"WPNAV_SPEED", bad, 9))
    assert answer.param_value == 500.0
    assert desk.server.refused["PARAM_SET"] == 1


def position_target(place: list[float]) -> Message:
    return dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0, *place, *[0.0] * 8)


def nonsense(rng: np.random.Generator, kind: int) -> Message:
    """One message of every kind that the server handles, its fields drawn from what breaks code."""

    def number(count: int) -> list[float]:
        return [float(NUMBERS[i]) for i in rng.integers(len(NUMBERS), size=count)]

    def whole(bits: int, signed: bool = False) -> int:
        value = int(rng.choice(WHOLE[:-1])) if rng.random() < 0.9 else WHOLE[-1]
        value %= 2**bits
        return value - 2**bits if signed and value >= 2 ** (bits - 1) else value

    command = int(rng.choice([*COMMANDS, whole(16)]))
    sample = int(rng.choice([0, 1_010_000, 2**63]))
    ids = dialect
    makers: list[Callable[[], Message]] = [
        lambda: ids.MAVLink_command_long_message(1, 1, command, 0, *number(7)),
        lambda: ids.MAVLink_command_int_message(
            1, 1, whole(8), command, 0, 0, *number(4), whole(32, True), whole(32, True), *number(1)
        ),
        lambda: ids.MAVLink_set_position_target_local_ned_message(whole(32), 1, 1, whole(8), whole(16), *number(11)),
        lambda: ids.MAVLink_set_mode_message(1, whole(8), whole(32)),
        lambda: ids.MAVLink_param_set_message(
            1, 1, [b"WPNAV_SPEED", b"FRAME_CLASS", b"NOTHING", b"X" * 16][whole(8) % 4], *number(1), whole(8)
        ),
        lambda: ids.MAVLink_param_request_read_message(1, 1, b"WPNAV_SPEED", whole(16, True)),
        lambda: ids.MAVLink_param_request_list_message(1, 1),
        lambda: ids.MAVLink_timesync_message(whole(1), whole(64, True)),
        lambda: ids.MAVLink_mission_request_list_message(1, 1, whole(8)),
        lambda: ids.MAVLink_tunnel_message(1, 1, whole(16), 128, [whole(8)] * 128),
        lambda: ids.MAVLink_nff_allocation_matrix_message(
            sample,
            whole(32),
            whole(16),
            1,
            1,
            int(rng.choice([4, whole(8)])),
            int(rng.choice([8, whole(8)])),
            whole(1),
            (number(48) if rng.random() < 0.5 else [float(rng.choice([0.0, 1.0, 20.0, -20.0]))] * 48),
        ),
        lambda: ids.MAVLink_nff_actuator_override_message(
            sample, whole(32), int(rng.choice([50, whole(16)])), 1, 1, int(rng.choice([8, whole(8)])), number(16)
        ),
        lambda: ids.MAVLink_nff_motor_declaration_message(sample, whole(32), whole(16), 1, 1),
    ]
    return makers[kind % len(makers)]()


KINDS = 13


def test_nonsense_neither_ends_the_server_nor_reaches_the_vehicle(rng: np.random.Generator) -> None:
    desk = Desk()
    for k in range(3000):
        if k % 200 == 0:  # it lands, loses motors and crashes meanwhile, as it was told
            desk.server.close()
            desk = Desk(height_m=10.0 if k % 400 else 0.0)
        message = nonsense(rng, k)
        desk.say(message)
        desk.check_finite(message)
    desk.server.close()


def test_every_command_with_every_number_in_every_place(desk: Desk) -> None:
    """One parameter at a time, the others sensible."""
    sensible = {
        IDS.MAV_CMD_COMPONENT_ARM_DISARM: (1.0,),
        IDS.MAV_CMD_NAV_TAKEOFF: (0, 0, 0, 0, 0, 0, 10.0),
        IDS.MAV_CMD_DO_SET_MODE: (1.0, 4.0),
        IDS.MAV_CMD_DO_REPOSITION: (0, 0, 0, 0, -35.363262, 149.165237, 10.0),
        IDS.MAV_CMD_DO_CHANGE_SPEED: (1.0, 5.0),
        IDS.MAV_CMD_INJECT_FAILURE: (101.0, 0.0, 1.0),
        IDS.MAV_CMD_REQUEST_MESSAGE: (30.0,),
        IDS.MAV_CMD_SET_MESSAGE_INTERVAL: (30.0, 1e4),
    }
    for (command, params), place, value in itertools.product(sensible.items(), range(7), NUMBERS):
        if (command, place, value) == (IDS.MAV_CMD_INJECT_FAILURE, 1, 1.0):
            continue  # it does fail a motor
        values = [*params, *[0.0] * (7 - len(params))]
        values[place] = value
        result = desk.command_long(command, *values)
        assert result in (OK, DENIED, UNSUPPORTED), (command, place, value)
        desk.check_finite((command, place, value))
        desk.fleet.autopilot.position.goal[0] = [0.0, 0.0, -10.0]
    assert not desk.fleet.state.crashed[0]
