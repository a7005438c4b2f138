"""A whole daemon on a real PX4: flown where the binary is given, else it says that nothing was flown."""

from __future__ import annotations

import os

import pytest

from sitl.trials.fly import px4 as px4_flights


@pytest.mark.realtime
def test_a_real_px4_keeps_its_height_and_gets_its_parameters_back() -> None:
    if not os.environ.get(px4_flights.ENVIRONMENT):
        print(f"{px4_flights.ENVIRONMENT} is not set: no real PX4 was flown")
        return
    options = px4_flights.FlyOptions(binary=px4_flights.binary_from(None), kill_and_land=True)
    flown = px4_flights.run(options, baseline=False)["companion"]
    print(flown)
    assert not flown["crashed"]
    assert flown["height_lost_m"] < 1.0
    assert flown["changed_parameters"] > 0
    assert flown["not_restored"] == []
