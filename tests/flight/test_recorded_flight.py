"""What the companion keeps of its flights for a calibration, in flight."""

from __future__ import annotations

import numpy as np

from nff_companion.calibration.recorder import FlightRecorder
from nff_companion.condition import Mode
from nff_companion.core import vehicle
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight


def test_a_whole_flight_is_kept_until_disarmed_and_one_with_a_failure_is_not() -> None:
    fleet = Fleet(
        plant_airframe.load(vehicle.path_of("octo-x"), vehicles=2),
        FleetOptions(seeds=[1, 2], height_m=10.0, wind_m_s=2.0, turbulence_m_s=0.5),
        [Fault(vehicle=1, motor=3, start_s=2.0)],
    )
    flight = VirtualFlight(fleet, {k: TrialOptions(mode=Mode.OBSERVE) for k in range(2)}, airframe="octo-x")
    recorders = [FlightRecorder(8, 2000), FlightRecorder(8, 2000)]
    for companion, recorder in zip(flight.companions, recorders, strict=True):
        companion.session.recorder = recorder

    def fly(until_s: float) -> None:
        while fleet.time_s < until_s:
            flight.step()

    fly(2.0)
    before = [recorder.samples for recorder in recorders]
    assert min(before) > 50, "of two seconds, the first of which is for the filters"
    fly(2.5)
    assert flight.companions[1].output.failed.any()
    assert [recorder.flights for recorder in recorders] == [0, 0]
    for k in range(2):
        fleet.autopilot.disarm(k)
    fly(3.6)  # the heartbeat says so
    whole, spoilt = recorders
    assert whole.flights == 1
    assert whole.samples >= before[0] + 95
    assert (spoilt.flights, spoilt.samples) == (0, 0)
    time_s, values = whole.taken()
    assert (np.diff(time_s) > 0.0).all()
    assert np.isfinite(values).all(), "with attitude and velocity"
    np.testing.assert_allclose(values[: before[0], 5].mean(), -9.8, atol=0.5)
