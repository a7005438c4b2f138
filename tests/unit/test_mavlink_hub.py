"""The hub: names that are never found, datagrams of strangers, the vehicle that moves."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from nff_companion.errors import EndpointError
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.endpoints.udp import Udp
from nff_companion.mavlink.hub import Hub
from sitl.trials.process import free_port

HEARTBEAT = dialect.MAVLink_heartbeat_message(14, 3, 128, 4, 4, 3)


class Sender:
    """Somebody on the network: a socket and what it says it is."""

    def __init__(self, port: int, system: int, component: int = 1) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._codec = Codec(system, component)

    def say(self, data: bytes | None = None) -> None:
        self._socket.send(self._codec.pack(HEARTBEAT) if data is None else data)

    def hears(self) -> int:
        """Datagrams that have arrived."""
        count = 0
        while select.select([self._socket], [], [], 0.02)[0]:
            self._socket.recv(2048)
            count += 1
        return count

    def close(self) -> None:
        self._socket.close()


class Net:
    """A hub with one ``udpin`` port."""

    def __init__(self) -> None:
        self.poll = select.poll()
        self.port = free_port()
        self.hub = Hub([f"udpin:127.0.0.1:{self.port}"], 1, 191, self.poll, 0.0)
        self._senders: list[Sender] = []

    def sender(self, system: int, component: int = 1) -> Sender:
        self._senders.append(Sender(self.port, system, component))
        return self._senders[-1]

    def take(self) -> list[Message]:
        out: list[Message] = []
        while ready := self.poll.poll(20):
            for descriptor, _ in ready:
                out += self.hub.read(descriptor, 0.0)
        return out

    def heard_by(self, *senders: Sender) -> list[bool]:
        """Who receives what the hub sends."""
        self.hub.send(HEARTBEAT, None, 0.0)
        return [sender.hears() > 0 for sender in senders]

    def close(self) -> None:
        self.hub.close()
        for sender in self._senders:
            sender.close()


@pytest.fixture
def net() -> Iterator[Net]:
    net = Net()
    yield net
    net.close()


# -- datagrams --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "garbage",
    [b"\xfd\xff", b"\xfd\xff\x00", b"\xfe\xff", b"\xfe\xff\x00\x01\x01\x00", Codec(9, 1).pack(HEARTBEAT)[:-5]],
)
def test_a_strangers_bytes_neither_cost_nor_hold_up_a_frame_of_the_vehicle(net: Net, garbage: bytes) -> None:
    vehicle, stranger = net.sender(1), net.sender(99)
    for _ in range(5):
        stranger.say(garbage)
        for _ in range(3):
            vehicle.say()
        assert len(net.take()) == 3, "at once, not when more has come"
    assert net.hub.bad_frames == 5


def test_who_sends_garbage_is_never_answered(net: Net) -> None:
    vehicle, stranger = net.sender(1), net.sender(99)
    stranger.say(b"hello")
    net.take()
    assert net.heard_by(stranger) == [False]
    vehicle.say()
    stranger.say(b"\xfd\xff\x00")
    net.take()
    assert net.heard_by(vehicle, stranger) == [True, False]


def test_before_the_vehicle_is_known_the_last_that_made_sense_is_answered(net: Net) -> None:
    one, other = net.sender(1), net.sender(2)
    one.say()
    net.take()
    assert net.heard_by(one, other) == [True, False]
    other.say()
    net.take()
    assert net.heard_by(one, other) == [False, True]


def test_an_adopted_vehicle_keeps_its_port_against_others(net: Net) -> None:
    vehicle, ground, camera = net.sender(1), net.sender(255, 190), net.sender(1, 100)
    vehicle.say()
    net.take()
    net.hub.adopt(1)
    vehicle.say()
    ground.say()
    camera.say()
    assert len(net.take()) == 3, "what others say is heard"
    assert net.heard_by(vehicle, ground, camera) == [True, False, False]
    net.hub.adopt(None)
    ground.say()
    net.take()
    assert net.heard_by(vehicle, ground, camera) == [False, True, False]


def test_a_stranger_that_was_answered_makes_way_for_the_adopted_vehicle(net: Net) -> None:
    vehicle, stranger = net.sender(1), net.sender(99)
    vehicle.say()
    stranger.say()
    net.take()
    net.hub.adopt(1)
    vehicle.say()
    stranger.say()
    net.take()
    assert net.heard_by(vehicle, stranger) == [True, False]


def test_the_vehicle_may_change_its_address(net: Net) -> None:
    vehicle, stranger = net.sender(1), net.sender(99)
    vehicle.say()
    net.take()
    net.hub.adopt(1)
    vehicle.say()
    net.take()
    moved = net.sender(1)
    stranger.say()
    moved.say()
    net.take()
    assert net.heard_by(vehicle, moved, stranger) == [False, True, False]


def test_a_ground_station_on_a_port_of_its_own_is_answered_there() -> None:
    poll, ports = select.poll(), [free_port(), free_port()]
    hub = Hub([f"udpin:127.0.0.1:{port}" for port in ports], 1, 191, poll, 0.0)
    vehicle, ground = Sender(ports[0], 1), Sender(ports[1], 255, 190)
    vehicle.say()
    hub.adopt(1)
    ground.say()
    time_out = time.monotonic() + 2.0
    heard: set[int] = set()
    while len(heard) < 2 and time.monotonic() < time_out:
        heard |= {index for descriptor, _ in poll.poll(20) for _, index in hub.read(descriptor, 0.0)}
    hub.send(HEARTBEAT, None, 0.0)
    assert [vehicle.hears(), ground.hears()] == [1, 1]
    hub.close()
    vehicle.close()
    ground.close()


def test_a_hundred_strangers_leave_nothing_behind(net: Net) -> None:
    vehicle = net.sender(1)
    vehicle.say()
    net.take()
    net.hub.adopt(1)
    vehicle.say()
    net.take()
    before = count_of(net.hub)
    for _ in range(100):
        stranger = Sender(net.port, 99)
        stranger.say()
        stranger.say(b"\xfd\xff")
        stranger.close()
    assert len(net.take()) == 100
    assert count_of(net.hub) <= before + 16
    assert net.heard_by(vehicle) == [True]


def count_of(hub: Hub) -> int:
    """Objects that a hub's ports hold, as far as containers go."""
    seen = 0
    left: list[object] = [vars_of(port) for port in hub._ports]
    while left:
        item = left.pop()
        if isinstance(item, dict | list | tuple | set):
            seen += len(item)
            left += item.values() if isinstance(item, dict) else item
        elif type(item).__module__.startswith("nff_companion.mavlink") and "dialect" not in type(item).__module__:
            left.append(vars_of(item))
    return seen


def vars_of(item: object) -> list[object]:
    names = [*getattr(item, "__slots__", ()), *getattr(item, "__dict__", {})]
    return [getattr(item, name) for name in names]


def test_the_half_frame_of_a_client_that_left_does_not_touch_the_next_one() -> None:
    poll, port = select.poll(), free_port()
    hub = Hub([f"tcpin:127.0.0.1:{port}"], 1, 191, poll, 0.0)
    frame = Codec(1, 1).pack(HEARTBEAT)
    heard = []
    for data in (frame + frame[:-5], frame):
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(data)
            while poll.poll(50):
                heard += hub.read(hub._ports[0].descriptor, 0.0)
    assert len(heard) == 2
    assert hub.bad_frames == 0
    hub.close()


# -- names ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def silent_resolver(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Name look-ups do not return until the event is set, and then find this machine."""
    answer = threading.Event()

    def look_up(host: str, port: int | None, *_: object, **__: object) -> list[Any]:
        assert not host.replace(".", "").isdigit(), f"{host} is an address and was looked up"
        answer.wait(60.0)
        return [(socket.AF_INET, socket.SOCK_DGRAM, 0, "", ("127.0.0.1", port or 0))]

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    yield answer
    answer.set()


@pytest.mark.parametrize("kind", ["udpout", "tcp", "udpin", "tcpin"])
def test_a_name_that_is_never_found_stops_nobody(kind: str, silent_resolver: threading.Event) -> None:
    poll, port = select.poll(), free_port()
    began = time.monotonic()
    hub = Hub([f"{kind}:companion.invalid:{free_port()}", f"udpin:127.0.0.1:{port}"], 1, 191, poll, 0.0)
    sender = Sender(port, 1)
    for k in range(20):
        sender.say()
        assert poll.poll(1000)
        assert [index for descriptor, _ in poll.poll(0) for _, index in hub.read(descriptor, 0.1 * k)] == [1]
        hub.send(HEARTBEAT, None, 0.1 * k)
        hub.maintain(0.5 * k)
    assert sender.hears() == 20
    assert time.monotonic() - began < 1.0
    assert threading.active_count() < 8, "one look-up at a time"
    hub.close()
    sender.close()


def test_a_name_that_is_found_late_is_opened_then_and_looked_up_once(silent_resolver: threading.Event) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.setblocking(False)
        hub = Hub([f"udpout:vehicle.invalid:{peer.getsockname()[1]}"], 1, 191, select.poll(), 0.0)
        hub.send(HEARTBEAT, None, 0.0)
        silent_resolver.set()
        deadline = time.monotonic() + 5.0
        while not select.select([peer], [], [], 0.01)[0]:
            hub.maintain(time.monotonic())
            hub.send(HEARTBEAT, None, 0.0)
            assert time.monotonic() < deadline
        hub.close()


def test_datagrams_to_a_name_do_not_look_it_up_again(monkeypatch: pytest.MonkeyPatch) -> None:
    looked_up: list[str] = []
    actual = socket.getaddrinfo

    def look_up(host: str, *arguments: Any, **options: Any) -> Any:
        looked_up.append(host)
        return actual(host, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        hub = Hub([f"udpout:localhost:{peer.getsockname()[1]}"], 1, 191, select.poll(), 0.0)
        deadline = time.monotonic() + 5.0
        while not select.select([peer], [], [], 0.01)[0]:
            hub.maintain(time.monotonic())
            hub.send(HEARTBEAT, None, 0.0)
            assert time.monotonic() < deadline
        for _ in range(10):
            hub.send(HEARTBEAT, None, 0.0)
        assert looked_up == ["localhost"]
        # What sendto looks up itself does not pass through getaddrinfo: the peer must be an address.
        endpoint = hub._ports[0].endpoint
        assert isinstance(endpoint, Udp)
        assert endpoint._peer is not None
        assert endpoint._peer[0] == "127.0.0.1"
        hub.close()


def test_a_name_that_does_not_exist_is_said_and_tried_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def look_up(*_: object, **__: object) -> list[Any]:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    hub = Hub(["tcp:nobody.invalid:5760"], 1, 191, select.poll(), 0.0)
    deadline, now = time.monotonic() + 5.0, 0.0
    while "nobody.invalid" not in caplog.text or "Name or service not known" not in caplog.text:
        now += 2.0
        hub.maintain(now)
        assert time.monotonic() < deadline
    hub.close()


def test_nothing_but_names_that_are_looked_up_is_no_error_but_nothing_to_open_is() -> None:
    with pytest.raises(EndpointError):
        Hub([f"tcp:127.0.0.1:{free_port()}"], 1, 191, select.poll(), 0.0)


def test_frames_are_not_dropped_where_nobody_listens_yet(net: Net) -> None:
    net.hub.send(HEARTBEAT, None, 0.0)
    assert net.hub.dropped == 0, "there is nobody to send to"
