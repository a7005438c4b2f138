"""One whole frame of a message without texts, as samples and motor outputs are: decoded to the message that the
generated dialect makes of it, in a third of the time (that copies the frame eight times, and orders and assigns the
fields one by one), and encoded to the same bytes.
"""

from __future__ import annotations

from operator import attrgetter
from types import ModuleType
from typing import Any

from fastcrc.crc16 import mcrf4xx

_HEADER, _CHECKSUM = 10, 2
_MAVLINK_2 = 0xFD


class Format:
    """Layout of one message."""

    def __init__(self, kind: Any, dialect: ModuleType) -> None:
        self._kind, self._header, self._extra = kind, dialect.MAVLink_header, bytes([kind.crc_extra])
        self._unpacker, self._whole = kind.unpacker, kind.unpacker.size + _HEADER + _CHECKSUM
        self._attributes = vars(kind(*[0] * len(kind.orders)))
        self._names: list[str] = []  # of each number as on the wire
        self._arrays: list[tuple[str, slice]] = []
        for name, length in zip(kind.ordered_fieldnames, kind.lengths, strict=True):
            if length > 1:
                self._arrays.append((name, slice(len(self._names), len(self._names) + length)))
            self._names += [name] * length
        # Of what is sent: each field's name, an array's numbers in its place.
        self._field = attrgetter(*kind.ordered_fieldnames)
        self._single, self._lengths = len(kind.orders) == 1, kind.array_lengths
        self._number = kind.id.to_bytes(3, "little")

    def encode(self, message: Any, sequence: int, system: int, component: int) -> bytes:
        """The unsigned MAVLink 2 frame. Raises struct.error, OverflowError for what a field cannot hold."""
        fields = self._field(message)
        if self._single:
            fields = (fields,)
        numbers: list[Any] = []
        for field, length in zip(fields, self._lengths, strict=True):
            if length:
                numbers += field
            else:
                numbers.append(field)
        payload = self._unpacker.pack(*numbers).rstrip(b"\0") or b"\0"  # zeros at its end are not sent
        body = bytes((len(payload), 0, 0, sequence, system, component)) + self._number + payload
        checksum = mcrf4xx(body + self._extra)
        return b"%c%b%c%c" % (_MAVLINK_2, body, checksum & 0xFF, checksum >> 8)

    def decode(self, frame: bytes) -> Any | None:
        """The message of an unsigned MAVLink 2 ``frame`` whose length fits its header; None: the checksum is wrong."""
        checksum = mcrf4xx(frame[1:-_CHECKSUM] + self._extra)
        if checksum != frame[-2] | frame[-1] << 8:
            return None
        missing = self._whole - len(frame)  # zeros at the end of a payload are not sent
        whole = frame if missing <= 0 else frame[:-_CHECKSUM] + bytes(missing)
        message = self._kind.__new__(self._kind)
        attributes = message.__dict__
        attributes.update(self._attributes)
        numbers = self._unpacker.unpack_from(whole, _HEADER)
        attributes.update(zip(self._names, numbers, strict=True))
        for name, part in self._arrays:
            attributes[name] = list(numbers[part])
        buffer = bytearray(frame)
        message._msgbuf, message._payload, message._crc = buffer, buffer[6:-_CHECKSUM], checksum
        message._header = self._header(self._kind.id, frame[2], frame[3], frame[1], frame[4], frame[5], frame[6])
        return message


def formats(dialect: ModuleType) -> dict[int, Format]:
    """Those of all messages of ``dialect`` that hold no text, by message id."""
    return {
        number: Format(kind, dialect) for number, kind in dialect.mavlink_map.items() if b"c" not in kind.native_format
    }
