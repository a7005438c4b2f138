"""A real client flies the emulated vehicle: MAVSDK connects, arms, takes off, goes, loses a motor, lands."""

from __future__ import annotations

import numpy as np
import pytest
from flying import Flying, wait_for

from nff_companion.core import vehicle
from sitl import airframe
from sitl.autopilot.autopilot import Mode
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.process import free_port

mavsdk = pytest.importorskip("mavsdk", reason="mavsdk is part of the extra sim, which make env installs")


@pytest.mark.realtime
def test_mavsdk_flies_the_emulated_vehicle() -> None:
    from mavsdk.plugins.action import Action
    from mavsdk.plugins.failure.failure import Failure, FailureType, FailureUnit
    from mavsdk.plugins.param import Param
    from mavsdk.plugins.telemetry import Telemetry

    port = free_port()
    fleet = Fleet(airframe.load(vehicle.path_of("octo-x")), FleetOptions(seeds=[1]))
    with (
        Flying(fleet, [f"udpout:127.0.0.1:{port}"]),
        mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)) as client,
    ):
        client.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = client.first_autopilot(10.0)
        assert system is not None
        telemetry, action = Telemetry(system), Action(system)
        wait_for(telemetry.health_all_ok, "the client to call the vehicle healthy")
        assert Param(system).get_param_float("MOT_THST_EXPO") == pytest.approx(0.65)
        action.arm()
        assert telemetry.armed() or bool(fleet.autopilot.armed[0])
        action.set_takeoff_altitude(3.0)
        action.takeoff()
        wait_for(lambda: -fleet.state.position_m[0, 2] > 2.0, "the climb")
        wait_for(telemetry.in_air, "the client to see it in the air")
        home = telemetry.position()
        action.goto_location(home.latitude_deg + 3e-5, home.longitude_deg, home.absolute_altitude_m, float("nan"))
        wait_for(lambda: fleet.state.position_m[0, 0] > 2.0, "the way north")
        Failure(system).inject(FailureUnit.SYSTEM_MOTOR, FailureType.OFF, 2)
        wait_for(lambda: fleet.state.thrust_n[0, 1] < 0.1, "motor 2 to stop")
        action.land()
        wait_for(lambda: not fleet.autopilot.armed[0], "the landing", 60.0)
        assert fleet.autopilot.mode[0] == Mode.GROUND
        assert not fleet.state.crashed[0]
        assert np.abs(fleet.state.position_m[0, 2]) < 0.1
