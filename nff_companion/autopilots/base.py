"""What an adapter is: telemetry in, commands out, and which commands its autopilot takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable
from nff_companion.mavlink.codec import Message
from nff_companion.pipeline import Mode, Output


@dataclass(frozen=True)
class Capabilities:
    """What the autopilot takes. ``declare`` is the least; what is missing is said in the status, never ignored."""

    declare: bool
    matrix: bool
    outputs: bool


@dataclass(frozen=True)
class Stream:
    """A message that the companion asks for, and how often; ``required``: flying without it is said to the pilot."""

    message_id: int
    rate_hz: float
    required: bool = True


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at before a flight; ``ok`` False stands in the way, None is advice."""

    name: str
    ok: bool | None
    detail: str


@dataclass(slots=True)
class Applied:
    """What the autopilot says it has in force."""

    source: int = 0
    failed: np.ndarray | None = None
    matrix_sequence: int = 0
    override_sequence: int = 0
    declaration_sequence: int = 0
    refused: dict[str, int] = field(default_factory=dict)


class Adapter(Protocol):
    """Observe, act, release. Knows messages, not sockets; time is the autopilot's."""

    target: tuple[int, int]
    capabilities: Capabilities
    applied: Applied

    @property
    def name(self) -> str:
        """One word for status and logs."""

    @property
    def telemetry(self) -> TelemetryTable | None:
        """Filters of what this autopilot sends; None: as the airframe file says."""

    @property
    def farewell_s(self) -> float:
        """Longest time that the end of a run may take."""

    @property
    def unfinished(self) -> bool:
        """Whether something of ours is still in force that must not stay."""

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for."""

    def observe(self, message: Message) -> Sample | None:
        """Take one message from the autopilot; a sample when it completes one."""

    def act(self, output: Output) -> list[Message]:
        """Commands that put ``output`` into force, to be sent now."""

    def tick(self, now_s: float) -> list[Message]:
        """Messages that are due whether or not telemetry comes; ``now_s`` of our clock."""

    def blocked(self, time_s: float, mode: Mode) -> str:
        """Why no command may be sent in ``mode`` at ``time_s`` of the autopilot's clock; empty when one may."""

    def complaints(self) -> list[str]:
        """What the pilot should hear, in a few words each."""

    def findings(self) -> list[Finding]:
        """What was found out about this autopilot, for a check before the flight."""

    def hands_off(self) -> str:
        """Why motor outputs may not be sent though commands may; empty when they may."""

    def declare(self, failed: np.ndarray, time_s: float) -> list[Message]:
        """The operator's word on which motors (m,) have failed: it is passed on in every mode."""

    def verdict(self, output: Output) -> str:
        """What was done about the declarations of ``output``, in one or two words for the pilot."""

    def drive(self, outputs: np.ndarray, time_s: float) -> list[Message]:
        """Commands that put motor ``outputs`` (m,) in 0..1 into force, answering the sample of ``time_s``."""

    def release(self, time_s: float) -> list[Message]:
        """Commands that give the vehicle back to the autopilot, keeping confirmed declarations."""
