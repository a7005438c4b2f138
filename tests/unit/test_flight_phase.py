"""When the companion believes that the vehicle flies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from nff_companion.core.flight_phase import FlightPhase, FlightPhaseState
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle


def sample(
    octo: Vehicle,
    time_s: float,
    *,
    height: float | None = None,
    armed: bool = True,
    landed: bool | None = None,
    force: float = 9.81,
    climb: float | None = None,
    tilt_deg: float = 0.0,
) -> Sample:
    return Sample(
        time_s=time_s,
        gyro_rad_s=np.zeros(3),
        specific_force_m_s2=np.array([0.0, 0.0, -force]),
        output=np.full(8, 0.5),
        armed=armed,
        position_m=None if height is None else np.array([0.0, 0.0, -height]),
        landed=landed,
        velocity_m_s=None if climb is None else np.array([0.0, 0.0, -climb]),
        quaternion=np.array([np.cos(half := np.radians(0.5 * tilt_deg)), np.sin(half), 0.0, 0.0]),
    )


def first_flying_s(
    octo: Vehicle, *, start: FlightPhaseState | None = None, until_s: float = 4.0, **what: Any
) -> float | None:
    phase, state = FlightPhase(octo), start or FlightPhaseState()
    thrust = np.full(8, octo.hover)
    for k in range(800):
        state = phase.step(state, sample(octo, 0.005 * k, **what), thrust)
        if state.flying:
            return 0.005 * k
    return None


def test_a_restart_in_flight_is_not_blind_where_the_autopilot_says_that_it_flies(octo: Vehicle) -> None:
    told = first_flying_s(octo, height=30.0, landed=False)
    assert told is not None
    assert told <= 0.25
    untold = first_flying_s(octo, height=30.0)
    assert untold == pytest.approx(2.0, abs=0.02)


def test_a_shock_after_a_restart_high_up_is_no_ground(octo: Vehicle) -> None:
    """Where the ground is is not known: a shock must not make the companion wait for a climb."""
    phase, state, thrust = FlightPhase(octo), FlightPhaseState(), np.full(8, octo.hover)
    for k in range(600):
        state = phase.step(state, sample(octo, 0.005 * k, height=30.0), thrust)
    assert state.flying
    for k in range(600, 606):
        state = phase.step(state, sample(octo, 0.005 * k, height=30.0, force=300.0), thrust)
    assert state.flying
    assert not state.hit


def test_what_hits_the_ground_does_not_fly_until_it_climbs(octo: Vehicle) -> None:
    phase, thrust = FlightPhase(octo), np.full(8, octo.hover)
    state = phase.step(FlightPhaseState(), sample(octo, 0.0, height=0.0, armed=False), thrust)
    for k in range(1, 400):
        state = phase.step(state, sample(octo, 0.005 * k, height=2.0), thrust)
    assert state.flying
    for k in range(400, 404):
        state = phase.step(state, sample(octo, 0.005 * k, height=0.1, force=300.0), thrust)
    assert not state.flying
    for k in range(404, 1400):
        state = phase.step(state, sample(octo, 0.005 * k, height=0.1), thrust)
    assert not state.flying


def test_landing_and_disarming_is_said_once(octo: Vehicle) -> None:
    phase, state, thrust = FlightPhase(octo), FlightPhaseState(), np.full(8, octo.hover)
    for k in range(600):
        state = phase.step(state, sample(octo, 0.005 * k, height=30.0), thrust)
    said = []
    for k in range(600, 603):
        state = phase.step(state, sample(octo, 0.005 * k, height=0.0, armed=False), thrust)
        said.append(state.landed_and_disarmed)
    assert said == [True, False, False]


@pytest.mark.parametrize(
    ("landed", "height", "armed_at", "flies"),
    [
        (False, 10.0, None, True),  # a restart in flight
        (False, 10.0, 0.0, True),
        (None, 10.0, 0.0, True),
        (True, 10.0, None, False),
        (None, 10.0, None, False),  # where the ground is, is not known, and nobody says
        (False, 0.1, 0.0, False),  # as ArduCopter says of a vehicle that stands, once the pilot gives throttle
        (False, 0.1, None, False),
        (False, None, None, False),
    ],
)
def test_a_vehicle_high_up_on_less_thrust_than_its_file_needs_flies_all_the_same(
    octo: Vehicle, landed: bool | None, height: float | None, armed_at: float | None, flies: bool
) -> None:
    """Its file may have thrust curve and idle wrong. On the ground the same thrust is no flight."""
    phase, state, thrust = FlightPhase(octo), FlightPhaseState(ground_m=armed_at), np.full(8, 0.6 * octo.hover)
    for k in range(600):
        state = phase.step(state, sample(octo, 0.005 * k, height=height, landed=landed), thrust)
    assert state.flying == flies


def test_a_vehicle_that_has_landed_on_a_roof_does_not_fly_on_little_thrust(octo: Vehicle) -> None:
    phase, state, time_s = FlightPhase(octo), FlightPhaseState(ground_m=0.0), 0.0
    for share, seconds in ((1.0, 3.0), (0.1, 2.0), (0.6, 4.0)):
        thrust = np.full(8, share * octo.hover)
        for _ in range(round(seconds / 0.005)):
            time_s += 0.005
            state = phase.step(state, sample(octo, time_s, height=5.0, landed=False), thrust)
        assert state.flying == (share == 1.0)


def armed_at_zero(octo: Vehicle) -> FlightPhaseState:
    phase = FlightPhase(octo)
    return phase.step(FlightPhaseState(), sample(octo, -0.01, height=0.0, armed=False), np.zeros(8))


def test_a_level_climb_is_flight_before_it_is_high(octo: Vehicle) -> None:
    start = armed_at_zero(octo)
    began = first_flying_s(octo, start=start, height=0.15, climb=0.6)
    assert began is not None
    assert began <= 0.1
    # The autopilot's own word comes once a second: it may still be of the ground.
    assert first_flying_s(octo, start=start, height=0.15, climb=0.6, landed=True) == began


@pytest.mark.parametrize(
    "what",
    [
        {"height": 0.15, "climb": 0.05},  # set down on something, or a height that drifts
        {"height": 0.03, "climb": 0.6},  # a velocity that is wrong, on the ground
        {"height": 0.1, "climb": 0.6, "tilt_deg": 12.0},  # tips over on a leg
        {"height": 0.3, "climb": 0.6, "tilt_deg": 40.0},  # and further
    ],
    ids=["does not climb", "not off the ground", "begins to tip over", "tips over"],
)
def test_what_stands_or_tips_over_does_not_fly_by_its_climb(octo: Vehicle, what: dict[str, float]) -> None:
    assert first_flying_s(octo, start=armed_at_zero(octo), **what) == pytest.approx(2.0, abs=0.02)  # by its thrust


def test_a_climb_from_unknown_ground_or_after_an_impact_is_not_believed_early(octo: Vehicle) -> None:
    assert first_flying_s(octo, height=0.15, climb=0.6) == pytest.approx(2.0, abs=0.02)
    hit = FlightPhaseState(ground_m=0.0, hit=True)
    assert first_flying_s(octo, start=hit, height=0.15, climb=0.6) is None
