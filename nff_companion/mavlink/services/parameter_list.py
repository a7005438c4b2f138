"""All parameters of an autopilot: the list, then what of it got lost.

https://mavlink.io/en/services/parameter.html
"""

from __future__ import annotations

import math

from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import decode, name_of

_LIST_S = 3.0  # between two requests for the whole list, while nothing of it comes
_QUIET_S = 0.5  # without a new one: what is missing is asked for
_AT_ONCE = 10


class ParameterList:
    """Only asks. ``now_s`` of any monotonic clock."""

    def __init__(self, target: tuple[int, int], *, bytewise: bool) -> None:
        """``target``: system and component; ``bytewise``: PX4's way of integers."""
        self._target, self._bytewise = target, bytewise
        self._count: int | None = None
        self._heard: set[int] = set()
        self._asked_s = self._new_s = -float("inf")
        self.values: dict[str, float] = {}

    @property
    def complete(self) -> bool:
        """Whether as many were heard as the autopilot says that it has."""
        return self._count is not None and len(self._heard) >= self._count

    @property
    def state(self) -> str:
        """How far it is."""
        return "no parameter" if self._count is None else f"{len(self._heard)} of {self._count} parameters"

    def observe(self, message: Message, now_s: float) -> None:
        """Take one message of anybody."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        if message.get_type() != "PARAM_VALUE" or sender != self._target:
            return
        if not 0 <= message.param_index < message.param_count:
            return  # the echo of a change has no index
        if self._count != message.param_count:
            self._count, self._heard, self.values = message.param_count, set(), {}  # a mode or frame was changed
        if message.param_index not in self._heard:
            self._new_s = now_s
        self._heard.add(message.param_index)
        value = decode(message.param_value, message.param_type, bytewise=self._bytewise)
        if math.isfinite(value):
            self.values[name_of(message)] = value

    def due(self, now_s: float) -> list[Message]:
        """Requests that are due."""
        if self.complete:
            return []
        if self._count is None:
            if now_s - self._asked_s < _LIST_S:
                return []
            self._asked_s = now_s
            return [dialect.MAVLink_param_request_list_message(*self._target)]
        if now_s - max(self._new_s, self._asked_s) < _QUIET_S:
            return []
        self._asked_s = now_s
        missing = [index for index in range(self._count) if index not in self._heard]
        ask = dialect.MAVLink_param_request_read_message
        return [ask(*self._target, b"", index) for index in missing[:_AT_ONCE]]
