"""The px4 adapter, with the session that ships, against an emulated PX4 that flies what its parameters say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nff_companion.condition import Mode, Source
from nff_companion.core import vehicle
from sitl import airframe
from sitl.autopilot.autopilot import Mode as FlightMode
from sitl.autopilot.px4.personality import Px4Personality
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import Px4Trial, TrialCompanion, TrialOptions, VirtualFlight

AIRFRAME, HEIGHT_M = "px4-octo-x", 1.5
INJECTING = {"SYS_FAILURE_EN": 1, "CA_FAILURE_MODE": 1, "FD_ACT_EN": 1}

pytestmark = pytest.mark.usefixtures("nothing_ahead")


def flight(trial: Px4Trial, modes: list[Mode], faults: list[Fault], thrust_to_weight: float = 1.8) -> VirtualFlight:
    """One vehicle for each of ``modes``, in the same wind."""
    plant = airframe.load(vehicle.path_of(AIRFRAME), vehicles=len(modes), thrust_to_weight=thrust_to_weight)
    options = FleetOptions(seeds=[3] * len(modes), height_m=HEIGHT_M, wind_m_s=2.0, model_error=0.05)
    companions = {index: TrialOptions(mode=mode) for index, mode in enumerate(modes)}
    return VirtualFlight(
        Fleet(plant, options, faults), companions, airframe=AIRFRAME, thrust_to_weight=thrust_to_weight, px4=trial
    )


def on(flown: VirtualFlight, until_s: float) -> None:
    while flown.fleet.time_s < until_s:
        flown.step()


def px4_of(companion: TrialCompanion) -> Px4Personality:
    assert companion.autopilot.px4 is not None
    return companion.autopilot.px4


def values(companion: TrialCompanion) -> dict[str, float]:
    table = px4_of(companion).table
    return {name: table[name] for name in table.names}


def test_a_failed_motor_is_told_by_parameters_which_are_as_before_after_the_landing(tmp_path: Path) -> None:
    faults = [Fault(vehicle=index, motor=3, start_s=1.0) for index in range(2)]
    flown = flight(Px4Trial(state=tmp_path), [Mode.ALLOCATE, Mode.OBSERVE], faults)
    helped, alone = flown.companions
    before = values(helped)
    assert values(alone) == before
    on(flown, 2.5)
    assert [event.motor for _, event in helped.events] == [3]
    assert helped.events[0][0] < 1.15
    assert values(helped) == before | {"CA_ROTOR2_CT": 0.0}
    moment = helped.session.moment()
    assert moment.condition.in_force.source == Source.DECLARATION
    assert moment.condition.in_force.failed is not None
    assert np.flatnonzero(moment.condition.in_force.failed).tolist() == [2]
    assert helped.output.obstacle is None
    # The one flies on; the other has no more than what stock PX4 makes of it.
    height = -flown.fleet.state.position_m[:, 2]
    print(height, np.degrees(flown.fleet.max_tilt_rad))
    assert values(alone) == before
    assert HEIGHT_M - height[0] < 0.3 < HEIGHT_M - height[1]
    assert flown.fleet.autopilot.output[0, 2] == 0.0 < flown.fleet.autopilot.output[1, 2]

    flown.fleet.autopilot.land(0)
    while flown.fleet.autopilot.mode[0] != FlightMode.GROUND:
        flown.step()
        assert flown.fleet.time_s < 7.0
    assert values(helped) != before
    on(flown, flown.fleet.time_s + 1.2)
    assert values(helped) == before
    assert not list(tmp_path.iterdir())


def test_a_failed_motor_is_told_by_injection_and_no_parameter_is_changed(tmp_path: Path) -> None:
    trial = Px4Trial(state=tmp_path, method="inject", parameters=INJECTING)
    flown = flight(trial, [Mode.ALLOCATE], [Fault(vehicle=0, motor=6, start_s=0.7)])
    (companion,) = flown.companions
    before = values(companion)
    on(flown, 1.8)
    assert [event.motor for _, event in companion.events] == [6]
    assert values(companion) == before
    mixer = px4_of(companion).mixer
    assert np.flatnonzero(mixer.removed).tolist() == [5]
    assert HEIGHT_M + flown.fleet.state.position_m[0, 2] < 0.5
    flown.fleet.autopilot.disarm(0)
    on(flown, flown.fleet.time_s + 0.3)
    assert not mixer.stopped.any()
    assert not mixer.removed.any()


@pytest.mark.parametrize(("integration", "comes"), [(200, 200.0), (100, 100.0)])
def test_the_companion_is_built_for_the_samples_that_a_px4_can_send(
    tmp_path: Path, integration: int, comes: float
) -> None:
    flown = flight(Px4Trial(state=tmp_path, parameters={"IMU_INTEG_RATE": integration}), [Mode.ALLOCATE], [])
    (companion,) = flown.companions
    on(flown, 0.6)  # it was started in flight, and watched before it knew
    assert companion.session.companion.rate_hz == comes
    assert companion.output.obstacle is None
