"""Which PX4 it is: asked for until it has said so."""

from __future__ import annotations

import numpy as np

from nff_companion.autopilots.px4.versions import behaviour, text_of, version_of
from nff_companion.condition import Reason, Statement
from nff_companion.mavlink.codec import Message, dialect

_INTERVAL_S = 0.5
_TRIES = 6


class Identity:
    """``version`` (major, minor, patch) and ``autopilot``, its unique id, once known."""

    def __init__(self, target: tuple[int, int]) -> None:
        self._target = target
        self.version: tuple[int, int, int] | None = None
        self.autopilot = ""
        self._tries, self._next_s = 0, -np.inf

    def observe(self, message: Message) -> None:
        """Take an AUTOPILOT_VERSION."""
        self.version = version_of(message.flight_sw_version)
        uid2 = bytes(getattr(message, "uid2", b"")[:18])
        self.autopilot = f"{message.uid:016x}-{uid2.hex()}"

    def due(self, now_s: float) -> list[Message]:
        """A request, while it is not known."""
        if self.version is not None or now_s < self._next_s:
            return []
        self._next_s = now_s + _INTERVAL_S
        self._tries += 1
        wanted = (float(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION), *[0.0] * 6)
        return [dialect.MAVLink_command_long_message(*self._target, dialect.MAV_CMD_REQUEST_MESSAGE, 0, *wanted)]

    def unknown(self) -> Statement | None:
        """Why it is not known what it would do; None when it is."""
        if self.version is None:
            silent = self._tries >= _TRIES
            return Statement(Reason.PARAMETER_SILENT, "AUTOPILOT_VERSION") if silent else Statement(Reason.READING)
        known = behaviour(self.version)
        if known is None or not known.scales:
            return Statement(Reason.VERSION_UNKNOWN, f"PX4 {text_of(self.version)}")
        return None
