"""The plant's air: each effect has the sign and size that physics gives it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import vehicle
from sitl import airframe, records
from sitl.aerodynamics import airframe_drag, hub_moment, stream, thrust_factor

HIGH = 50.0
HOVER_N = 7.35


@pytest.fixture(scope="module")
def parameters() -> airframe.PlantParameters:
    return airframe.load(vehicle.path_of("octo-x"))


def thrust(
    parameters: airframe.PlantParameters, air_m_s: tuple[float, float, float], height_m: float = HIGH
) -> NDArray[np.float64]:
    """(m,) N of rotors that hover in still air."""
    body, rotors = records.bodies(parameters, 1e-3)[0], records.rotors(parameters, 1e-3)
    flow = stream(body, HOVER_N, air_m_s, height_m)
    return HOVER_N * np.array([thrust_factor(body, rotors, 0, i, flow) for i in range(parameters.motors)])


def hub_moments(
    parameters: airframe.PlantParameters, speed: NDArray[np.float64], air_x: float, air_y: float
) -> tuple[float, float]:
    """Roll and pitch of all hubs in the same air."""
    body, rotors = records.bodies(parameters, 1e-3)[0], records.rotors(parameters, 1e-3)[0]
    each = [hub_moment(body, rotor, float(s), air_x, air_y) for rotor, s in zip(rotors, speed, strict=True)]
    roll, pitch = np.sum(each, axis=0)
    return float(roll), float(pitch)


def test_still_air_far_from_the_ground_changes_nothing(parameters: airframe.PlantParameters) -> None:
    np.testing.assert_allclose(thrust(parameters, (0.0, 0.0, 0.0)), HOVER_N)


def test_translational_lift_grows_with_speed_towards_its_limit(parameters: airframe.PlantParameters) -> None:
    front = [thrust(parameters, (v, 0.0, 0.0))[0] / HOVER_N for v in (0.0, 3.0, 6.0, 12.0, 60.0)]
    assert np.all(np.diff(front) > 0)
    assert front[-1] < 1.0 + parameters.translational_lift


def test_rotors_behind_lose_thrust_and_those_ahead_none(parameters: airframe.PlantParameters) -> None:
    forwards, backwards = thrust(parameters, (10.0, 0.0, 0.0)), thrust(parameters, (-10.0, 0.0, 0.0))
    x = parameters.position_m[:, 0]
    assert forwards[x < -0.4].max() < forwards[x > 0.4].min()
    assert backwards[x < -0.4].min() > backwards[x > 0.4].max()


def test_the_wake_sinks_below_the_rear_rotors_when_flying_slowly(parameters: airframe.PlantParameters) -> None:
    def lost(speed: float) -> float:
        found = thrust(parameters, (speed, 0.0, 0.0))
        return float(1.0 - found.min() / found.max())

    assert lost(2.0) < 0.2 * lost(10.0)


def test_climbing_and_a_lowered_nose_lift_the_rear_rotors_out_of_the_wake(parameters: airframe.PlantParameters) -> None:
    def lost(x: float, z: float) -> float:
        found = thrust(parameters, (x, 0.0, z))
        return float(1.0 - found.min() / found.max())

    # The wake sinks through the air at the induced velocity; z points down: climbing, air_z < 0, leaves it below.
    for speed in (5.0, 10.0):
        assert lost(speed, -2.0) < lost(speed, -1.0) < lost(speed, 0.0) < lost(speed, 1.0)
    # 7.5 m/s through the air with the nose 10 degrees down, against as much up (braking).
    c, s = 7.5 * math.cos(math.radians(10)), 7.5 * math.sin(math.radians(10))
    assert lost(c, -s) < 0.6 * lost(c, s)


def test_the_ground_carries_and_the_wind_blows_the_cushion_away(parameters: airframe.PlantParameters) -> None:
    low = [thrust(parameters, (0.0, 0.0, 0.0), height)[0] for height in (0.0, 0.2, 0.6)]
    assert low[0] > low[1] > low[2] >= HOVER_N
    windy = thrust(parameters, (8.0, 0.0, 0.0), 0.0) / thrust(parameters, (8.0, 0.0, 0.0))
    assert 1.0 <= windy[0] < low[0] / HOVER_N


def test_flapping_tilts_away_from_the_wind_and_the_sides_cancel_while_all_turn(
    parameters: airframe.PlantParameters,
) -> None:
    speed = np.full(8, 0.6)
    roll, pitch = hub_moments(parameters, speed, 8.0, 0.0)
    assert pitch > 0.0, "nose up when flying forward"
    assert roll == pytest.approx(0.0, abs=1e-12)
    speed[2] = 0.0
    assert abs(hub_moments(parameters, speed, 8.0, 0.0)[0]) > 1e-3, "a lost rotor leaves its side's moment"
    assert hub_moments(parameters, np.full(8, 0.6), 0.0, 8.0)[0] < 0.0, "flying right tilts to the left"


def test_drag_is_quadratic_and_each_side_has_its_own(parameters: airframe.PlantParameters) -> None:
    body = records.bodies(parameters, 1e-3)[0]
    forward, double, back = (airframe_drag(body, (v, 0.0, 0.0))[0] for v in (5.0, 10.0, -5.0))
    assert double == pytest.approx(4.0 * forward)
    assert forward < 0.0 < back
    assert back / -forward == pytest.approx(0.07 / 0.06)
