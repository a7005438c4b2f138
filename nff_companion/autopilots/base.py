"""What an adapter is: it decodes telemetry, states its autopilot's condition, and encodes commands.

When to send what is decided in schedule.py, the same for every autopilot.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from nff_companion.autopilots.schedule import Command
from nff_companion.condition import Condition
from nff_companion.core.sample import Sample
from nff_companion.mavlink.codec import Message
from nff_companion.mavlink.services.streams import Stream


class Permit(IntEnum):
    """What an adapter may send by itself, beside the commands that it encodes."""

    LISTEN = 0  # requests and heartbeats alone
    TIDY = 1  # and undo what this companion itself has changed
    ACT = 2  # and prepare the autopilot, on the ground


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at before a flight; ``ok`` False stands in the way, None is advice."""

    name: str
    ok: bool | None
    detail: str


class Adapter(Protocol):
    """Knows messages, not sockets. ``now_s`` is our clock, any monotonic one; times in commands are the autopilot's."""

    name: str
    target: tuple[int, int]  # system and component of the autopilot

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for; the rate of HIGHRES_IMU is that of the samples."""

    def observe(self, message: Message, now_s: float) -> Sample | None:
        """Take one message from the autopilot; a sample when it completes one."""

    def condition(self, now_s: float) -> Condition:
        """How the autopilot is; called at every sample, so it costs little."""

    def encode(self, command: Command) -> list[Message]:
        """Messages that tell the autopilot; none where it cannot be told (then ``condition().untold`` says why)."""

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Messages that are due whether or not telemetry comes: requests, heartbeats, and what ``permit`` allows."""

    def findings(self) -> list[Finding]:
        """What was found out about this autopilot, for a check before the flight."""
