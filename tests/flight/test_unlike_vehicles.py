"""Vehicles of any kind of rotors, and off from their files, fly."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from unlike_rotors import measured_octo, tilted_octo, written

from nff_companion.core import vehicle
from sitl import airframe
from sitl.fleet import Fleet, FleetOptions
from sitl.uncertainty import Uncertainty


@pytest.mark.parametrize("text", [tilted_octo(), measured_octo()], ids=["tilted", "measured"])
@pytest.mark.parametrize("level", [Uncertainty.exact(), Uncertainty.estimated()], ids=["as told", "uncertain"])
def test_such_a_vehicle_flies(tmp_path: Path, text: str, level: Uncertainty) -> None:
    options = FleetOptions(seeds=[1], height_m=10.0, wind_m_s=2.0, model_error=0.05, uncertainty=level)
    fleet = Fleet(airframe.load(written(tmp_path, text)), options)
    for _ in range(1200):
        fleet.step()
    assert not fleet.state.crashed.any()
    assert np.abs(fleet.state.position_m[0] - [0.0, 0.0, -10.0]).max() < 1.5
    assert fleet.max_tilt_rad[0] < 0.3


@pytest.mark.parametrize("level", [Uncertainty.calibrated(), Uncertainty.estimated()], ids=["calibrated", "estimated"])
def test_a_fleet_of_wrong_files_flies(level: Uncertainty) -> None:
    nominal = airframe.load(vehicle.path_of("octo-x"), vehicles=3)
    options = FleetOptions(seeds=[1, 2, 3], height_m=10.0, wind_m_s=3.0, uncertainty=level, model_error=0.1)
    fleet = Fleet(nominal, options)
    for _ in range(1200):
        fleet.step()
    assert not fleet.state.crashed.any()
    assert np.abs(fleet.state.position_m - [0.0, 0.0, -10.0]).max() < 3.0
    assert math.degrees(fleet.max_tilt_rad.max()) < 30.0
