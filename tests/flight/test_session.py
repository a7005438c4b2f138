"""The one loop: what it sends, whom it believes, and what it says of what is in force."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from sessions import autopilot_heartbeat, bare_session, companion_heartbeat, flight, fly, from_autopilot, reason, texts

from nff_companion.autopilots.twins import Rank
from nff_companion.companion_state import Orders
from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session
from nff_companion.vehicle_link import Outgoing
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight, Workshop

REQUESTS = {"COMMAND_LONG", "PARAM_REQUEST_READ", "TIMESYNC"}
PUBLISHED = {"HEARTBEAT", "STATUSTEXT", "NFF_EFFECTIVENESS", "NFF_COMPANION_STATUS", "NFF_FAULT_EVENT"}


# -- what it sends ------------------------------------------------------------------------------------------------


def test_in_observe_nothing_but_requests_and_publications_leaves_over_a_whole_flight() -> None:
    trial = flight([Fault(vehicle=0, motor=3, start_s=4.0)], mode=Mode.OBSERVE)
    codec = Codec(1, 1)
    kinds: Counter[str] = Counter()
    while trial.fleet.time_s < 7.0:
        trial.step()
        for _, data in trial.companions[0].up.queue:
            for message in codec.parse(data):
                kinds[message.get_type()] += 1
                if message.get_type() == "COMMAND_LONG":
                    assert message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    assert trial.companions[0].output.failed.tolist() == [False, False, True] + [False] * 5
    assert set(kinds) <= REQUESTS | PUBLISHED


def test_an_ardupilot_observed_gets_requests_and_heartbeats_alone(tmp_path: Path) -> None:
    model = vehicle.load("octo-x")
    trial = flight(
        [Fault(vehicle=0, motor=3, start_s=4.0)],
        mode=Mode.OBSERVE,
        workshop=Workshop.prepare(model, "trim", str(tmp_path)),
    )
    codec, tunnel = Codec(1, 1), set()
    while trial.fleet.time_s < 6.0:
        trial.step()
        for _, data in trial.companions[0].up.queue:
            for message in codec.parse(data):
                assert message.get_type() in REQUESTS | PUBLISHED | {"TUNNEL"}
                if message.get_type() == "TUNNEL":
                    tunnel.add(message.payload[1])
    assert trial.companions[0].output.failed.any()
    assert tunnel == {1}, "heartbeats"


@pytest.mark.parametrize(
    "autopilot", [dialect.MAV_AUTOPILOT_GENERIC, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, dialect.MAV_AUTOPILOT_PX4]
)
@pytest.mark.parametrize("act", [False, True], ids=["a check", "observing"])
def test_who_may_not_act_only_asks(act: bool, autopilot: int) -> None:
    session, now = bare_session(act=act, mode=Mode.OBSERVE), 0.0
    out: list[Outgoing] = []
    for k in range(400):
        now = 0.01 * k
        if k % 100 == 0:
            out += session.take(autopilot_heartbeat(autopilot=autopilot), 0, now)
        out += session.due(now)
    kinds = {item.message.get_type() for item in out}
    assert kinds >= {"HEARTBEAT", "COMMAND_LONG"}
    assert kinds <= REQUESTS | {"TUNNEL"} | (PUBLISHED if act else {"HEARTBEAT"})
    asked = {m.message.command for m in out if m.message.get_type() == "COMMAND_LONG"}
    assert asked <= {dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE}
    assert {m.message.payload[1] for m in out if m.message.get_type() == "TUNNEL"} <= {1}, "heartbeats"


def test_a_check_asks_nothing_of_an_armed_vehicle_and_says_so() -> None:
    session = bare_session(act=False)
    kinds = Counter(m.message.get_type() for m in session.take(autopilot_heartbeat(armed=True), 0, 0.0))
    for k in range(300):
        kinds.update(m.message.get_type() for m in session.due(0.01 * k))
    assert set(kinds) == {"HEARTBEAT"}
    assert any(finding.name == "armed" and finding.ok is False for finding in session.findings(3.0))


# -- time and gaps ------------------------------------------------------------------------------------------------


def test_a_lift_in_a_telemetry_gap_reaches_the_autopilot() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=4.0)])
    companion = fly(trial, 6.0)
    port = trial.fleet.autopilot.ports[0]
    assert port.failed.tolist() == [False] * 3 + [True] + [False] * 4
    lifted = False
    while trial.fleet.time_s < 6.8:
        companion.down.queue.clear()  # no telemetry comes
        trial.step()
        if trial.fleet.time_s > 6.5 and not lifted:
            lifted = True
            assert companion.output.mode == Mode.OBSERVE
            companion.order(Orders(lift=(4,)))
        if trial.fleet.time_s < 6.6:
            companion.up.queue.clear()  # what was told first is lost
    assert not port.failed.any(), "the autopilot has it from a command that was not stale"
    assert port.refused["stale"] == 0


BOOT_S = 100.0  # of the autopilot's clock, where ours begins


def heard(session: Session, until_s: float, bad_from_s: float = np.inf) -> None:
    """An autopilot of our dialect that holds motor 4, and its samples: without motor outputs from ``bad_from_s`` on."""
    session.take(autopilot_heartbeat(autopilot=dialect.MAV_AUTOPILOT_GENERIC, armed=True), 0, 0.0)
    holds(session, 0b1000, 0.0)
    for k in range(round(200 * until_s) + 1):
        now_s, usec = 0.005 * k, round(1e6 * (BOOT_S + 0.005 * k))
        if now_s < bad_from_s:
            servos = dialect.MAVLink_servo_output_raw_message(usec, 0, *[1500] * 8)
            session.take(from_autopilot(servos), 0, now_s)
        imu = dialect.MAVLink_highres_imu_message(usec, 0, 0, -9.81, *[0.0] * 10, 63)
        session.take(from_autopilot(imu), 0, now_s)
        session.due(now_s)


def holds(session: Session, mask: int, now_s: float) -> None:
    session.take(from_autopilot(dialect.MAVLink_nff_applied_message(1, 0, 0, 0, mask, *[0] * 8)), 0, now_s)


def commanded(outgoing: list[Outgoing]) -> list[tuple[str, float]]:
    """Commands, with the time that they bear by the autopilot's clock."""
    messages = [item.message for item in outgoing if hasattr(item.message, "sample_usec")]
    kinds = {"NFF_ALLOCATION_MATRIX", "NFF_MOTOR_DECLARATION"}
    return [(m.get_type(), 1e-6 * m.sample_usec) for m in messages if m.get_type() in kinds]


@pytest.mark.parametrize("bad_from_s", [np.inf, 1.0, 0.0], ids=["all good", "bad at last", "never a good one"])
@pytest.mark.parametrize("gap_s", [0.0, 0.1, 0.6, 4.0])
def test_a_command_in_a_gap_or_beside_bad_samples_bears_the_time_that_it_is(gap_s: float, bad_from_s: float) -> None:
    session = bare_session()
    heard(session, 2.0, bad_from_s)
    now_s = 2.0 + gap_s
    session.due(now_s)
    told = commanded(session.order(Orders(mode=Mode.OBSERVE), now_s))
    told += commanded(session.order(Orders(lift=(4,)), now_s + 0.1))
    told += commanded(session.leave(now_s + 0.2))
    assert [kind for kind, _ in told] == ["NFF_ALLOCATION_MATRIX", "NFF_MOTOR_DECLARATION", "NFF_ALLOCATION_MATRIX"]
    assert [time_s - BOOT_S for _, time_s in told] == pytest.approx([now_s, now_s + 0.1, now_s + 0.2], abs=1e-6)


@pytest.mark.parametrize("bad_from_s", [np.inf, 0.0])
def test_a_lift_in_a_gap_is_told_until_it_is_confirmed(bad_from_s: float) -> None:
    session = bare_session(mode=Mode.OBSERVE)
    heard(session, 1.0, bad_from_s)
    session.due(1.5)
    told = commanded(session.order(Orders(lift=(4,)), 1.5))
    for k in range(1, 100):
        now_s = 1.5 + 0.01 * k
        if k % 10 == 0:
            holds(session, 0b1000, now_s)
        told += [(kind, time_s - now_s) for kind, time_s in commanded(session.due(now_s))]
    assert len(told) == 20, "each 50 ms"
    assert {kind for kind, _ in told} == {"NFF_MOTOR_DECLARATION"}
    assert [ahead for _, ahead in told[1:]] == pytest.approx([BOOT_S] * 19, abs=1e-6)
    holds(session, 0, 2.5)
    assert not [item for k in range(100) for item in commanded(session.due(2.5 + 0.01 * k))]


def test_what_is_never_confirmed_is_never_claimed() -> None:
    """Above 125 ms one way every command is refused as stale."""
    trial = flight([Fault(vehicle=0, motor=4, start_s=4.0)], link_delay_s=0.14)
    companion = fly(trial, 7.0)
    assert trial.fleet.autopilot.ports[0].refused["stale"] > 20
    assert reason(companion) == Reason.NOT_CONFIRMED
    document = companion.session.document(trial.fleet.time_s)
    assert "stale" in document["reason"]
    assert document["failed"] == [4]
    assert document["autopilot"]["failed"] == []
    assert document["autopilot"]["allocation"] == "stock"


def test_a_cut_uplink_is_said() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=4.0)])
    said: list[Message] = []
    fly(trial, 1.0)
    companion = fly(trial, 6.0, said)
    assert reason(companion) == Reason.NOT_CONFIRMED
    texts = [str(m.text) for m in said if m.get_type() == "STATUSTEXT"]
    assert any(text.startswith("Motor 4 failed") for text in texts)
    assert any("NOT confirmed" in text for text in texts)
    assert not any("reallocated" in text for text in texts)


def test_what_is_confirmed_is_said_to_be_in_force() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=4.0)])
    companion = fly(trial, 6.0)
    assert reason(companion) == Reason.REALLOCATED
    autopilot = companion.session.document(6.0)["autopilot"]
    assert (autopilot["failed"], autopilot["allocation"]) == ([4], "matrix")


def test_motors_that_cannot_carry_the_weight_are_said() -> None:
    faults = [Fault(vehicle=0, motor=m, start_s=4.0 + 0.2 * k) for k, m in enumerate((1, 3))]
    trial = flight(faults, thrust_to_weight=1.25)
    companion = trial.companions[0]
    reasons = set()
    while trial.fleet.time_s < 6.0:
        trial.step()
        reasons.add(reason(companion))
    assert companion.output.failed.sum() == 2
    assert Reason.NO_LIFT in reasons


# -- rate ---------------------------------------------------------------------------------------------------------


def test_samples_at_another_rate_than_agreed_are_refused_with_the_reason() -> None:
    companion = fly(flight([], stubborn_hz=100.0), 3.0)
    assert companion.output.mode == Mode.OBSERVE
    assert reason(companion) == Reason.RATE
    assert "100 instead of 200" in companion.session.moment().verdict.text


def test_the_estimator_is_built_for_what_arrives() -> None:
    companion = fly(flight([]), 2.0)
    assert companion.session.companion.rate_hz == pytest.approx(200.0, rel=0.01)


# -- whom it believes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sender",
    [
        {"component": 190, "kind": 6, "autopilot": 8},
        {"component": 190},
        {"component": 100, "kind": 2},
        {"component": 0},
        {"system": 9, "kind": 6, "autopilot": 8},
        {"system": 9},
        {"system": 255, "component": 190},
    ],
    ids=str,
)
def test_nobody_else_is_taken_for_the_vehicle_whatever_he_says_he_is(sender: dict[str, int]) -> None:
    """A heartbeat of a ground station on the vehicle's system, of another component of it, of another vehicle."""
    session = bare_session()
    session.take(autopilot_heartbeat(armed=True), 0, 0.0)
    adapter = session.adapter
    assert adapter is not None
    for k in range(5):
        session.take(autopilot_heartbeat(armed=False, **sender), 0, 0.1 + 0.1 * k)
        assert adapter.condition(0.1 + 0.1 * k).armed is True
    assert session.adapter is adapter


@pytest.mark.parametrize("kind", [5, 6, 18, 26, 27])
def test_trackers_gimbals_and_stations_are_no_vehicle(kind: int) -> None:
    session = bare_session()
    session.take(autopilot_heartbeat(kind=kind), 0, 0.0)
    assert session.adapter is None


def test_one_stray_message_of_our_dialect_does_not_choose_the_adapter() -> None:
    session = bare_session()
    session.take(autopilot_heartbeat(), 0, 0.0)
    applied = from_autopilot(dialect.MAVLink_nff_applied_message(1, *[0] * 12))
    session.take(applied, 0, 0.1)
    assert session.adapter is not None
    assert session.adapter.name == "ardupilot"
    for k in range(5):
        session.take(applied, 0, 0.2 + 0.05 * k)
    assert session.adapter.name == "nff"
    for k in range(8):  # it falls silent, the vehicle does not: won again
        session.take(autopilot_heartbeat(), 0, 1.0 + k)
    assert session.adapter.name == "ardupilot"


def test_an_unknown_autopilot_is_left_alone() -> None:
    session = bare_session()
    out = session.take(autopilot_heartbeat(autopilot=18), 0, 0.0) + session.due(0.1)
    assert session.adapter is None
    assert not [item for item in out if item.message.get_type() == "COMMAND_LONG"]


def test_two_vehicles_are_one_too_many_until_one_is_named() -> None:
    session = bare_session()
    session.take(autopilot_heartbeat(1), 0, 0.0)
    session.take(autopilot_heartbeat(2), 0, 0.1)
    found = {finding.name: finding for finding in session.findings(0.2)}
    assert found["vehicle"].ok is False
    assert "1 and 2" in found["vehicle"].detail
    named = bare_session(system=2)
    named.take(autopilot_heartbeat(1), 0, 0.0)
    assert named.adapter is None
    named.take(autopilot_heartbeat(2), 0, 0.1)
    assert named.system == 2
    assert "vehicle" not in {finding.name for finding in named.findings(0.2)}


def test_a_vehicle_that_is_gone_is_given_up_and_another_one_won() -> None:
    session = bare_session()
    session.take(autopilot_heartbeat(1), 0, 0.0)
    session.due(6.0)
    assert session.adapter is None
    assert session.moment().verdict.reason == Reason.WAITING
    session.take(autopilot_heartbeat(2), 1, 6.5)
    assert session.system == 2


@pytest.mark.parametrize("autopilot", [dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, dialect.MAV_AUTOPILOT_PX4])
def test_nothing_of_ours_is_asked_of_another_autopilot_and_silence_is_not_said_at_once(autopilot: int) -> None:
    session = bare_session()
    out = session.take(autopilot_heartbeat(autopilot=autopilot), 0, 0.0)
    for k in range(1, 200):
        out += session.due(0.01 * k)
    asked = {int(i.message.param1) for i in out if i.message.get_type() == "COMMAND_LONG"}
    assert dialect.MAVLINK_MSG_ID_HIGHRES_IMU in asked
    assert not [i for i in asked if 54000 <= i < 60000]
    assert not [text for text in texts(out) if "does not answer" in text]


def test_the_same_stream_through_two_ports_is_counted_once() -> None:
    session = bare_session()
    session.take(autopilot_heartbeat(), 0, 0.0)
    for k in range(1, 700):
        imu = dialect.MAVLink_highres_imu_message(10_000 * k, 0, 0, -9.81, *[0.0] * 10, 63)
        for port in (0, 1):
            session.take(from_autopilot(imu), port, 0.01 * k + 0.002 * port)
        session.due(0.01 * k)
    rates = next(finding for finding in session.findings(7.0) if finding.name == "rates")
    assert "HIGHRES_IMU 100 of 200 Hz" in rates.detail


def test_a_vehicle_heard_on_two_ports_keeps_one_and_counts_nothing_twice() -> None:
    trial = flight([])
    companion = trial.companions[0]
    codec = Codec(1, 191)
    while trial.fleet.time_s < 3.0:
        trial.step()
        for sent_s, data in list(companion.down.queue):
            if sent_s - 0.01 < trial.fleet.time_s - 1e-6:
                continue
            for message in codec.parse(data):  # the router is a link's delay ahead
                companion.session.take(message, 1, trial.fleet.time_s)
    assert companion.output.bad_samples == 0
    assert companion.output.mode == Mode.ALLOCATE


@pytest.mark.parametrize("airframe", ["h250", "hexa-x"])
def test_an_airframe_file_with_fewer_motors_than_are_driven_only_observes(airframe: str) -> None:
    fleet = Fleet(
        plant_airframe.load(vehicle.path_of("octo-x")),
        FleetOptions(seeds=[1], height_m=10.0),
        [Fault(vehicle=0, motor=2, start_s=2.0)],
    )
    trial = VirtualFlight(fleet, {0: TrialOptions(mode=Mode.ALLOCATE)}, airframe=airframe)
    companion = fly(trial, 4.0)
    assert companion.output.mode == Mode.OBSERVE
    assert reason(companion) == Reason.CONTRADICTION
    assert not fleet.autopilot.ports[0].accepted


# -- twins --------------------------------------------------------------------------------------------------------


def test_the_later_of_two_companions_observes_and_both_say_so() -> None:
    trial = flight([])
    first = fly(trial, 4.0)
    first.session.take(companion_heartbeat(99), 0, 4.0)
    fly(trial, 4.5)
    assert reason(first) == Reason.HEALTHY, "it was here first"
    later = flight([])
    companion = fly(later, 0.5)
    for k in range(4):
        companion.session.take(companion_heartbeat(99), 0, later.fleet.time_s)
        fly(later, 1.5 + k)
    assert reason(companion) == Reason.TWIN
    assert companion.output.mode == Mode.OBSERVE
    fly(later, 9.0)
    assert reason(companion) == Reason.HEALTHY, "the other one is gone"


def test_the_pilot_of_the_first_hears_of_the_later_one() -> None:
    session, out = bare_session(), list[Outgoing]()
    for k in range(50):
        session.take(autopilot_heartbeat(), 0, 0.1 * k)
        out += session.take(companion_heartbeat(99, 192, Rank.CANDIDATE), 0, 0.1 * k)
        out += session.due(0.1 * k)
    assert texts(out).count("NFF: another companion is heard (component 192)") == 1


def test_its_own_heartbeat_come_back_is_no_twin() -> None:
    trial = flight([])
    companion = fly(trial, 0.5)
    for k in range(4):
        companion.session.take(companion_heartbeat(1), 0, trial.fleet.time_s)
        fly(trial, 1.0 + 0.5 * k)
    assert reason(companion) == Reason.HEALTHY


def test_a_restart_in_flight_takes_over_what_the_autopilot_holds() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=3.0)])
    fly(trial, 5.0)
    fleet = trial.fleet
    again = VirtualFlight(fleet, {0: TrialOptions(mode=Mode.ALLOCATE)}, airframe="octo-x")
    start = fleet.time_s
    companion = again.companions[0]
    seen = None
    while fleet.time_s < start + 2.0:
        again.step()
        if seen is None and companion.output.failed.any() and companion.output.plan is not None:
            seen = fleet.time_s - start
    assert companion.output.failed.tolist() == [False] * 3 + [True] + [False] * 4
    assert seen is not None
    assert seen < 1.2, "not blind for seconds"
    assert not fleet.state.crashed[0]
    assert np.degrees(fleet.max_tilt_rad[0]) < 25.0
