"""Whose companion we are: by type, given up and won again, never changed while acting."""

from __future__ import annotations

from pathlib import Path

import pytest
from sessions import autopilot_heartbeat, from_autopilot

from nff_companion.autopilots.adoption import Adoption, is_vehicle
from nff_companion.autopilots.meeting import Choice, Meeting
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect

OF_OURS = from_autopilot(dialect.MAVLink_nff_applied_message(1, *[0] * 12))


def adoption(octo: Vehicle, choice: Choice = "auto", system: int = 0) -> Adoption:
    return Adoption(Meeting(octo, choice, "trim", Path("/nonexistent/j"), plans={}), system)


@pytest.mark.parametrize("choice", ["auto", "px4"])
@pytest.mark.parametrize(
    ("kind", "autopilot"),
    [
        *[(14, 8), (2, 8), (5, 3), (6, 8), (18, 8), (26, 3), (30, 3), (1, 3), (10, 12)],
        *[(7, 3), (8, 0), (9, 0), (16, 3), (17, 0), (28, 12), (42, 3)],
    ],
    ids=[
        *["no autopilot", "no autopilot 2", "tracker", "station", "companion", "gimbal", "camera", "wing", "rover"],
        *["airship", "balloon", "rocket", "flapping", "kite", "parafoil", "winch"],
    ],
)
def test_who_has_no_motors_to_reallocate_is_no_vehicle(
    octo: Vehicle, choice: Choice, kind: int, autopilot: int
) -> None:
    message = autopilot_heartbeat(kind=kind, autopilot=autopilot)
    assert not is_vehicle(message)
    ours = adoption(octo, choice)
    assert not ours.hear(message, 0.0, acting=False)
    assert ours.adapter is None
    assert ours.hear(autopilot_heartbeat(2), 0.1, acting=False), "another one is free to come"
    assert ours.system == 2


def test_nothing_changes_while_acting(octo: Vehicle) -> None:
    """Neither by silence, nor by another vehicle, nor by words of another dialect."""
    ours = adoption(octo)
    ours.hear(autopilot_heartbeat(1), 0.0, acting=False)
    adapter = ours.adapter
    assert adapter is not None
    assert adapter.name == "ardupilot"
    for k in range(10):
        ours.hear(OF_OURS, 0.1 * k, acting=True)
        ours.hear(autopilot_heartbeat(2), 0.1 * k, acting=True)
    ours.tick(20.0, acting=True)
    assert not ours.hear(autopilot_heartbeat(2), 20.0, acting=True)
    assert ours.adapter is adapter
    assert ours.obstacle(acting=True) is None
    ours.tick(20.1, acting=False)
    assert ours.system == 2, "the flight is over, and the first is gone"


@pytest.mark.parametrize("kind", [2, 3, 4, 13, 14, 15, 35])
def test_what_flies_with_rotors_is_a_vehicle(kind: int) -> None:
    assert is_vehicle(autopilot_heartbeat(kind=kind))


def test_a_vehicle_is_ours_through_some_lost_heartbeats_and_no_longer(octo: Vehicle) -> None:
    ours = adoption(octo)
    ours.hear(autopilot_heartbeat(), 10.0, acting=False)
    for now_s in (11.0, 13.0, 14.9):
        ours.tick(now_s, acting=False)
        assert ours.system == 1
    ours.tick(15.1, acting=False)
    assert ours.system is None
