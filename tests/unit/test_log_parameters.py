"""Parameters of a log hold from when they were written."""

from __future__ import annotations

from pathlib import Path

import pytest
from log_files import write_tlog

from nff_companion.errors import NotJudged
from nff_companion.mavlink.codec import Codec, dialect
from nff_companion.mavlink.services.parameter_reader import encode
from nff_companion.replay import ardupilot, tlog
from nff_companion.replay.parameters import Parameters


@pytest.mark.parametrize(("at_s", "value"), [(0.0, 1.0), (5.0, 1.0), (10.0, 2.0), (12.0, 2.0), (20.0, 3.0), (1e9, 3.0)])
def test_a_value_holds_until_the_next_one(at_s: float, value: float) -> None:
    parameters = Parameters()
    for time_s, written in ((5.0, 1.0), (10.0, 2.0), (20.0, 3.0)):
        parameters.put(time_s, "MOT_THST_EXPO", written)
    assert parameters.at(at_s) == {"MOT_THST_EXPO": value}


def test_what_was_never_written_is_not_there() -> None:
    parameters = Parameters()
    assert parameters.at(1.0) == {}
    assert len(parameters) == 0


def test_a_parameter_that_is_no_number_does_not_count() -> None:
    found = Parameters()
    for value in (3.0, float("nan"), float("inf"), -float("inf")):
        found.put(0.0, "FRAME_CLASS", value)
    assert found.at(9.0) == {"FRAME_CLASS": 3.0}


def test_outputs_of_some_motors_alone_are_no_order() -> None:
    some = {f"SERVO{k}_FUNCTION": 37.0 - k for k in range(1, 5)}  # motors 4, 3, 2, 1 on outputs 1 to 4
    with pytest.raises(NotJudged, match="motor 1 is on output 4"):
        ardupilot.channels(some, 8, 16)
    in_order = {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)}
    assert ardupilot.channels(in_order, 8, 16) is None


@pytest.mark.parametrize("first", ["heartbeat", "parameter"])
def test_a_telemetry_log_may_begin_before_the_heartbeat_that_says_how_integers_are_written(
    tmp_path: Path, first: str
) -> None:
    codec, kind = Codec(1, 1), dialect.MAV_PARAM_TYPE_INT32
    count = encode(6.0, kind, bytewise=True)
    messages = [
        dialect.MAVLink_heartbeat_message(13, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3),
        dialect.MAVLink_param_value_message(b"CA_ROTOR_COUNT", count, kind, 1, 0),
    ]
    if first == "parameter":
        messages.reverse()
    rows = [(1000.0 + k, codec.pack(message)) for k, message in enumerate(messages)]
    (flight,) = tlog.flights(write_tlog(tmp_path / "flight.tlog", rows))
    assert flight.parameters.at(2000.0) == {"CA_ROTOR_COUNT": 6.0}
