"""The emulated vehicle in real time on MAVLink endpoints: one vehicle, any number of clients."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.endpoint import Endpoint, open_endpoint
from sitl.autopilot.nff_port import NffPort
from sitl.commands import whole
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.link_model import LinkModel, LinkOptions
from sitl.personality import spokesman

_DEFAULT_HZ = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: 1.0,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2.0,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 10.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE: 10.0,
    dialect.MAVLINK_MSG_ID_NFF_APPLIED: 20.0,  # without being asked: by it an autopilot shows that it knows our dialect
}
_SYSTEM = 1
_LAG_MAX_S = 0.25  # a machine slower than this loses time instead of running behind for ever


@dataclass(slots=True)
class _Client:
    endpoint: Endpoint
    codec: Codec
    down: LinkModel
    up: LinkModel
    every: dict[int, int] = field(default_factory=dict)  # message id to cycles


class Server:
    """Steps the fleet by the wall clock and speaks with its clients."""

    def __init__(
        self,
        fleet: Fleet,
        urls: list[str],
        *,
        link: LinkOptions | None = None,
        seed: int = 1,
        on_cycle: Callable[[Fleet], None] | None = None,
        on_message: Callable[[Message, float], None] | None = None,
        card: Path | None = None,
        px4: Mapping[str, float | int] | None = None,
    ) -> None:
        """``card``: folder with scripts; then the vehicle is an ArduPilot to whoever speaks with it. ``px4``: it is a
        PX4, with these parameters that are not stock. Raises ConfigError for an airframe that PX4 does not drive."""
        if fleet.vehicles != 1:
            raise ValueError(f"a server has one vehicle, not {fleet.vehicles}")
        self.fleet = fleet
        speaks = spokesman(fleet, 0, _SYSTEM, card=card, px4=px4)
        self.telemetry, self.personality, self.px4 = speaks.telemetry, speaks.ardupilot, speaks.px4
        self._commander, self._parameters = speaks.commander, speaks.parameters
        self._our_dialect = self.personality is None and self.px4 is None
        self._port = NffPort(fleet)
        options = link or LinkOptions()
        self._clients = [
            _Client(
                open_endpoint(url),
                Codec(_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1),
                LinkModel(options, seed + 2 * k),
                LinkModel(options, seed + 2 * k + 1),
                {i: _cycles(hz) for i, hz in _DEFAULT_HZ.items()},
            )
            for k, url in enumerate(urls)
        ]
        self._on_cycle, self._on_message = on_cycle, on_message
        self.late_cycles = 0
        self.lost_s = 0.0  # by which the vehicle's clock fell behind the wall's
        self.refused: Counter[str] = Counter()  # messages that asked for what cannot be, by type

    def run(self, until_s: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Fly in real time until the fleet's clock reads ``until_s`` or ``stop()``."""
        start = time.monotonic() - self.fleet.time_s
        while self.fleet.time_s < until_s and not stop():
            self.cycle()
            ahead = self.fleet.time_s - (time.monotonic() - start)
            if ahead > 0.0:
                time.sleep(ahead)
            elif ahead < -_LAG_MAX_S:
                self.late_cycles += 1
                self.lost_s -= ahead
                start += -ahead

    def cycle(self) -> None:
        """One autopilot cycle: what has arrived, the step, what is due."""
        self._listen()
        if self.px4 is not None:
            self.px4.step()
        if self.personality is not None:
            self.personality.step()
            for channel, message in self.personality.outgoing():
                for index, client in enumerate(self._clients):
                    if channel in (index, -1):
                        self._reply(client, message)
        self.fleet.step()
        if self._on_cycle is not None:
            self._on_cycle(self.fleet)
        now, cycle = self.fleet.time_s, self.fleet.cycle
        for client in self._clients:
            for message_id, maker in self.telemetry.makers.items():
                every = client.every.get(message_id)
                if every and cycle % every == 0:
                    client.down.send(now, client.codec.pack(maker()))
            for data in client.down.receive(now):
                client.endpoint.send(data)

    def _listen(self) -> None:
        now = self.fleet.time_s
        for client in self._clients:
            for data, sender in client.endpoint.receive():
                client.endpoint.answer(sender)
                client.up.send(now, data)
            codec = client.codec
            parse = codec.parse_datagram if client.endpoint.datagrams else codec.parse
            for data in client.up.receive(now):
                for message in parse(data):
                    self._take(client, message)

    def greet(self) -> None:
        """Send a heartbeat and listen, without moving the vehicle's time: clients may connect first."""
        for client in self._clients:
            maker = self.telemetry.makers[dialect.MAVLINK_MSG_ID_HEARTBEAT]
            client.endpoint.send(client.codec.pack(maker()))
        self._listen()

    def close(self) -> None:
        """Close the endpoints."""
        for client in self._clients:
            client.endpoint.close()

    # -- messages -----------------------------------------------------------------------------------------------

    def _reply(self, client: _Client, message: Message) -> None:
        client.down.send(self.fleet.time_s, client.codec.pack(message))

    def _take(self, client: _Client, message: Message) -> None:
        if self._on_message is not None:
            self._on_message(message, self.fleet.time_s)
        if message.get_type() == "HEARTBEAT":
            for other in self._clients:  # as autopilots do between their links
                if other is not client:
                    other.down.send(self.fleet.time_s, bytes(message.get_msgbuf()))
        target = getattr(message, "target_system", _SYSTEM)
        if target not in (0, _SYSTEM):
            return
        if not self._our_dialect and message.get_type().startswith("NFF_"):
            return
        handlers: dict[str, Callable[[_Client, Message], None]] = {
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._set_mode,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "TIMESYNC": self._timesync,
            "SET_POSITION_TARGET_LOCAL_NED": self._position_target,
            "MISSION_REQUEST_LIST": self._mission_list,
            "TUNNEL": self._tunnel,
        }
        handler = handlers.get(message.get_type())
        if handler is not None:
            handler(client, message)
        elif self._port.take(message) and message.get_type() == "NFF_MOTOR_DECLARATION":
            self._reply(client, self.telemetry.makers[dialect.MAVLINK_MSG_ID_NFF_APPLIED]())

    def _count(self, message: Message, result: int | None) -> None:
        if result != dialect.MAV_RESULT_ACCEPTED:
            self.refused[message.get_type()] += 1

    def _command(self, client: _Client, message: Message) -> None:
        extra: list[Message] = []
        result: int | None
        if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(client, message)
        else:
            result, extra = self._commander.command(message)
        self._count(message, result)
        if result is not None:
            source = (message.get_srcSystem(), message.get_srcComponent())
            self._reply(client, dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *source))
        for item in extra:
            self._reply(client, item)

    def _set_interval(self, client: _Client, message: Message) -> int:
        ids, interval_us = self.telemetry.makers, message.param2
        message_id = whole(message.param1, 0, max(ids))
        if message_id not in ids:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        if interval_us == -1.0:
            client.every.pop(message_id, None)
        elif interval_us == 0.0:
            client.every[message_id] = _cycles(_DEFAULT_HZ.get(message_id, 10.0))
        else:
            every = self.telemetry.cycles(message_id, interval_us)
            if every is None:
                return int(dialect.MAV_RESULT_DENIED)
            client.every[message_id] = every
        return int(dialect.MAV_RESULT_ACCEPTED)

    def _set_mode(self, client: _Client, message: Message) -> None:
        self._count(message, self._commander.set_mode(message.custom_mode))

    def _param_list(self, client: _Client, message: Message) -> None:
        for name in self._parameters.names:
            self._tell(client, name)

    def _tell(self, client: _Client, name: str) -> None:
        value = self._parameters.message(name)
        if value is not None:
            self._reply(client, value)

    def _param_read(self, client: _Client, message: Message) -> None:
        name = _name(message)
        if message.param_index >= 0:
            names = self._parameters.names
            name = names[message.param_index] if message.param_index < len(names) else ""
        self._tell(client, name)

    def _param_set(self, client: _Client, message: Message) -> None:
        name = _name(message)
        if not self._parameters.take(name, message.param_value, message.param_type):
            self.refused[message.get_type()] += 1
        if name not in self._parameters.names:
            for answer in self._parameters.unknown(name):
                self._reply(client, answer)
        self._tell(client, name)

    def _timesync(self, client: _Client, message: Message) -> None:
        if message.tc1 == 0:
            self._reply(client, dialect.MAVLink_timesync_message(1000 * self.telemetry.time_usec, message.ts1))

    def _position_target(self, client: _Client, message: Message) -> None:
        self._count(message, self._commander.go_to(np.array([message.x, message.y, message.z])))

    def _mission_list(self, client: _Client, message: Message) -> None:
        source = (message.get_srcSystem(), message.get_srcComponent())
        self._reply(client, dialect.MAVLink_mission_count_message(*source, 0, message.mission_type))

    def _tunnel(self, client: _Client, message: Message) -> None:
        if self.personality is not None:
            self.personality.receive(message, self._clients.index(client))


def _cycles(rate_hz: float) -> int:
    return max(round(AUTOPILOT_RATE_HZ / rate_hz), 1)


def _name(message: Message) -> str:
    text = message.param_id
    return text.decode(errors="replace").rstrip("\0") if isinstance(text, bytes) else text
