"""PX4 told by an injected failure: one motor, acknowledged, lifted at the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, from_another, in_flight, octo, talk, tell, without
from px4_told import NEEDS, held, untold

from nff_companion.autopilots.base import Permit
from nff_companion.condition import Reason, Source
from nff_companion.mavlink.codec import dialect

pytestmark = pytest.mark.usefixtures("nothing_ahead")


OK = int(dialect.FAILURE_TYPE_OK)


@pytest.mark.parametrize(("version", "kind"), [(0x011000FF, "OFF"), (0x011100FF, "STUCK")])
def test_injection_means_what_the_version_says_and_changes_no_parameter(
    version: int, kind: str, tmp_path: Path
) -> None:
    model = octo()
    px4 = FakePx4(model, version, changes=NEEDS)
    adapter, now = in_flight(tmp_path, px4, model, "inject")
    assert adapter.condition(now).command is None
    px4.deaf = True
    (command,) = tell(adapter, px4, without(model, (3,)), now)
    assert command.command == dialect.MAV_CMD_INJECT_FAILURE
    assert (command.param1, command.param3) == (dialect.FAILURE_UNIT_SYSTEM_MOTOR, 3.0)
    assert command.param2 == getattr(dialect, f"FAILURE_TYPE_{kind}")
    again = [m for m in adapter.due(now + 0.2, Permit.ACT) if m.get_type() == "COMMAND_LONG"]
    assert [m.param3 for m in again] == [3.0], "unanswered: sent again"
    assert held(adapter.condition(now)) == [], "in force is what was acknowledged"
    px4.deaf = False
    now = talk(adapter, px4, now + 0.2, 0.5)
    assert held(adapter.condition(now)) == [3]
    assert adapter.condition(now).in_force.source == Source.DECLARATION
    assert tell(adapter, px4, without(model, (3, 6)), now) == []
    assert "one injected failure" in untold(adapter.condition(now))[1]
    (lifted,) = tell(adapter, px4, np.ones(8), now)
    assert lifted.param2 == OK
    assert held(adapter.condition(now)) == [3]
    now = talk(adapter, px4, now, 0.5)
    assert held(adapter.condition(now)) == []
    assert px4.sets == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("permit", [Permit.TIDY, Permit.ACT])
def test_an_injected_failure_is_undone_when_the_vehicle_disarms(permit: Permit, tmp_path: Path) -> None:
    px4 = FakePx4(octo(), changes=NEEDS)
    adapter, now = in_flight(tmp_path, px4, octo(), "inject")
    tell(adapter, px4, without(octo(), (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    px4.armed = False
    for message in px4.heartbeat():
        adapter.observe(message, now)
    assert adapter.condition(now).unfinished
    now = talk(adapter, px4, now, 0.2, permit=permit)
    assert px4.injected[-1] == (3, OK)
    assert not adapter.condition(now).unfinished
    assert held(adapter.condition(now)) == []


def test_a_late_acknowledgement_does_not_confirm_the_next_command(tmp_path: Path) -> None:
    px4 = FakePx4(octo(), changes=NEEDS)
    adapter, now = in_flight(tmp_path, px4, octo(), "inject")
    px4.deaf = True
    tell(adapter, px4, without(octo(), (3,)), now)
    now = talk(adapter, px4, now, 0.3)  # sent again and again
    acknowledged = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_INJECT_FAILURE, 0)
    (ack,) = px4.through([acknowledged])
    adapter.observe(ack, now)
    assert held(adapter.condition(now)) == [3]
    tell(adapter, px4, np.ones(8), now)
    adapter.observe(ack, now)  # of a copy of the first
    assert held(adapter.condition(now)) == [3]
    adapter.observe(from_another(acknowledged), now)
    adapter.observe(from_another(acknowledged, 1, 191), now)
    px4.deaf = False
    now = talk(adapter, px4, now, 1.0)
    assert held(adapter.condition(now)) == []


def test_a_refused_injection_is_said_and_not_sent_for_ever(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model, changes=NEEDS)
    px4.injection_result = int(dialect.MAV_RESULT_DENIED)
    adapter, now = in_flight(tmp_path, px4, model, "inject")
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.5)
    assert held(adapter.condition(now)) == []
    assert untold(adapter.condition(now))[0] == Reason.NOT_TOLD
    count = len(px4.injected)
    for _ in range(20):
        tell(adapter, px4, without(model, (3,)), now)
        now = talk(adapter, px4, now, 0.05)
    assert len(px4.injected) == count


@pytest.mark.parametrize(
    ("version", "changes", "reason"),
    [(0x010F00FF, NEEDS, "does not reallocate"), (0x011000FF, {**NEEDS, "CA_FAILURE_MODE": 0.0}, "CA_FAILURE_MODE")],
)
def test_injection_that_would_do_nothing_is_refused_with_a_reason(
    version: int, changes: dict[str, float], reason: str, tmp_path: Path
) -> None:
    px4 = FakePx4(octo(), version, changes=changes)
    adapter, now = in_flight(tmp_path, px4, octo(), "inject")
    command = adapter.condition(now).command
    assert command is not None
    assert command.reason == Reason.CONTRADICTION
    assert reason in command.text
    assert tell(adapter, px4, without(octo(), (3,)), now) == []


def test_a_partial_loss_cannot_be_injected_and_is_said_so(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model, changes=NEEDS)
    adapter, now = in_flight(tmp_path, px4, model, "inject")
    eta = np.ones(8)
    eta[4] = 0.5
    assert tell(adapter, px4, eta, now) == []
    assert untold(adapter.condition(now))[0] == Reason.NOT_TOLD
    assert tell(adapter, px4, np.ones(8), now) == []
    assert adapter.condition(now).untold is None


def test_who_may_only_tidy_sends_no_failure_again_and_who_listens_lifts_none(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model, changes=NEEDS)
    adapter, now = in_flight(tmp_path, px4, model, "inject")
    px4.deaf = True
    tell(adapter, px4, without(model, (3,)), now)
    px4.received.clear()
    now = talk(adapter, px4, now, 0.3, permit=Permit.TIDY)
    px4.armed = False
    now = talk(adapter, px4, now, 0.3, permit=Permit.LISTEN)
    assert "COMMAND_LONG" not in px4.kinds_received()
    px4.deaf = False
    now = talk(adapter, px4, now, 0.3, permit=Permit.TIDY)
    assert px4.injected[-1] == (3, OK)
    assert not adapter.condition(now).unfinished
