"""One vehicle of a fleet as an autopilot on the wire, in virtual time: bytes in, bytes out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from nff_companion.mavlink.codec import Codec, Message, dialect
from sitl.autopilot.nff_port import NffPort
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.personality import spokesman

SYSTEM = 1
_DEFAULT_HZ = {dialect.MAVLINK_MSG_ID_HEARTBEAT: 1.0, dialect.MAVLINK_MSG_ID_NFF_APPLIED: 20.0}
_SPEEDS = (
    dialect.MAVLINK_MSG_ID_ESC_STATUS,
    dialect.MAVLINK_MSG_ID_ESC_INFO,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12,
)


class WireAutopilot:
    """``card``: folder with scripts; then the vehicle is an ArduPilot. Neither that nor PX4, it speaks our dialect."""

    def __init__(
        self,
        fleet: Fleet,
        vehicle: int,
        *,
        card: Path | None = None,
        rotor_speeds: bool = False,
        stubborn_hz: float | None = None,
        px4: Mapping[str, float | int] | None = None,
    ) -> None:
        """``stubborn_hz``: the rate at which every stream comes, whatever was asked for; ``px4``: it is a PX4, with
        these parameters that are not stock."""
        self._stubborn_hz = stubborn_hz
        self._fleet, self._codec = fleet, Codec(SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)
        speaks = spokesman(fleet, vehicle, SYSTEM, card=card, px4=px4)
        self._telemetry, self.personality, self.px4 = speaks.telemetry, speaks.ardupilot, speaks.px4
        self._commander, self._parameters = speaks.commander, speaks.parameters
        self._makers = dict(speaks.telemetry.makers)
        self._our_dialect = self.personality is None and self.px4 is None
        self._port = NffPort(fleet, vehicle)
        for message_id in () if rotor_speeds else _SPEEDS:
            self._makers.pop(message_id, None)
        self._held: dict[int, tuple[float, int]] = {}  # streams that stumble: until when, and what share still comes
        self._every = {i: _cycles(hz) for i, hz in _DEFAULT_HZ.items() if i in self._makers}
        self._out: list[bytes] = []

    def take(self, data: bytes) -> None:
        """What has arrived, before the autopilot's loops."""
        for message in self._codec.parse(data):
            kind = message.get_type()
            if self._our_dialect and self._port.take(message):
                if kind == "NFF_MOTOR_DECLARATION":
                    self._say(self._makers[dialect.MAVLINK_MSG_ID_NFF_APPLIED]())
            elif kind == "TUNNEL" and self.personality is not None:
                self.personality.receive(message, 0)
            elif kind == "PARAM_REQUEST_READ":
                self._tell(message.param_id)
            elif kind == "PARAM_REQUEST_LIST":
                for name in self._parameters.names:
                    self._tell(name)
            elif kind == "PARAM_SET":
                self._parameters.take(message.param_id, message.param_value, message.param_type)
                self._tell(message.param_id)
            elif kind == "COMMAND_LONG":
                self._command(message)

    def _tell(self, name: str) -> None:
        answer = self._parameters.message(name)
        if answer is not None:
            self._say(answer)

    def _command(self, message: Message) -> None:
        if message.command == dialect.MAV_CMD_INJECT_FAILURE:
            result, _ = self._commander.command(message)
            if result is not None:
                self._say(dialect.MAVLink_command_ack_message(message.command, result))
            return
        message_id = int(message.param1)
        if message_id not in self._makers:
            return
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            self._say(self._makers[message_id]())
        elif message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL and message.param2 > 0.0:
            interval_us = 1e6 / self._stubborn_hz if self._stubborn_hz else message.param2
            every = self._telemetry.cycles(message_id, interval_us)
            if every is not None:
                self._every[message_id] = every

    def scripts(self) -> None:
        """The personality's turn, before the autopilot's loops."""
        if self.px4 is not None:
            self.px4.step()
        if self.personality is not None:
            self.personality.step()
            for _, message in self.personality.outgoing():
                self._say(message)

    def telemetry(self) -> None:
        """The streams, after the autopilot's loops."""
        cycle = self._fleet.cycle
        for message_id, maker in self._makers.items():  # in this order: the inertial sample comes last
            every = self._every.get(message_id)
            if every and (cycle % every == 0 or cycle == 1) and not self._stumbles(message_id, cycle // every):
                self._say(maker())

    def stumble(self, message_id: int, until_s: float, each: int = 0) -> None:
        """A stream stops, or comes with each ``each``-th message alone, until ``until_s`` of the fleet's time."""
        self._held[message_id] = until_s, each

    def _stumbles(self, message_id: int, number: int) -> bool:
        if message_id not in self._held:
            return False
        until_s, each = self._held[message_id]
        if self._fleet.time_s >= until_s:
            del self._held[message_id]
            return False
        return not each or number % each != 0

    def outgoing(self) -> list[bytes]:
        """Frames since the last call."""
        out, self._out = self._out, []
        return out

    def _say(self, message: Message) -> None:
        self._out.append(self._codec.pack(message))


def _cycles(rate_hz: float) -> int:
    return max(round(AUTOPILOT_RATE_HZ / rate_hz), 1)
