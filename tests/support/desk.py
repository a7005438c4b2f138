"""A client of the emulated vehicle's server, in memory."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, Message, dialect
from sitl import airframe
from sitl.autopilot.autopilot import Mode
from sitl.fleet import Fleet, FleetOptions
from sitl.server import Server


class Desk:
    """A server with one client in memory; ``say`` returns what the server answers at once."""

    datagrams = True

    def __init__(
        self, name: str = "octo-x", height_m: float = 10.0, px4: Mapping[str, float | int] | None = None
    ) -> None:
        fleet = Fleet(airframe.load(vehicle.path_of(name)), FleetOptions(seeds=[1], height_m=height_m))
        self.server = Server(fleet, ["udpout:127.0.0.1:9"], px4=px4)
        self.fleet = fleet
        (client,) = self.server._clients
        client.endpoint.close()
        client.endpoint = self  # type: ignore[assignment]  # as much of an endpoint as the server uses
        client.every.clear()
        self._pilot, self._parser = Codec(255, 190), Codec(255, 190)
        self._waiting: list[bytes] = []
        self._heard: list[Message] = []

    def receive(self) -> list[tuple[bytes, None]]:
        waiting, self._waiting = self._waiting, []
        return [(data, None) for data in waiting]

    def answer(self, sender: None) -> None:
        """There is one to answer."""

    def send(self, data: bytes) -> bool:
        self._heard += self._parser.parse(data)
        return True

    def close(self) -> None:
        self._waiting = []

    def say(self, message: Message) -> list[Message]:
        """Over the wire, as every client's, and one cycle."""
        self._heard = []
        self._waiting.append(self._pilot.pack(message))
        self.server.cycle()
        return self._heard

    def disturb(self, data: bytes) -> None:
        """Bytes of a stranger, before whatever is said next."""
        self._waiting.append(data)

    def command_long(self, command: int, *params: float) -> int:
        """Result of COMMAND_LONG."""
        values = [*params, *[0.0] * (7 - len(params))]
        return self._result(dialect.MAVLink_command_long_message(1, 1, command, 0, *values))

    def command_int(self, command: int, params: tuple[float, ...], x: int, y: int, z: float) -> int:
        """Result of COMMAND_INT."""
        return self._result(dialect.MAVLink_command_int_message(1, 1, 6, command, 0, 0, *params, x, y, z))

    def _result(self, message: Message) -> int:
        acks = [m for m in self.say(message) if m.get_type() == "COMMAND_ACK"]
        assert len(acks) == 1
        assert acks[0].command == message.command
        return int(acks[0].result)

    def check_finite(self, after: object) -> None:
        autopilot, state = self.fleet.autopilot, self.fleet.state
        position, attitude = autopilot.position, autopilot.attitude
        for name in ("goal", "goal_yaw", "goal_yaw_rate", "speed_xy", "speed_z", "path", "path_velocity"):
            assert np.isfinite(getattr(position, name)).all(), f"{name} after {after}"
        flying_a_velocity = autopilot.mode[0] == Mode.LAND
        assert flying_a_velocity or np.isnan(position.goal_velocity).all(), f"goal_velocity after {after}"
        assert not np.isinf(position.goal_velocity).any(), f"goal_velocity after {after}"
        for values in (attitude.target, autopilot.output, state.position_m, state.quaternion, state.velocity_m_s):
            assert np.isfinite(values).all(), f"after {after}"
