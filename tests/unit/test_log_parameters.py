"""Parameters of a log hold from when they were written."""

from __future__ import annotations

import pytest

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
