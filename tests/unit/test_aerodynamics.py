"""The plant's air: each effect has the sign and size that physics gives it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import vehicle
from sitl import airframe
from sitl.aerodynamics import Aerodynamics

HIGH = np.array([50.0])
HOVER = np.full((1, 8), 7.35)


@pytest.fixture(scope="module")
def parameters() -> airframe.PlantParameters:
    return airframe.load(vehicle.path_of("octo-x"))


def wind(x: float, y: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    return np.array([[x, y, z]])


def test_still_air_far_from_the_ground_changes_nothing(parameters: airframe.PlantParameters) -> None:
    np.testing.assert_allclose(Aerodynamics(parameters).rotor_thrust(HOVER, wind(0), HIGH), HOVER)


def test_translational_lift_grows_with_speed_towards_its_limit(parameters: airframe.PlantParameters) -> None:
    front = [Aerodynamics(parameters).rotor_thrust(HOVER, wind(v), HIGH)[0, 0] / 7.35 for v in (0, 3, 6, 12, 60)]
    assert np.all(np.diff(front) > 0)
    assert front[-1] < 1.0 + parameters.translational_lift


def test_rotors_behind_lose_thrust_and_those_ahead_none(parameters: airframe.PlantParameters) -> None:
    thrust = Aerodynamics(parameters).rotor_thrust(HOVER, wind(10), HIGH)[0]
    x = parameters.position_m[:, 0]
    assert thrust[x < -0.4].max() < thrust[x > 0.4].min()
    backwards = Aerodynamics(parameters).rotor_thrust(HOVER, wind(-10), HIGH)[0]
    assert backwards[x < -0.4].min() > backwards[x > 0.4].max()


def test_the_wake_sinks_below_the_rear_rotors_when_flying_slowly(parameters: airframe.PlantParameters) -> None:
    def lost(speed: float) -> float:
        thrust = Aerodynamics(parameters).rotor_thrust(HOVER, wind(speed), HIGH)[0]
        return float(1.0 - thrust.min() / thrust.max())

    assert lost(2.0) < 0.2 * lost(10.0)


def test_climbing_and_a_lowered_nose_lift_the_rear_rotors_out_of_the_wake(parameters: airframe.PlantParameters) -> None:
    def lost(x: float, z: float) -> float:
        thrust = Aerodynamics(parameters).rotor_thrust(HOVER, wind(x, 0.0, z), HIGH)[0]
        return float(1.0 - thrust.min() / thrust.max())

    # The wake sinks through the air at the induced velocity; z points down: climbing, air_z < 0, leaves it below.
    for speed in (5.0, 10.0):
        assert lost(speed, -2.0) < lost(speed, -1.0) < lost(speed, 0.0) < lost(speed, 1.0)
    # 7.5 m/s through the air with the nose 10 degrees down, against as much up (braking).
    c, s = 7.5 * np.cos(np.radians(10)), 7.5 * np.sin(np.radians(10))
    assert lost(c, -s) < 0.6 * lost(c, s)


def test_the_ground_carries_and_the_wind_blows_the_cushion_away(parameters: airframe.PlantParameters) -> None:
    air = Aerodynamics(parameters)
    low = [air.rotor_thrust(HOVER, wind(0), np.array([h]))[0, 0] for h in (0.0, 0.2, 0.6)]
    assert low[0] > low[1] > low[2] >= 7.35
    windy = air.rotor_thrust(HOVER, wind(8), np.array([0.0])) / air.rotor_thrust(HOVER, wind(8), HIGH)
    assert 1.0 <= windy[0, 0] < low[0] / 7.35


def test_flapping_tilts_away_from_the_wind_and_the_sides_cancel_while_all_turn(
    parameters: airframe.PlantParameters,
) -> None:
    air = Aerodynamics(parameters)
    speed, flow = np.full((1, 8), 0.6), np.full((1, 8), 8.0)
    roll, pitch = air.hub_moment(speed, flow, 0 * flow)
    assert pitch[0] > 0.0, "nose up when flying forward"
    assert roll[0] == pytest.approx(0.0, abs=1e-12)
    speed[0, 2] = 0.0
    assert abs(air.hub_moment(speed, flow, 0 * flow)[0][0]) > 1e-3, "a lost rotor leaves its side's moment"
    roll, _ = air.hub_moment(np.full((1, 8), 0.6), 0 * flow, flow)
    assert roll[0] < 0.0, "flying right tilts to the left"


def test_drag_is_quadratic_and_each_side_has_its_own(parameters: airframe.PlantParameters) -> None:
    air = Aerodynamics(parameters)
    forward, double, back = (air.airframe_drag(wind(v))[0, 0] for v in (5.0, 10.0, -5.0))
    assert double == pytest.approx(4.0 * forward)
    assert forward < 0.0 < back
    assert back / -forward == pytest.approx(0.07 / 0.06)
