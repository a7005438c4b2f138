"""The ArduPilot adapter: what it says of the applet, what it sends by itself, and how commands are told."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sessions import companion_heartbeat, from_autopilot

from nff_companion.allocation import allocator, tables
from nff_companion.allocation.plan import Plan
from nff_companion.autopilots import schedule, times
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.autopilots.ardupilot.tunnel import Flag, Kind, TunnelMessage
from nff_companion.autopilots.base import Permit
from nff_companion.autopilots.meeting import Meeting
from nff_companion.autopilots.schedule import Command, Declare, Drive, Load, Release
from nff_companion.companion import Companion
from nff_companion.condition import Condition, Mode, Reason, Source
from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session, SessionOptions
from sitl import airframe
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight, Workshop
from sitl.trials.wire import WireAutopilot

INSTANCE = 4711
_FAULT_S = 6.0
OCTO = vehicle.load("octo-x")


@pytest.fixture(scope="module")
def plans() -> dict[int, Plan]:
    return tables.compute(OCTO, allocator("trim"))


def applied(plans: dict[int, Plan], **change: int) -> dict[str, int]:
    """What a healthy applet with the card of octo-x says."""
    packed = {mask: tunnel.table_bytes(table) for mask, table in factors.of_plans(OCTO, plans).items()}
    values = dict.fromkeys(tunnel._LAYOUTS[Kind.APPLIED][1], 0)
    values |= {"sequence": 1, "time_ms": 20_000, "boot_ms": 1000, "owner": INSTANCE, "motors": 8, "tables": len(packed)}
    values |= {"stock_check": tunnel.check(packed[0]), "tables_check": tunnel.tables_check(packed)}
    values["flags"] = Flag.MATRIX | Flag.WATCHDOG | Flag.LINK | Flag.CHECKED
    return values | change


def wrapped(values: dict[str, int], kind: Kind = Kind.APPLIED) -> Message:
    return tunnel.wrap(TunnelMessage(kind, values).pack(), (1, 191), tunnel.TO_COMPANION)


def heartbeat(*, armed: bool, mode: int = 4) -> Message:
    base = dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return dialect.MAVLink_heartbeat_message(14, 3, base, mode, 4, 3)


GOOD = {f"SERVO{i}_FUNCTION": 32.0 + i for i in range(1, 9)}
GOOD |= {"FRAME_CLASS": 17.0, "FRAME_TYPE": 1.0, "NFF_FRAME": 301.0}
GOOD |= {"MOT_THST_EXPO": 0.65, "MOT_SPIN_MIN": 0.15, "MOT_SPIN_MAX": 0.95}
GOOD |= {"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0, "SCR_ENABLE": 1.0, "FLIGHT_OPTIONS": 1.0}
GOOD |= {"INS_GYRO_FILTER": 20.0, "INS_ACCEL_FILTER": 10.0}


def told(adapter: ArduPilotAdapter, name: str, value: float, now_s: float = 0.0) -> None:
    adapter.observe(dialect.MAVLink_param_value_message(name.encode(), value, 9, 100, 0), now_s)


@pytest.fixture
def ready(plans: dict[int, Plan]) -> ArduPilotAdapter:
    """On the ground at 10 s of our clock, everything in place."""
    adapter = ArduPilotAdapter(OCTO, (1, 1), plans, INSTANCE)
    adapter.observe(heartbeat(armed=False), 5.0)
    for name, value in GOOD.items():
        told(adapter, name, value, 5.0)
    adapter.observe(wrapped(applied(plans)), 10.0)
    assert adapter.condition(10.0).command is None
    assert all(finding.ok is not False for finding in adapter.findings())
    return adapter


def reason(condition: Condition) -> Reason | None:
    return None if condition.command is None else condition.command.reason


def inner(message: Message) -> TunnelMessage:
    found = tunnel.unwrap(message, tunnel.TO_AUTOPILOT)
    assert found is not None
    return found


def found(adapter: ArduPilotAdapter) -> dict[str, bool | None]:
    return {finding.name: finding.ok for finding in adapter.findings()}


# -- what it says of the applet ---------------------------------------------------------------------------------------


def test_where_the_motors_have_no_range_that_of_the_throttle_is_asked_for_and_counts(ready: ArduPilotAdapter) -> None:
    told(ready, "MOT_PWM_MIN", 0.0, 10.0)
    asked = [m.param_id for m in ready.due(10.3, Permit.LISTEN) if m.get_type() == "PARAM_REQUEST_READ"]
    assert asked == ["RCMAP_THROTTLE"]
    assert reason(ready.condition(10.3)) == Reason.READING
    told(ready, "RCMAP_THROTTLE", 3.0, 10.4)
    told(ready, "RC3_MIN", 1100.0, 10.4)
    told(ready, "RC3_MAX", 2000.0, 10.4)
    assert reason(ready.condition(10.5)) == Reason.CONTRADICTION
    told(ready, "RC3_MIN", 1003.0, 10.6)
    assert reason(ready.condition(10.6)) != Reason.CONTRADICTION


def test_a_silent_applet_stops_every_command_at_once_and_is_told_to_the_pilot_later(plans: dict[int, Plan]) -> None:
    adapter = ArduPilotAdapter(OCTO, (1, 1), plans, INSTANCE)
    adapter.observe(heartbeat(armed=False), 5.0)
    for name, value in GOOD.items():
        told(adapter, name, value, 5.0)
    assert reason(adapter.condition(5.0)) == Reason.SILENT
    assert adapter.condition(5.0 + times.GROUND_PATIENCE_S - 0.1).notes == ()
    later = adapter.condition(5.0 + times.GROUND_PATIENCE_S + 0.1)
    assert [note.text for note in later.notes] == ["the applet does not answer: observing"]
    assert found(adapter)["applet"] is False


def test_the_age_of_its_word_is_of_our_clock(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    assert ready.condition(10.9).command is None
    silent = ready.condition(10.1 + times.ANSWER_MAX_S)
    assert reason(silent) == Reason.SILENT
    assert silent.in_force.failed is None, "what is in force is not known"
    ready.observe(wrapped(applied(plans, sequence=2, time_ms=20_050)), 12.0)
    assert ready.condition(12.1).command is None


def test_an_applet_of_another_release_is_named(plans: dict[int, Plan], ready: ArduPilotAdapter) -> None:
    body = b"\x01" + TunnelMessage(Kind.APPLIED, applied(plans)).pack()[1:-3]
    old = body + tunnel.check(body).to_bytes(2, "little") + b"\xa5"
    ready.observe(tunnel.wrap(old, (1, 191), tunnel.TO_COMPANION), 10.1)
    assert ready.condition(10.1).command is None, "one that is understood was heard a moment ago"
    ready.observe(tunnel.wrap(old, (1, 191), tunnel.TO_COMPANION), 12.0)
    condition = ready.condition(12.1)
    assert reason(condition) == Reason.UNREADABLE
    assert "install the applet of this release" in condition.notes[0].text
    assert found(ready)["applet"] is False
    assert reason(ready.condition(14.0)) == Reason.SILENT


@pytest.mark.parametrize(
    ("change", "expected", "finding"),
    [
        ({"motors": 6}, Reason.APPLET_MOTORS, "motors"),
        ({"stock_check": 77}, Reason.CARD_DIFFERS, "card"),
        ({"owner": 99}, Reason.TWIN, "companion"),
    ],
)
def test_an_applet_for_somebody_else_is_not_commanded(
    ready: ArduPilotAdapter, plans: dict[int, Plan], change: dict[str, int], expected: Reason, finding: str
) -> None:
    ready.observe(wrapped(applied(plans, sequence=2, **change)), 10.1)
    condition = ready.condition(10.1)
    assert reason(condition) == expected
    assert condition.command in condition.notes
    assert found(ready)[finding] is False
    ready.observe(wrapped(applied(plans, sequence=3)), 10.2)
    assert ready.condition(10.2).command is None
    assert found(ready).get(finding, True) is True


def test_an_applet_that_obeys_nobody_is_no_twin(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    ready.observe(wrapped(applied(plans, sequence=2, owner=0)), 10.1)
    assert ready.condition(10.1).command is None


def test_parameters_stand_in_the_way_until_they_are_read_and_agree(plans: dict[int, Plan]) -> None:
    adapter = ArduPilotAdapter(OCTO, (1, 1), plans, INSTANCE)
    adapter.observe(heartbeat(armed=False), 9.0)
    adapter.observe(wrapped(applied(plans)), 10.0)
    reading = adapter.condition(10.0)
    assert reason(reading) == Reason.READING
    assert reading.notes == ()
    assert reading.telemetry is None
    for name, value in GOOD.items():
        told(adapter, name, value)
    assert adapter.condition(10.1).command is None
    telemetry = adapter.condition(10.1).telemetry
    assert telemetry is not None
    assert (telemetry.gyro_filter_hz, telemetry.accelerometer_filter_hz) == (20.0, 10.0)
    told(adapter, "SERVO3_FUNCTION", 36.0)
    wrong = adapter.condition(10.2)
    assert reason(wrong) == Reason.CONTRADICTION
    assert wrong.command in wrong.notes
    told(adapter, "SERVO3_FUNCTION", 35.0)
    assert adapter.condition(10.3).command is None


def test_a_parameter_that_is_never_answered_is_named(plans: dict[int, Plan]) -> None:
    adapter = ArduPilotAdapter(OCTO, (1, 1), plans, INSTANCE)
    for name, value in GOOD.items():
        if name != "MOT_THST_EXPO":
            told(adapter, name, value)
    for k in range(40):
        adapter.due(0.1 * k, Permit.LISTEN)
    adapter.observe(wrapped(applied(plans)), 4.0)
    condition = adapter.condition(4.0)
    assert reason(condition) == Reason.PARAMETER_SILENT
    assert condition.command is not None
    assert "MOT_THST_EXPO" in condition.command.text


def test_armed_is_the_autopilots_word(plans: dict[int, Plan]) -> None:
    adapter = ArduPilotAdapter(OCTO, (1, 1), plans, INSTANCE)
    assert adapter.condition(0.0).armed is None
    for armed in (False, True, False):
        adapter.observe(heartbeat(armed=armed), 1.0)
        assert adapter.condition(1.0).armed is armed


def test_override_is_kept_to_the_mode_that_it_follows(ready: ArduPilotAdapter) -> None:
    for mode, free in ((4, True), (5, False), (9, False)):
        ready.observe(heartbeat(armed=True, mode=mode), 10.0)
        drive = ready.condition(10.0).drive
        assert (drive is None) == free
    assert drive is not None
    assert "GUIDED" in drive.text


def test_without_the_scripted_frame_no_matrix_is_taken(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    assert ready.condition(10.0).takes_matrix
    ready.observe(wrapped(applied(plans, sequence=2, flags=Flag.WATCHDOG | Flag.CHECKED)), 10.1)
    condition = ready.condition(10.1)
    assert not condition.takes_matrix
    assert condition.command is None
    assert condition.allocate is not None
    assert condition.allocate.reason == Reason.NO_MATRIX_TAKEN


def test_a_silent_watchdog_is_a_note_once_it_had_time_to_start(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    flags = Flag.MATRIX | Flag.CHECKED
    ready.observe(wrapped(applied(plans, sequence=2, boot_ms=19_500, flags=flags)), 10.1)
    assert ready.condition(10.1).notes == ()
    ready.observe(wrapped(applied(plans, sequence=3, flags=flags)), 10.2)
    condition = ready.condition(10.2)
    assert [note.reason for note in condition.notes] == [Reason.WATCHDOG_SILENT]
    assert condition.command is None


def test_what_is_in_force_is_the_applets_word_and_nobody_can_change_it(
    ready: ArduPilotAdapter, plans: dict[int, Plan]
) -> None:
    ready.observe(wrapped(applied(plans, sequence=2, failed=0b101, source=2, stale=3)), 10.1)
    force = ready.condition(10.1).in_force
    assert force.source == Source.MATRIX
    assert force.failed is not None
    assert np.flatnonzero(force.failed).tolist() == [0, 2]
    assert force.refused["stale"] == 3
    with pytest.raises(ValueError, match="read-only"):
        force.failed[0] = False
    ready.observe(wrapped(applied(plans, sequence=1, boot_ms=20_100, time_ms=20_200)), 10.2)
    force = ready.condition(10.2).in_force
    assert force.failed is not None
    assert not force.failed.any(), "it was started anew, and knows nothing"


def test_its_older_word_does_not_replace_a_newer_one(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    ready.observe(wrapped(applied(plans, sequence=3, failed=1)), 10.1)
    ready.observe(wrapped(applied(plans, sequence=2, failed=0)), 10.12)
    assert ready.condition(10.12).in_force.holds(np.eye(8, dtype=bool)[0])


def test_whether_yaw_is_given_up_is_known_of_matrix_and_table(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    without = next(mask for mask, plan in plans.items() if plan.released)
    flags = applied(plans)["flags"]
    cases = [
        ({"source": 2, "failed": without, "flags": flags | Flag.YAW_RELEASED}, True),
        ({"source": 2, "failed": without, "flags": flags}, False),
        ({"source": 1, "failed": without}, True),
        ({"source": 1, "failed": 1}, False),
        ({"source": 1, "failed": without, "flags": flags & ~Flag.MATRIX}, False),
        ({"source": 0}, False),
    ]
    for k, (change, released) in enumerate(cases):
        ready.observe(wrapped(applied(plans, sequence=2 + k, **change)), 10.1)
        assert ready.condition(10.1).in_force.yaw_released == released, change


def test_the_condition_costs_nothing_while_nothing_changes(
    ready: ArduPilotAdapter, plans: dict[int, Plan], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Counter[str] = Counter()
    original = checks.contradictions

    def counted(*arguments: Any) -> list[str]:
        calls["contradictions"] += 1
        return original(*arguments)

    monkeypatch.setattr(checks, "contradictions", counted)
    condition = ready.condition(10.0)
    for k in range(100):
        ready.observe(dialect.MAVLink_extended_sys_state_message(0, 2), 10.0 + 0.005 * k)
        assert ready.condition(10.0 + 0.005 * k) is condition
    ready.observe(wrapped(applied(plans, sequence=2)), 10.6)
    assert ready.condition(10.6) is not condition
    told(ready, "MOT_THST_EXPO", 0.65)
    assert not calls, "the value is the same"
    told(ready, "MOT_THST_EXPO", 0.3)
    assert calls["contradictions"] == 1


# -- commands ---------------------------------------------------------------------------------------------------------


def test_commands_are_told_with_the_instance_their_time_and_a_sequence_of_their_own(
    ready: ArduPilotAdapter, plans: dict[int, Plan]
) -> None:
    failed = np.eye(8, dtype=bool)[0]
    commands: list[Command] = [
        Declare(10.0, failed, np.ones(8)),
        Load(10.1, plans[1], failed),
        Drive(10.2, np.r_[0.0, np.full(6, 0.5), 1.0]),
        Release(10.3),
    ]
    messages = [inner(message) for command in commands for message in ready.encode(command)]
    assert [m.kind for m in messages] == [Kind.DECLARATION, Kind.MATRIX, Kind.OVERRIDE, Kind.RELEASE]
    assert [m.values["sample_ms"] for m in messages] == [10_000, 10_100, 10_200, 10_300]
    assert {m.values["instance"] for m in messages} == {INSTANCE}
    assert len({m.values["sequence"] for m in messages}) == 4
    assert messages[0].values["failed"] == messages[1].values["failed"] == 1
    assert messages[1].values["timeout_ms"] == 1e3 * times.MATRIX_TIMEOUT_S
    assert messages[1].factors is not None
    assert np.array_equal(messages[1].factors, factors.of_matrix(OCTO, plans[1].matrix))
    assert messages[2].values["timeout_ms"] == 1e3 * times.OVERRIDE_TIMEOUT_S
    assert messages[2].pwm is not None
    assert messages[2].pwm.tolist() == [1000] + [1500] * 6 + [2000]
    assert messages[3].values["flags"] == 0


def test_a_matrix_that_gives_up_yaw_says_so(ready: ArduPilotAdapter, plans: dict[int, Plan]) -> None:
    for released, flags in (((), 0), ((3,), tunnel.YAW_RELEASED)):
        plan = dataclasses.replace(plans[1], released=released)
        (message,) = ready.encode(Load(10.0, plan, np.eye(8, dtype=bool)[0]))
        assert inner(message).values["flags"] == flags


def test_a_matrix_that_cannot_be_carried_is_untold_until_one_can(
    ready: ArduPilotAdapter, plans: dict[int, Plan]
) -> None:
    failed = np.eye(8, dtype=bool)[0]
    for good in (Load(10.2, plans[1], failed), Release(10.2)):
        assert ready.encode(Load(10.0, dataclasses.replace(plans[1], matrix=np.full((8, 4), 50.0)), failed)) == []
        untold = ready.condition(10.1).untold
        assert untold is not None
        assert untold.reason == Reason.NOT_TOLD
        assert "at most 8" in untold.text
        assert ready.encode(good)
        assert ready.condition(10.2).untold is None


def test_who_leaves_says_goodbye_and_nothing_after(ready: ArduPilotAdapter) -> None:
    assert ready.due(10.0, Permit.LISTEN)
    _, commands = schedule.released(schedule.ScheduleState.start(8), 10.0, leaving=True)
    (message,) = [m for command in commands for m in ready.encode(command)]
    assert inner(message).values["flags"] == tunnel.LEAVING
    assert ready.due(20.0, Permit.LISTEN) == []


# -- on the wire, with the applet -------------------------------------------------------------------------------------


class OnTheWire:
    """A vehicle on the ground with the card of octo-x, and adapters that hear it; ``sent`` is what they say."""

    def __init__(self, folder: Path) -> None:
        install(OCTO, folder, of_trial(OCTO))
        fault = Fault(vehicle=0, motor=3, start_s=_FAULT_S)
        self.fleet = Fleet(airframe.load(vehicle.path_of("octo-x")), FleetOptions(seeds=[1]), [fault])
        self.autopilot = WireAutopilot(self.fleet, 0, card=folder)
        assert self.autopilot.personality is not None
        self.port = self.autopilot.personality.port
        self.parameters = self.autopilot.personality.parameters
        self.adapters: list[tuple[ArduPilotAdapter, Permit]] = []
        self.sent: list[bytes] = []
        self._down, self._up = Codec(1, 191), Codec(1, 191)

    @property
    def factors(self) -> NDArray[np.float64]:
        assert self.port.factors is not None
        return self.port.factors.copy()

    def attach(self, airframe_name: str, plans: dict[int, Plan], permit: Permit, instance: int) -> ArduPilotAdapter:
        adapter = ArduPilotAdapter(vehicle.load(airframe_name), (1, 1), plans, instance)
        self.adapters.append((adapter, permit))
        return adapter

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * AUTOPILOT_RATE_HZ)):
            now_s = self.fleet.time_s
            for adapter, permit in self.adapters:
                for message in adapter.due(now_s, permit):
                    self.send(message)
            self.autopilot.scripts()
            self.fleet.step()
            self.autopilot.telemetry()
            for data in self.autopilot.outgoing():
                for message in self._down.parse(data):
                    for adapter, _ in self.adapters:
                        adapter.observe(message, now_s)
                        adapter.condition(now_s)

    def send(self, message: Message) -> None:
        data = self._up.pack(message)
        self.sent.append(data)
        self.autopilot.take(data)

    def kinds(self) -> Counter[str]:
        out: Counter[str] = Counter()
        codec = Codec(1, 1)
        for message in (m for data in self.sent for m in codec.parse(data)):
            kind = message.get_type()
            out[f"TUNNEL {inner(message).kind.name}" if kind == "TUNNEL" else kind] += 1
        return out


@pytest.fixture
def wire(tmp_path: Path) -> OnTheWire:
    return OnTheWire(tmp_path)


def flight(wire: OnTheWire) -> None:
    """Boot, disarmed, armed, flying, a motor that fails, landing, disarmed."""
    autopilot = wire.fleet.autopilot
    wire.run(3.0)
    assert not autopilot.armed[0]
    autopilot.arm(0)
    wire.run(0.5)
    autopilot.take_off(0, 3.0, wire.fleet.sensors.measured)
    wire.run(_FAULT_S + 1.0 - wire.fleet.time_s)
    assert -wire.fleet.state.position_m[0, 2] > 1.0
    autopilot.land(0)
    wire.run(8.0)
    assert not autopilot.armed[0]
    assert not wire.fleet.state.crashed[0]


@pytest.mark.parametrize(("permit", "name"), [(Permit.TIDY, "octo-x"), (Permit.LISTEN, "octo-plus")])
def test_observing_nothing_but_requests_and_heartbeats_leaves_and_the_mixer_stays(
    wire: OnTheWire, permit: Permit, name: str
) -> None:
    wire.run(0.1)
    before = wire.factors
    other = vehicle.load(name)
    wire.attach(name, tables.compute(other, allocator("pinv")), permit, INSTANCE)
    flight(wire)
    kinds = wire.kinds()
    assert set(kinds) == {"PARAM_REQUEST_READ", "TUNNEL HEARTBEAT"}
    assert kinds["TUNNEL HEARTBEAT"] > 70
    assert np.array_equal(wire.factors, before)


def test_a_wrong_airframe_file_is_said_and_nothing_is_changed_whatever_is_allowed(wire: OnTheWire) -> None:
    wire.run(0.1)
    before = wire.factors
    plans = tables.compute(vehicle.load("octo-plus"), allocator("trim"))
    adapter = wire.attach("octo-plus", plans, Permit.ACT, INSTANCE)
    wire.run(4.0)
    assert set(wire.kinds()) == {"PARAM_REQUEST_READ", "TUNNEL HEARTBEAT"}
    assert np.array_equal(wire.factors, before)
    obstacle = adapter.condition(wire.fleet.time_s).command
    assert obstacle is not None
    assert obstacle.reason == Reason.CONTRADICTION
    assert "those of octo-plus (FRAME_CLASS 3, FRAME_TYPE 0), not of FRAME_CLASS 3, FRAME_TYPE 1" in obstacle.text
    findings = {finding.name: finding for finding in adapter.findings()}
    assert findings["card"].ok is False
    assert "octo-plus" in findings["card"].detail
    assert findings["tables"].ok is False


def changed(plans: dict[int, Plan], *masks: int) -> dict[int, Plan]:
    return plans | {mask: dataclasses.replace(plans[mask], matrix=0.9 * plans[mask].matrix) for mask in masks}


def test_on_the_ground_the_tables_that_differ_are_replaced_and_no_others(
    wire: OnTheWire, plans: dict[int, Plan]
) -> None:
    adapter = wire.attach("octo-x", changed(plans, 0b1, 0b101), Permit.ACT, INSTANCE)
    wire.run(5.0)
    assert wire.kinds()["TUNNEL TABLE"] == 2
    assert adapter.condition(wire.fleet.time_s).command is None
    assert found(adapter)["tables"] is True
    assert "36 of 36" in next(f.detail for f in adapter.findings() if f.name == "tables")


def test_a_card_that_agrees_is_left_alone(wire: OnTheWire, plans: dict[int, Plan]) -> None:
    adapter = wire.attach("octo-x", plans, Permit.ACT, INSTANCE)
    wire.run(4.0)
    assert wire.kinds()["TUNNEL TABLE"] == 0
    assert all(finding.ok is not False for finding in adapter.findings()), adapter.findings()
    card = next(finding.detail for finding in adapter.findings() if finding.name == "card")
    assert card.endswith("which was compared at the installation with FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)")


def test_a_card_of_this_file_that_was_compared_with_another_frame_is_not_commanded(
    wire: OnTheWire, plans: dict[int, Plan]
) -> None:
    wire.parameters["NFF_FRAME"] = 401.0
    adapter = wire.attach("octo-x", changed(plans, 0b1), Permit.ACT, INSTANCE)
    wire.run(4.0)
    assert set(wire.kinds()) == {"PARAM_REQUEST_READ", "TUNNEL HEARTBEAT"}
    obstacle = adapter.condition(wire.fleet.time_s).command
    assert obstacle is not None
    assert "not of FRAME_CLASS 4, FRAME_TYPE 1 (coax-x8)" in obstacle.text


def arm(wire: OnTheWire) -> None:
    wire.fleet.autopilot.arm(0)


def confuse(wire: OnTheWire) -> None:
    wire.parameters["SERVO3_FUNCTION"] = 36.0


@pytest.mark.parametrize("obstacle", [arm, confuse])
def test_armed_or_with_an_obstacle_no_table_is_sent(
    wire: OnTheWire, plans: dict[int, Plan], obstacle: Callable[[OnTheWire], None]
) -> None:
    obstacle(wire)
    adapter = wire.attach("octo-x", changed(plans, 0b1), Permit.ACT, INSTANCE)
    wire.run(5.0)
    assert wire.kinds()["TUNNEL TABLE"] == 0
    condition = adapter.condition(wire.fleet.time_s)
    differing = [note.text for note in condition.notes if note.reason == Reason.TABLES_DIFFER]
    assert differing == (["1 tables on the card are not this airframe file's"] if obstacle is arm else [])


def test_before_the_autopilot_says_that_it_is_disarmed_no_table_is_sent(plans: dict[int, Plan]) -> None:
    adapter = ArduPilotAdapter(OCTO, (1, 1), changed(plans, 1), INSTANCE)
    for name, value in GOOD.items():
        told(adapter, name, value)
    check = tunnel.table_check(1, tunnel.table_bytes(factors.of_plans(OCTO, plans)[1]))
    adapter.observe(wrapped(applied(plans, table=1, table_check=check)), 0.5)
    assert [inner(m).kind for m in adapter.due(0.5, Permit.ACT)] == [Kind.HEARTBEAT]
    adapter.observe(heartbeat(armed=False), 0.6)
    assert [inner(m).kind for m in adapter.due(0.6, Permit.ACT)] == [Kind.TABLE]


@pytest.mark.parametrize(
    ("act", "mode", "armed", "owner", "twin", "sent"),
    [
        (True, Mode.ALLOCATE, False, INSTANCE, False, True),
        (True, Mode.OBSERVE, False, INSTANCE, False, False),
        (True, Mode.ALLOCATE, True, INSTANCE, False, False),
        (True, Mode.ALLOCATE, False, 99, False, False),
        (True, Mode.ALLOCATE, False, INSTANCE, True, False),
        (False, Mode.ALLOCATE, False, INSTANCE, False, False),
    ],
    ids=["may act", "observes", "armed", "obeys another one", "another one was first", "a check before the flight"],
)
def test_a_table_that_differs_is_sent_by_who_may_act_and_nobody_else(
    plans: dict[int, Plan], act: bool, mode: Mode, armed: bool, owner: int, twin: bool, sent: bool
) -> None:
    meeting = Meeting(OCTO, "auto", "trim", Path("/nonexistent/j"), instance=INSTANCE, plans=changed(plans, 1))
    session = Session(Companion(OCTO, 200.0), meeting, SessionOptions(mode=mode, act=act), 0.0)
    session.take(from_autopilot(heartbeat(armed=armed)), 0, 0.0)
    if twin:
        session.take(companion_heartbeat(99), 0, 0.0)
    for name, value in GOOD.items():
        session.take(from_autopilot(dialect.MAVLink_param_value_message(name.encode(), value, 9, 100, 0)), 0, 0.0)
    check = tunnel.table_check(1, tunnel.table_bytes(factors.of_plans(OCTO, plans)[1]))
    kinds: Counter[Kind] = Counter()
    for k in range(300):
        if k % 5 == 0:
            word = applied(plans, sequence=k + 1, owner=owner, table=1, table_check=check)
            session.take(from_autopilot(wrapped(word)), 0, 0.01 * k)
            if twin:
                session.take(companion_heartbeat(99), 0, 0.01 * k)
        kinds.update(inner(i.message).kind for i in session.due(0.01 * k) if i.message.get_type() == "TUNNEL")
    assert kinds[Kind.HEARTBEAT] > 0
    assert (kinds[Kind.TABLE] > 0) == sent
    assert set(kinds) <= {Kind.HEARTBEAT, Kind.TABLE}


def test_the_second_of_two_companions_says_that_there_is_another_and_takes_over_after_its_goodbye(
    wire: OnTheWire, plans: dict[int, Plan]
) -> None:
    first = wire.attach("octo-x", plans, Permit.ACT, INSTANCE)
    wire.run(4.0)
    second = wire.attach("octo-x", changed(plans, 0b1), Permit.ACT, 99)
    wire.run(4.0)
    assert first.condition(wire.fleet.time_s).command is None
    obstacle = second.condition(wire.fleet.time_s).command
    assert obstacle is not None
    assert obstacle.reason == Reason.TWIN
    assert str(INSTANCE) in obstacle.text
    assert wire.kinds()["TUNNEL TABLE"] == 0
    for message in first.encode(Release(wire.fleet.time_s + 1.0, leaving=True)):
        wire.send(message)
    wire.run(0.4)
    assert second.condition(wire.fleet.time_s).command is None
    assert second.condition(wire.fleet.time_s).in_force.refused["occupied"] > 10


# -- whole companions -------------------------------------------------------------------------------------------------


def flown(folder: Path, airframe_name: str, mode: Mode) -> tuple[VirtualFlight, NDArray[np.float64], Counter[str]]:
    """Eight seconds of an octo-x whose motor 3 fails at 6 s, with a companion that has the file of ``airframe_name``:
    the flight, the factors at its start, and what of the companion's is no publication."""
    plans = tables.compute(vehicle.load(airframe_name), allocator("trim"))
    install(OCTO, folder, of_trial(OCTO))
    fault = Fault(vehicle=0, motor=3, start_s=_FAULT_S)
    options = FleetOptions(seeds=[1], height_m=10.0)
    fleet = Fleet(airframe.load(vehicle.path_of("octo-x")), options, [fault])
    trial = VirtualFlight(fleet, {0: TrialOptions(mode=mode)}, airframe=airframe_name, workshop=Workshop(plans, folder))
    personality = trial.companions[0].autopilot.personality
    assert personality is not None
    assert personality.port.factors is not None
    before, codec = personality.port.factors.copy(), Codec(1, 1)
    kinds: Counter[str] = Counter()
    while fleet.time_s < 8.0:
        trial.step()
        for message in (m for _, data in trial.companions[0].up.queue for m in codec.parse(data)):
            kind = message.get_type()
            kinds[f"TUNNEL {inner(message).kind.name}" if kind == "TUNNEL" else kind] += 1
    return trial, before, kinds


COMMANDS = {f"TUNNEL {kind.name}" for kind in Kind} - {"TUNNEL HEARTBEAT"}


@pytest.mark.parametrize("name", ["octo-x", "octo-plus"])
def test_a_companion_that_observes_believes_a_failure_and_commands_nothing(tmp_path: Path, name: str) -> None:
    trial, before, kinds = flown(tmp_path, name, Mode.OBSERVE)
    personality = trial.companions[0].autopilot.personality
    assert personality is not None
    assert trial.companions[0].output.failed.any() or name != "octo-x"
    assert not COMMANDS & set(kinds)
    assert personality.port.factors is not None
    assert np.array_equal(personality.port.factors, before)
    assert not trial.fleet.state.crashed[0]


def test_a_companion_with_another_airframe_file_changes_nothing_and_says_why(tmp_path: Path) -> None:
    trial, before, kinds = flown(tmp_path, "octo-plus", Mode.ALLOCATE)
    companion = trial.companions[0]
    personality = companion.autopilot.personality
    assert personality is not None
    assert not COMMANDS & set(kinds)
    assert personality.port.factors is not None
    assert np.array_equal(personality.port.factors, before)
    assert companion.session.moment().verdict.reason == Reason.CONTRADICTION
    assert "octo-plus" in companion.session.moment().verdict.text
    assert not trial.fleet.state.crashed[0]


def test_a_companion_with_the_cards_airframe_file_reallocates(tmp_path: Path) -> None:
    trial, _, kinds = flown(tmp_path, "octo-x", Mode.ALLOCATE)
    moment = trial.companions[0].session.moment()
    assert moment.verdict.reason == Reason.REALLOCATED
    assert moment.condition.in_force.source == Source.MATRIX
    assert kinds["TUNNEL TABLE"] == 0
    assert not any(moment.condition.in_force.refused.values())
