"""Parameters of the autopilot, read one by one until all are known."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable

from nff_companion.mavlink.codec import Message, dialect

_RETRY_S = 0.25
_TRIES = 6
_LATER_S = 3.0
_IN_FLIGHT = 5
_INTEGERS = {
    dialect.MAV_PARAM_TYPE_UINT8: "B",
    dialect.MAV_PARAM_TYPE_INT8: "b",
    dialect.MAV_PARAM_TYPE_UINT16: "H",
    dialect.MAV_PARAM_TYPE_INT16: "h",
    dialect.MAV_PARAM_TYPE_UINT32: "I",
    dialect.MAV_PARAM_TYPE_INT32: "i",
}


def name_of(message: Message) -> str:
    """Parameter name of a PARAM_* message."""
    text = message.param_id
    return text.decode(errors="replace").rstrip("\0") if isinstance(text, bytes) else str(text).rstrip("\0")


def decode(value: float, kind: int, *, bytewise: bool) -> float:
    """Value of a PARAM_VALUE: PX4 puts the bytes of an integer into the float, ArduPilot its value."""
    if bytewise and kind in _INTEGERS:
        raw = struct.pack("<f", value)
        return float(struct.unpack_from(f"<{_INTEGERS[kind]}", raw)[0])
    return float(value)


def encode(value: float, kind: int, *, bytewise: bool) -> float:
    """The float that carries ``value`` in a PARAM_SET."""
    if bytewise and kind in _INTEGERS:
        raw = struct.pack(f"<{_INTEGERS[kind]}", round(value)).ljust(4, b"\0")
        return float(struct.unpack("<f", raw)[0])
    return float(value)


class ParameterReader:
    """Asks for ``names`` until each has been answered or is known to be absent. Time is any monotonic clock."""

    def __init__(self, names: Iterable[str], target: tuple[int, int], *, bytewise: bool) -> None:
        self._target, self._bytewise = target, bytewise
        self._wanted = {name: (0, -float("inf")) for name in names}  # tries, time of the last
        self.values: dict[str, float] = {}
        self.kinds: dict[str, int] = {}
        self._complete = False

    def want(self, names: Iterable[str]) -> None:
        """These too."""
        for name in names:
            if name not in self._wanted:
                self._wanted[name] = (0, -float("inf"))
                self._complete = False

    def observe(self, message: Message) -> str | None:
        """Take a PARAM_VALUE; its name when it is one of ours and a number."""
        name = name_of(message)
        if name not in self._wanted:
            return None
        value = decode(message.param_value, message.param_type, bytewise=self._bytewise)
        if not math.isfinite(value):
            return None  # as if it had not been answered: it is asked for again, and missed
        self.values[name] = value
        self.kinds[name] = message.param_type
        return name

    @property
    def complete(self) -> bool:
        """Whether every parameter was answered, or asked for often enough to count as absent."""
        if not self._complete:
            self._complete = all(n in self.values or tries >= _TRIES for n, (tries, _) in self._wanted.items())
        return self._complete

    @property
    def absent(self) -> list[str]:
        """Parameters that the autopilot has not answered for; they are asked for again now and then."""
        if len(self.values) == len(self._wanted):
            return []
        return [n for n, (tries, _) in self._wanted.items() if n not in self.values and tries >= _TRIES]

    def tick(self, now_s: float) -> list[Message]:
        """Requests that are due."""
        out: list[Message] = []
        if len(self.values) == len(self._wanted):
            return out
        for name, (tries, last) in self._wanted.items():
            if name in self.values:
                continue
            wait_s = _RETRY_S if tries < _TRIES else _LATER_S  # a busy autopilot drops answers without a word
            if now_s - last >= wait_s and len(out) < _IN_FLIGHT:
                self._wanted[name] = (tries + 1, now_s)
                out.append(dialect.MAVLink_param_request_read_message(*self._target, name.encode(), -1))
        return out
