"""Late: the autopilot has made up for the motor, and a matrix must not throw the vehicle the other way."""

from __future__ import annotations

from typing import Literal

import pytest

from sitl.trials.campaign.fly import fly
from sitl.trials.campaign.scenario import Scenario


@pytest.mark.parametrize(
    ("personality", "airframe", "after_s"),
    [("plain", "octo-x", 0.4), ("plain", "octo-x", 1.0), ("ardupilot", "octo-x", 0.8), ("plain", "coax-x8", 4.0)],
)
def test_acting_late_tilts_the_vehicle_no_more_than_it_does_alone(
    personality: Literal["plain", "ardupilot"], airframe: str, after_s: float
) -> None:
    """In 2 m/s it was thrown by up to 44 degrees, where it tilts by 21 alone."""
    scenario = Scenario(
        name="t",
        flights=4,
        airframes=(airframe,),
        manoeuvres=("hover",),
        at_s=(5.0, 5.0),
        act_after_s=(after_s, after_s),
        fly_on_s=after_s + 2.5,
        wind_m_s=(2.0, 2.0),
        personality=personality,
        seed=7,
    )
    for row in fly(scenario, (0, 1, 2, 3)):
        assert row["act_after_s"] == pytest.approx(after_s)
        assert row["named"] == row["motors"], row
        assert row["says"].startswith("reallocated"), row
        assert row["survived"], row
        assert row["tilt_deg"] < row["alone_tilt_deg"] + 2.0, row
