"""Interrupted flights of vehicles that are off from their files.

What was learnt is gone after a gap of the telemetry, or when the companion was killed: until it is learnt again,
nothing else may be declared for it.
"""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.condition import Mode
from nff_companion.core import vehicle as vehicle_model
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight
from sitl.uncertainty import LEVELS

SEEDS = (4, 6)
LOST = (None, 1, 5)  # motor, for each seed
FAIL_S, SILENT_S, BACK_S, END_S = 3.0, 5.0, 5.6, 9.0


def trial(fleet: Fleet) -> VirtualFlight:
    return VirtualFlight(fleet, dict.fromkeys(range(fleet.vehicles), TrialOptions()), airframe="octo-x")


@pytest.mark.parametrize("killed", [False, True])
@pytest.mark.parametrize("level", ["geometry", "estimated"])
def test_after_an_interruption_the_same_motors_are_believed_lost(level: str, killed: bool) -> None:
    flights = [(seed, motor) for seed in SEEDS for motor in LOST]
    faults = [Fault(vehicle=k, motor=m, start_s=FAIL_S) for k, (_, m) in enumerate(flights) if m is not None]
    nominal = plant_airframe.load(vehicle_model.path_of("octo-x"), vehicles=len(flights))
    options = FleetOptions(
        seeds=[seed for seed, _ in flights],
        model_error=0.1,
        wind_m_s=4.0,
        turbulence_m_s=1.0,
        height_m=10.0,
        uncertainty=LEVELS[level](),
    )
    flight = trial(Fleet(nominal, options, faults))
    while flight.fleet.time_s < SILENT_S:
        flight.step()
    while flight.fleet.time_s < BACK_S:
        flight.step()
        for companion in flight.companions:
            companion.down.receive(np.inf)  # lost
    assert all(companion.output.mode == Mode.OBSERVE for companion in flight.companions)
    if killed:
        for old, new in zip(flight.companions, trial(flight.fleet).companions, strict=True):
            old.session = new.session
    while flight.fleet.time_s < END_S:
        flight.step()
    for (seed, motor), companion in zip(flights, flight.companions, strict=True):
        believed = (np.flatnonzero(companion.output.failed) + 1).tolist()
        assert believed == ([] if motor is None else [motor]), (seed, motor, companion.events)
        assert companion.output.mode == Mode.ALLOCATE
    assert not flight.fleet.state.crashed.any()
