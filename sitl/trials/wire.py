"""A companion in virtual time that meets its autopilot on the wire: every message is encoded, delayed and decoded."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.core.decision import Event
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, Message, dialect
from nff_companion.pipeline import Output, Pipeline
from sitl.autopilot.ardupilot.personality import ArduPilotPersonality
from sitl.commands import Commander
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.telemetry import Telemetry
from sitl.trials.channel import Channel

_SYSTEM = 1
_HEARTBEAT_HZ = 1.0


@dataclass(frozen=True)
class Workshop:
    """What all companions of one airframe share: allocations computed ahead, and the card with the scripts."""

    plans: dict[int, tables.Plan]
    card: Path

    @staticmethod
    def prepare(vehicle: Vehicle, method: str, folder: str) -> Workshop:
        """Compute and install into ``folder``."""
        card = Path(folder)
        install(vehicle, card, method=method)
        return Workshop(tables.compute(vehicle, allocator(method)), card)


def temporary_card() -> tempfile.TemporaryDirectory[str]:
    """A folder for a card; removed when it is no longer used."""
    return tempfile.TemporaryDirectory(prefix="nff-card-")


class WireCompanion:
    """One vehicle of the fleet with the ArduPilot personality, and its companion."""

    def __init__(
        self,
        index: int,
        pipeline: Pipeline,
        fleet: Fleet,
        rate_hz: float,
        link_delay_s: float,
        workshop: Workshop,
        rotor_speeds: bool = False,
    ) -> None:
        self.index, self.pipeline = index, pipeline
        self._fleet = fleet
        self.adapter = ArduPilotAdapter(pipeline.vehicle, (_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1), workshop.plans)
        telemetry = Telemetry(fleet, index)
        self._commander = Commander(fleet, telemetry, _SYSTEM)
        self.personality = ArduPilotPersonality(fleet, index, workshop.card, self._commander.params, _SYSTEM)
        makers = telemetry.makers
        streams = [(s.message_id, s.rate_hz) for s in self.adapter.streams(rate_hz) if s.required or rotor_speeds]
        self._streams = [
            (max(round(AUTOPILOT_RATE_HZ / hz), 1), makers[message_id])
            for message_id, hz in ((dialect.MAVLINK_MSG_ID_HEARTBEAT, _HEARTBEAT_HZ), *streams)
            if message_id in makers
        ]
        self._autopilot_codec = Codec(_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._codec = Codec(_SYSTEM, COMPANION_COMPONENT)
        self._at_autopilot = Codec(_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)
        self.down: Channel[bytes] = Channel(link_delay_s)
        self.up: Channel[bytes] = Channel(link_delay_s)
        self.outputs: Output | None = None
        self.events: list[tuple[float, Event]] = []

    def autopilot_step(self) -> None:
        """The autopilot's side before its loops: what has arrived, and the scripts."""
        now = self._fleet.time_s
        for data in self.up.receive(now):
            for message in self._at_autopilot.parse(data):
                self._take(message)
        self.personality.step()
        for _, message in self.personality.outgoing():
            self._say(message)

    def _take(self, message: Message) -> None:
        kind = message.get_type()
        if kind == "TUNNEL":
            self.personality.receive(message, 0)
        elif kind == "PARAM_REQUEST_READ":
            answer = self._commander.parameter(message.param_id)
            if answer is not None:
                self._say(answer)

    def _say(self, message: Message) -> None:
        self.down.send(self._fleet.time_s, self._autopilot_codec.pack(message))

    def telemetry_step(self) -> None:
        """The autopilot's streams after its loops."""
        cycle = self._fleet.cycle
        for every, maker in self._streams:
            if cycle % every == 0 or cycle == 1:
                self._say(maker())

    def think(self, now_s: float) -> None:
        """The companion: what has arrived, the pipeline, its commands."""
        adapter, pipeline = self.adapter, self.pipeline
        for data in self.down.receive(now_s):
            for message in self._codec.parse(data):
                sample = adapter.observe(message)
                if sample is None:
                    continue
                pipeline.hands_off = adapter.hands_off()
                pipeline.blocked = adapter.blocked(sample.time_s, pipeline.mode)
                override = pipeline.respond(sample)
                if override is not None:
                    for command in adapter.drive(override, sample.time_s):
                        self._send(command, now_s)
                output = self.outputs = pipeline.step(sample, override)
                self.events += [(now_s, event) for event in output.events]
                for command in adapter.act(output):
                    self._send(command, now_s)
        for command in adapter.tick(now_s):
            self._send(command, now_s)

    def _send(self, message: Message, now_s: float) -> None:
        self.up.send(now_s, self._codec.pack(message))
