"""What the sensors of a vehicle that turns and speeds up read, wherever and however they are mounted."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from nff_companion.core import vehicle
from sitl import airframe
from sitl.noise import NormalBlocks, vehicle_generators
from sitl.plant import PlantState, initial_state
from sitl.sensors import Sensors

DT = 1 / 1200
VEHICLES = 60
RATE, TURNING = np.array([0.8, -1.1, 0.6]), np.array([9.0, 4.0, -6.0])
FORCE = np.array([0.4, -0.3, -9.7])


def read(**mounted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean gyro and specific force (3,) of many vehicles that go on turning and speeding up alike."""
    told = airframe.load(vehicle.path_of("octo-x"), vehicles=VEHICLES)
    changed: dict[str, Any] = {name: np.tile(value, (VEHICLES, 1)) for name, value in mounted.items()}
    parameters = dataclasses.replace(told, **changed)
    sensors = Sensors(parameters, DT, vehicle_generators(list(range(VEHICLES)), 2))
    state: PlantState = initial_state(parameters, height_m=10.0)
    state.rate_rad_s[:], state.turning_rad_s2[:] = RATE, TURNING
    state.acceleration_m_s2[:] = FORCE + np.array([0.0, 0.0, airframe.GRAVITY_M_S2])
    for _ in range(2):
        sensors.settle(state, 200)
    return sensors.measured.gyro_rad_s.mean(axis=0), sensors.measured.specific_force_m_s2.mean(axis=0)


def test_an_accelerometer_beside_the_centre_of_mass_feels_the_vehicle_turn() -> None:
    place = np.array([0.04, -0.03, 0.05])
    middle, beside = read(), read(imu_m=place)
    swung = np.cross(TURNING, place) + np.cross(RATE, np.cross(RATE, place))
    np.testing.assert_allclose(beside[1] - middle[1], swung, rtol=1e-6)
    np.testing.assert_array_equal(beside[0], middle[0])


def test_sensors_that_are_not_mounted_straight_read_along_their_own_axes() -> None:
    straight = read()
    gyro, accelerometer = np.radians([2.0, -1.0, 3.0]), np.radians([-1.5, 2.5, 0.5])
    turned = read(gyro_turn_rad=gyro, accelerometer_turn_rad=accelerometer)
    for k, (turn, true) in enumerate(((gyro, RATE), (accelerometer, FORCE))):
        expected = Rotation.from_rotvec(turn).inv().apply(true) - true
        np.testing.assert_allclose(turned[k] - straight[k], expected, rtol=1e-6, atol=1e-9)


def test_more_steps_at_once_than_there_is_noise_for_are_refused() -> None:
    blocks = NormalBlocks(vehicle_generators([1], 2), 3, block=8)
    with pytest.raises(ValueError, match="9 steps are more than the 8"):
        blocks.take(9)


def test_each_vehicle_has_its_own_filters() -> None:
    told = airframe.load(vehicle.path_of("octo-x"), vehicles=2)
    parameters = dataclasses.replace(told, gyro_filter_hz=np.array([20.0, 80.0]))
    sensors = Sensors(parameters, DT, vehicle_generators([1, 1], 2))
    state = initial_state(parameters, height_m=10.0)
    sensors.settle(state, 240)
    before = sensors.measured.gyro_rad_s
    state.rate_rad_s[:] = RATE
    sensors.settle(state, round(0.01 / DT))
    slow, quick = (sensors.measured.gyro_rad_s - before) / RATE
    assert (slow < 0.6).all()
    assert (quick > 0.9).all()
