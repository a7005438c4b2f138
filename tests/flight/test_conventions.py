"""What every MAVLink component is expected to do: endpoints, streams, time, texts, parameters, the computer's state."""

from __future__ import annotations

import os
import pty
import select
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from sessions import bare_session

from nff_companion.companion import Companion
from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core import vehicle
from nff_companion.core.tuning import Tuning
from nff_companion.daemon.configuration import load
from nff_companion.daemon.loop import Loop
from nff_companion.daemon.notify import Notifier
from nff_companion.daemon.service import Daemon
from nff_companion.errors import ConfigError, EndpointError
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.endpoints.serial_port import SerialPort
from nff_companion.mavlink.hub import Hub
from nff_companion.mavlink.services import host_status as host
from nff_companion.mavlink.services.parameter_reader import ParameterReader, encode, name_of
from nff_companion.mavlink.services.parameter_server import Parameter, ParameterServer
from nff_companion.mavlink.services.pilot_text import PilotText
from nff_companion.mavlink.services.streams import Stream, StreamMonitor
from nff_companion.mavlink.services.timesync import TimeSync
from nff_companion.mavlink.urls import parse
from nff_companion.settings import settings
from sitl.trials.process import config_text, free_port

HEARTBEAT = dialect.MAVLink_heartbeat_message(14, 3, 128, 4, 4, 3)


class Clock:
    """Time that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def until(poll: select.poll, hub: Hub, now: float, wanted: int = 1) -> list[Message]:
    """Messages that arrive at a hub within a second of real time."""
    out: list[Message] = []
    deadline = time.monotonic() + 1.0
    while len(out) < wanted and time.monotonic() < deadline:
        for descriptor, _ in poll.poll(20):
            out += hub.read(descriptor, now)
    return out


def baudrate(hub: Hub) -> int:
    endpoint = hub._ports[0].endpoint
    assert isinstance(endpoint, SerialPort)
    assert endpoint._port is not None
    return int(endpoint._port.baudrate)


# -- endpoints --------------------------------------------------------------------------------------------------------


def test_several_endpoints_at_once_and_each_comes_back() -> None:
    poll = select.poll()
    udp, tcp = free_port(), free_port()
    listener = socket.create_server(("127.0.0.1", tcp))
    hub = Hub([f"udpin:127.0.0.1:{udp}", f"tcp:127.0.0.1:{tcp}"], 1, 191, poll, 0.0)
    peer, _ = listener.accept()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(Codec(1, 1).pack(HEARTBEAT), ("127.0.0.1", udp))
        assert [index for _, index in until(poll, hub, 0.0)] == [0]
        peer.sendall(Codec(1, 1).pack(HEARTBEAT))
        assert [index for _, index in until(poll, hub, 0.0)] == [1]
        hub.send(HEARTBEAT, None, 0.0)
        assert sender.recv(300)[0] == 0xFD
        assert peer.recv(300)[0] == 0xFD
        peer.close()
        listener.close()
        assert until(poll, hub, 1.0, wanted=1) == []  # the close is noticed
        hub.maintain(1.5)  # too early, and nobody listens
        listener = socket.create_server(("127.0.0.1", tcp))
        hub.maintain(3.0)
        peer, _ = listener.accept()
        peer.sendall(Codec(1, 1).pack(HEARTBEAT))
        assert [index for _, index in until(poll, hub, 3.0)] == [1]
        # The other one was never disturbed.
        sender.sendto(Codec(1, 1).pack(HEARTBEAT), ("127.0.0.1", udp))
        assert [index for _, index in until(poll, hub, 3.0)] == [0]
    hub.close()
    peer.close()
    listener.close()


def test_one_endpoint_that_cannot_be_opened_does_not_stop_the_others() -> None:
    nobody = free_port()
    hub = Hub([f"tcp:127.0.0.1:{nobody}", f"udpin:127.0.0.1:{free_port()}"], 1, 191, select.poll(), 0.0)
    hub.close()
    with pytest.raises(EndpointError, match="listening"):
        Hub([f"tcp:127.0.0.1:{nobody}"], 1, 191, select.poll(), 0.0)


def test_a_connection_that_cannot_be_made_again_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """On every network: an address that answers nothing would hold up whoever waits."""
    poll, port = select.poll(), free_port()
    listener = socket.create_server(("127.0.0.1", port))
    hub = Hub([f"tcp:127.0.0.1:{port}"], 1, 191, poll, 0.0)
    hub._ports[0].url = "tcp:192.0.2.1:5760"
    peer, _ = listener.accept()
    peer.close()
    until(poll, hub, 0.0)
    waits: list[float | None] = []

    class Unanswered(socket.socket):
        def connect(self, address: Any) -> None:
            waits.append(self.gettimeout())
            raise BlockingIOError if self.gettimeout() == 0.0 else TimeoutError

    monkeypatch.setattr(socket, "socket", Unanswered)
    for k in range(1, 6):
        hub.maintain(2.0 * k)
        hub.send(HEARTBEAT, None, 2.0 * k)
        assert not any(hub.read(descriptor, 2.0 * k) for descriptor, _ in poll.poll(0))
    assert waits
    assert set(waits) == {0.0}, "no attempt waits"
    hub.close()
    listener.close()


def test_tcpin_serves_one_client_after_the_other() -> None:
    poll, port = select.poll(), free_port()
    hub = Hub([f"tcpin:127.0.0.1:{port}"], 1, 191, poll, 0.0)
    for _ in range(2):
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(Codec(1, 1).pack(HEARTBEAT))
            assert len(until(poll, hub, 0.0)) == 1
            hub.send(HEARTBEAT, 0, 0.0)
            assert client.recv(300)[0] == 0xFD
        until(poll, hub, 0.0)
    hub.close()


def test_a_serial_port_tries_the_next_baud_while_nothing_readable_comes() -> None:
    master, slave = pty.openpty()
    name = os.ttyname(slave)
    assert parse(f"{name}:921600,57600").bauds == (921600, 57600)
    poll = select.poll()
    hub = Hub([f"{name}:921600,57600"], 1, 191, poll, 0.0)
    assert baudrate(hub) == 921600
    os.write(master, b"\x81\x92garbage\xff" * 4)
    until(poll, hub, 0.5)
    hub.maintain(2.5)
    hub.maintain(2.6)
    assert baudrate(hub) == 57600
    os.write(master, Codec(1, 1).pack(HEARTBEAT))
    assert len(until(poll, hub, 3.0)) == 1
    hub.maintain(60.0)  # readable: it stays
    assert baudrate(hub) == 57600
    hub.send(HEARTBEAT, None, 60.0)
    assert os.read(master, 300)[0] == 0xFD
    hub.close()
    os.close(master)
    os.close(slave)


def test_a_slow_serial_line_drops_frames_whole_and_counts_them() -> None:
    master, slave = pty.openpty()
    poll, codec, received, sent = select.poll(), Codec(1, 1), 0, 0
    hub = Hub([f"{os.ttyname(slave)}:57600"], 1, 191, poll, 0.0)
    for _ in range(4):
        for _ in range(2000):  # more than the line's buffer holds
            hub.send(HEARTBEAT, None, 0.0)
            sent += 1
        while select.select([master], [], [], 0.05)[0]:
            received += len(codec.parse(os.read(master, 503)))  # what was cut off shows in what follows
            hub.maintain(0.0)
    assert codec.bad_frames == 0, "half a frame was sent"
    assert 0 < hub.dropped < sent
    assert received == sent - hub.dropped
    hub.close()
    os.close(master)
    os.close(slave)


def test_frames_that_found_no_room_are_in_the_status() -> None:
    clock, port, session = Clock(), free_port(), bare_session()
    loop = Loop([f"tcpin:127.0.0.1:{port}"], 191, clock)
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(Codec(1, 1).pack(HEARTBEAT))
        while session.adapter is None:
            assert loop.poll.poll(2000)
            loop.turn(session, 0.0)
        for _ in range(200_000):  # it reads nothing
            loop.hub.send(HEARTBEAT, None, clock())
            if loop.hub.dropped >= 5:
                break
        clock.now += 1.0
        assert loop.turn(session, 0.0)
        assert session.document(clock())["counters"]["dropped"] >= 5
    loop.close()


# -- streams and time -------------------------------------------------------------------------------------------------


def test_what_comes_too_slowly_is_asked_for_again_and_named() -> None:
    monitor = StreamMonitor()
    fast = Stream(dialect.MAVLINK_MSG_ID_HIGHRES_IMU, 200.0)
    slow = Stream(dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, 200.0)
    optional = Stream(dialect.MAVLINK_MSG_ID_ESC_STATUS, 100.0, required=False)
    streams = [fast, slow, optional]
    assert len(monitor.requests(streams, (1, 1), 0.0)) == 3
    for k in range(2000):
        now = k / 200.0
        monitor.heard(fast.message_id, now)
        if k % 2 == 0:
            monitor.heard(slow.message_id, now)
    assert monitor.rate_hz(fast.message_id, 10.0) == pytest.approx(200.0, rel=0.02)
    assert monitor.slow(streams, 10.0).keys() == {"SERVO_OUTPUT_RAW"}
    asked = {int(m.param1) for m in monitor.requests(streams, (1, 1), 10.0)}
    assert asked == {slow.message_id, optional.message_id}
    for k in range(10):
        last = monitor.requests(streams, (1, 1), 11.0 + k)
    assert optional.message_id not in {int(m.param1) for m in last}, "this autopilot does not have it"


def test_timesync_asks_each_second_and_ignores_the_late() -> None:
    sync = TimeSync()
    sync.adopt(1)
    (question,) = sync.tick(5_000_000_000)
    assert (question.tc1, question.ts1) == (0, 5_000_000_000)
    assert sync.tick(5_100_000_000) == []
    (late,) = Codec(1, 191).parse(Codec(1, 1).pack(dialect.MAVLink_timesync_message(1, 5_000_000_000)))
    assert sync.observe(late, 9_000_000_000) == []
    assert sync.offset_s is None


def test_a_parameter_that_is_no_number_counts_as_unanswered() -> None:
    reader = ParameterReader(["A"], (1, 1), bytewise=False)
    for bad in (float("nan"), float("inf")):
        assert reader.observe(dialect.MAVLink_param_value_message(b"A", bad, 9, 1, 0)) is None
    assert reader.values == {}
    whole = ParameterReader(["N"], (1, 1), bytewise=True)
    minus_one = encode(-1.0, dialect.MAV_PARAM_TYPE_INT32, bytewise=True)  # its bytes are those of a NaN
    whole.observe(dialect.MAVLink_param_value_message(b"N", minus_one, dialect.MAV_PARAM_TYPE_INT32, 1, 0))
    assert whole.values == {"N": -1.0}


def test_parameters_are_read_until_answered_or_known_to_be_absent() -> None:
    reader = ParameterReader(["A", "B"], (1, 1), bytewise=False)
    now = 0.0
    while not reader.complete:
        for message in reader.tick(now):
            if name_of(message) == "A":
                reader.observe(dialect.MAVLink_param_value_message(b"A", 2.5, 9, 1, 0))
        now += 0.1
        assert now < 10.0
    assert reader.values == {"A": 2.5}
    assert reader.absent == ["B"]


# -- texts, parameters, host ------------------------------------------------------------------------------------------


def test_texts_are_short_and_do_not_flood_but_a_failure_always_passes() -> None:
    text = PilotText()
    warning, critical = dialect.MAV_SEVERITY_WARNING, dialect.MAV_SEVERITY_CRITICAL
    assert len(text.say("the same", warning, 0.0)) == 1
    assert text.say("the same", warning, 5.0) == []
    sent = sum(len(text.say(f"text {chr(97 + k)}", warning, 6.0 + 0.01 * k)) for k in range(26))
    assert sent == 4
    assert len(text.say("IMU 98 Hz", warning, 20.0, "IMU")) == 1
    assert text.say("IMU 97 Hz", warning, 21.0, "IMU") == [], "another number is not another subject"
    assert len(text.say("NFF: telemetry stopped, observing", dialect.MAV_SEVERITY_ERROR, 21.0)) == 1
    (message,) = text.say("Motor 3 failed (eff 0.02): reallocated", critical, 22.0)
    assert message.text == "Motor 3 failed (eff 0.02): reallocated"
    assert len(text.say("x" * 80, critical, 23.0)[0].text) <= 50
    assert text.withheld >= 22


class Settings:
    """What a ground station may change, and what became of it."""

    def __init__(self) -> None:
        self.mode, self.tuning, self.flying = Mode.ALLOCATE, Tuning(), False
        self.lifted: list[int] = []
        self.server = ParameterServer(settings(8, lambda: self.mode, self.obey, lambda: self.tuning, self.retune), 191)
        self.server.adopt(1)

    def obey(self, orders: Orders) -> None:
        self.mode = self.mode if orders.mode is None else orders.mode
        self.lifted += orders.lift

    def retune(self, tuning: Tuning) -> bool:
        if not self.flying:
            self.tuning = tuning
        return not self.flying


@pytest.fixture
def chosen() -> Settings:
    return Settings()


@pytest.fixture
def server(chosen: Settings) -> ParameterServer:
    return chosen.server


def ask(server: ParameterServer, message: Message) -> list[Message]:
    (received,) = Codec(1, 191).parse(Codec(255, 190).pack(message))
    return server.answer(received)


def put(server: ParameterServer, name: str, value: float, component: int = 191) -> list[Message]:
    return ask(server, dialect.MAVLink_param_set_message(1, component, name.encode(), value, 9))


def test_a_ground_station_lists_reads_and_sets(server: ParameterServer, chosen: Settings) -> None:
    listed = ask(server, dialect.MAVLink_param_request_list_message(1, 0))
    assert [m.param_index for m in listed] == list(range(len(listed)))
    assert all(m.param_count == len(listed) for m in listed)
    assert all(len(name_of(m)) <= 16 for m in listed)
    (value,) = ask(server, dialect.MAVLink_param_request_read_message(1, 191, b"NFF_MODE", -1))
    assert value.param_value == 1.0
    (value,) = put(server, "NFF_MODE", 0.0)
    assert value.param_value == 0.0
    assert chosen.mode == Mode.OBSERVE
    (value,) = put(server, "NFF_MARGIN", 9.0)
    assert value.param_value == 9.0
    assert chosen.tuning.decision.margin_min == 9.0
    put(server, "NFF_LIFT", 3.0)
    assert chosen.lifted == [3]
    chosen.flying = True
    (value,) = put(server, "NFF_MARGIN", 12.0)
    assert value.param_value == 9.0, "in flight the answer is the value that stays"


def test_a_bound_may_be_set_although_the_wire_rounds_it(server: ParameterServer, chosen: Settings) -> None:
    (answer,) = put(server, "NFF_EXPLAINED", 0.99)
    assert answer.param_value == pytest.approx(0.99)
    assert chosen.tuning.decision.explained_min == 0.99
    assert server.refused == 0


@pytest.mark.parametrize(("name", "value"), [("NFF_LOSS_SLOW", 0.4), ("NFF_FAILED_MAX", 2.5), ("NFF_MODE", 0.5)])
def test_a_threshold_at_odds_with_another_or_not_whole_is_answered_with_the_one_that_stays(
    server: ParameterServer, chosen: Settings, name: str, value: float
) -> None:
    chosen.tuning = chosen.tuning.having("decision", loss_others=0.5)
    (before,) = ask(server, dialect.MAVLink_param_request_read_message(1, 191, name.encode(), -1))
    (answer,) = put(server, name, value)
    assert answer.param_value == before.param_value
    assert server.refused == 1


@pytest.mark.parametrize("name", ["", "SEVENTEEN_LETTERS", "UMLÄUT", "A\0B"])
def test_a_parameter_that_the_wire_does_not_carry_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="16 ASCII"):
        Parameter(name, 0.0, 1.0, lambda: 0.0, lambda _: True)


def test_two_parameters_of_one_name_are_refused() -> None:
    one = Parameter("SAME", 0.0, 1.0, lambda: 0.0, lambda _: True)
    with pytest.raises(ConfigError, match="SAME"):
        ParameterServer([one, one], 191)


def test_what_is_out_of_range_not_a_number_or_not_for_us_changes_nothing(
    server: ParameterServer, chosen: Settings
) -> None:
    for value in (99.0, -1.0, float("nan"), float("inf")):
        (answer,) = put(server, "NFF_MODE", value)
        assert answer.param_value == 1.0
    assert put(server, "NFF_MODE", 0.0, component=1) == []
    assert put(server, "NFF_MODE", 0.0, component=0) == [], "a broadcast must not set anything"
    assert put(server, "UNKNOWN", 0.0) == []
    assert ask(server, dialect.MAVLink_param_request_list_message(7, 0)) == []
    assert chosen.mode == Mode.ALLOCATE


def test_the_computers_state_is_sendable() -> None:
    message = host.status_message()
    (received,) = Codec(1, 1).parse(Codec(1, 191).pack(message))
    assert received.ram_total > 100
    assert 0 < received.ram_usage <= received.ram_total
    assert 1 <= sum(core != 255 for core in received.cpu_cores) <= 8


# -- daemon -----------------------------------------------------------------------------------------------------------


class Listening:
    """A daemon in this process, a clock in our hand, and a ground station that listens."""

    def __init__(self, folder: Path) -> None:
        port = free_port()
        path = folder / "c.toml"
        path.write_text(
            config_text(
                endpoint=f"udpin:127.0.0.1:{port}", airframe="octo-x", mode="observe", rate_hz=200, socket=folder / "s"
            )
        )
        self.clock = Clock()
        self.daemon = Daemon(load(path), Notifier(), self.clock)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(0.05)
        self.codec = Codec(3, 1)

    def say(self, message: Message) -> None:
        self.socket.send(self.codec.pack(message))

    def hear(self, seconds: float) -> list[Message]:
        """Messages while the daemon's clock runs on by ``seconds``."""
        out: list[Message] = []
        end = self.clock.now + seconds
        while self.clock.now < end:
            self.clock.now += 0.05
            self.daemon.turn(0.001)
            try:
                while True:
                    out += self.codec.parse(self.socket.recv(2048))
            except TimeoutError:
                pass
        return out

    def __enter__(self) -> Listening:
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.close()
        self.socket.close()


def test_the_daemon_introduces_itself_and_falls_silent_when_its_estimator_fails(tmp_path: Path) -> None:
    with Listening(tmp_path) as there:
        there.say(HEARTBEAT)
        heard = there.hear(3.0)
        kinds = {m.get_type() for m in heard}
        assert {"HEARTBEAT", "NFF_COMPANION_STATUS", "ONBOARD_COMPUTER_STATUS", "TIMESYNC", "COMMAND_LONG"} <= kinds
        beats = [m for m in heard if m.get_type() == "HEARTBEAT"]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in beats[1:]} == {(3, 191)}, "the vehicle's system"
        assert beats[-1].type == dialect.MAV_TYPE_ONBOARD_CONTROLLER
        session = there.daemon.session
        session.state = replace(session.state, fault=True)
        assert not [m for m in there.hear(3.0) if m.get_type() == "HEARTBEAT"]
        session.state = replace(session.state, fault=False)
        assert [m for m in there.hear(2.0) if m.get_type() == "HEARTBEAT"]


def test_the_daemon_answers_parameters_and_timesync_of_a_ground_station(tmp_path: Path) -> None:
    with Listening(tmp_path) as there:
        there.say(HEARTBEAT)
        (question,) = (m for m in there.hear(0.3) if m.get_type() == "TIMESYNC")
        there.say(dialect.MAVLink_timesync_message(question.ts1, question.ts1))
        there.hear(0.1)
        there.say(dialect.MAVLink_param_set_message(3, 191, b"NFF_MODE", 1.0, 9))
        there.say(dialect.MAVLink_timesync_message(0, 1234))
        heard = there.hear(0.3)
        values = [m for m in heard if m.get_type() == "PARAM_VALUE"]
        assert [(name_of(m), m.param_value) for m in values] == [("NFF_MODE", 1.0)]
        assert any(m.get_type() == "TIMESYNC" and m.ts1 == 1234 for m in heard)
        assert there.daemon.session.state.mode == Mode.ALLOCATE


def test_an_unknown_autopilot_is_said_and_left_alone(tmp_path: Path) -> None:
    with Listening(tmp_path) as there:
        there.say(dialect.MAVLink_heartbeat_message(14, 18, 128, 4, 4, 3))
        heard = there.hear(1.0)
        assert any(m.get_type() == "STATUSTEXT" and "not supported" in str(m.text) for m in heard)
        assert not [m for m in heard if m.get_type() == "COMMAND_LONG"]


def test_another_vehicle_is_said_and_gets_nothing(tmp_path: Path) -> None:
    with Listening(tmp_path) as there:
        there.say(HEARTBEAT)
        there.hear(0.3)
        there.codec = Codec(9, 1)
        there.say(HEARTBEAT)
        heard = there.hear(0.5)
        assert any(m.get_type() == "STATUSTEXT" and "system 9 is heard too" in str(m.text) for m in heard)
        targets = {m.target_system for m in heard if m.get_type() in ("COMMAND_LONG", "TUNNEL", "PARAM_REQUEST_READ")}
        assert targets <= {3}


def test_another_companion_is_built_for_other_filters_and_keeps_the_airframe() -> None:
    before = Companion(vehicle.load("octo-x"), 200.0)
    other = vehicle.TelemetryTable(40.0, 30.0)
    after = before.rebuilt(telemetry=other)
    assert after.vehicle.telemetry == other
    assert after.rate_hz == before.rate_hz
    assert np.array_equal(after.vehicle.effectiveness, before.vehicle.effectiveness)
