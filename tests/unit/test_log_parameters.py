"""Parameters of a log hold from when they were written."""

from __future__ import annotations

import pytest

from nff_companion.errors import NotJudged
from nff_companion.replay import ardupilot
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
