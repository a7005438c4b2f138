"""What goes through TUNNEL between the companion and the applet; ``lua/modules/nff_protocol.lua`` is its twin.

Little endian. Every message: version u8 (2), kind u8, the fields below, what repeats, check u16 over all before it
(ArduPilot hands frames with a wrong CRC to scripts too), end mark u8 (0xA5: MAVLink 2 cuts trailing zeros). Sequence
numbers are u16 and wrap; ``instance`` is drawn by each companion at its start and never 0; ``sample_ms`` is the time
since the autopilot's boot of the telemetry sample that a command answers.

| kind | to | fields |
|---|---|---|
| 1 HEARTBEAT | autopilot | sequence u16, instance u16 |
| 2 TABLE | autopilot | sequence u16, instance u16, failed u16, motors u8, factors |
| 3 DECLARATION | autopilot | sequence u16, instance u16, sample_ms u32, failed u16 |
| 4 MATRIX | autopilot | sequence u16, instance u16, sample_ms u32, timeout_ms u16, failed u16, flags u8, motors u8, |
|     |           | factors |
| 5 RELEASE | autopilot | sequence u16, instance u16, sample_ms u32, flags u8 |
| 6 OVERRIDE | autopilot | sequence u16, instance u16, sample_ms u32, timeout_ms u16, motors u8, pwm |
| 129 APPLIED | companion | sequence u16, time_ms u32, boot_ms u32, owner u16, declaration u16, matrix u16 and |
|     |           | override u16 sequence, failed u16, source u8, flags u8, motors u8, tables u8, stock_check u16, |
|     |           | tables_check u16, table u16, table_check u16, accepted u16, refused u16 [9] |
| 130 STORED | companion | sequence u16, failed u16, check u16 |

``failed`` is a mask, bit 0 motor 1. ``factors`` are i16 [motors][4], 1/4096 of ArduPilot's mixer units, columns
throttle, roll, pitch, yaw; ``pwm`` is u16 [motors] in microseconds, 0: left to the mixer. Flags of MATRIX: 1 yaw given
up; of RELEASE: 1 the companion leaves; of APPLIED: :class:`Flag`. Source: 0 stock, 1 declaration, 2 matrix,
3 override. ``owner``: the instance that is obeyed, 0 nobody. ``stock_check``: of the table of no failure;
``tables_check``: of all others together, once Flag.CHECKED is set; ``table`` and ``table_check``: one of them, another
in each message. Refused: `REFUSALS`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import TunnelError
from nff_companion.mavlink.codec import Message, dialect

VERSION = 2
TO_AUTOPILOT, TO_COMPANION = 54100, 54101
FACTOR_SCALE = 4096
FACTOR_MAX = 32767 / FACTOR_SCALE
REFUSALS = ("range", "format", "stale", "replay", "dimension", "disarmed", "unsupported", "armed", "occupied")
YAW_RELEASED = 1  # flag of MATRIX
LEAVING = 1  # flag of RELEASE
_END = 0xA5
_TAIL = 3  # check and end mark
_PAYLOAD = 128
_MILLISECONDS = 2**31  # integers of the applet have 32 bits, and a sign
_SEQUENCES = 2**16
_CHECKS = 65521  # prime


class Kind(IntEnum):
    """Second byte of a message."""

    HEARTBEAT = 1
    TABLE = 2
    DECLARATION = 3
    MATRIX = 4
    RELEASE = 5
    OVERRIDE = 6
    APPLIED = 129
    STORED = 130


class Flag(IntEnum):
    """Bits of ``flags`` in APPLIED."""

    ARMED = 1
    MATRIX = 2
    WATCHDOG = 4
    LINK = 8
    YAW_RELEASED = 16  # of the matrix in force
    CHECKED = 32  # tables_check is complete


_LAYOUTS: dict[Kind, tuple[str, tuple[str, ...]]] = {
    Kind.HEARTBEAT: ("HH", ("sequence", "instance")),
    Kind.TABLE: ("HHHB", ("sequence", "instance", "failed", "motors")),
    Kind.DECLARATION: ("HHIH", ("sequence", "instance", "sample_ms", "failed")),
    Kind.MATRIX: ("HHIHHBB", ("sequence", "instance", "sample_ms", "timeout_ms", "failed", "flags", "motors")),
    Kind.RELEASE: ("HHIB", ("sequence", "instance", "sample_ms", "flags")),
    Kind.OVERRIDE: ("HHIHB", ("sequence", "instance", "sample_ms", "timeout_ms", "motors")),
    Kind.APPLIED: (
        "HIIHHHHHBBBBHHHHH9H",
        (
            "sequence",
            "time_ms",
            "boot_ms",
            "owner",
            "declaration_sequence",
            "matrix_sequence",
            "override_sequence",
            "failed",
            "source",
            "flags",
            "motors",
            "tables",
            "stock_check",
            "tables_check",
            "table",
            "table_check",
            "accepted",
            *REFUSALS,
        ),
    ),
    Kind.STORED: ("HHH", ("sequence", "failed", "check")),
}
_FACTORS = (Kind.TABLE, Kind.MATRIX)


@dataclass(slots=True)
class TunnelMessage:
    """One message: its ``values`` by field name; ``factors`` (m, 4) int16 or ``pwm`` (m,) where its kind has them."""

    kind: Kind
    values: dict[str, int] = field(default_factory=dict)
    factors: NDArray[np.int16] | None = None
    pwm: NDArray[np.uint16] | None = None

    def pack(self) -> bytes:
        """Bytes. Raises TunnelError when a field is missing or does not fit."""
        layout, names = _LAYOUTS[self.kind]
        values = dict(self.values)
        rest = b""
        if self.kind in _FACTORS:
            if self.factors is None:
                raise TunnelError(f"{self.kind.name} has no factors")
            values.setdefault("motors", len(self.factors))
            rest = table_bytes(self.factors)
        elif self.kind == Kind.OVERRIDE:
            if self.pwm is None:
                raise TunnelError("OVERRIDE has no pwm")
            values.setdefault("motors", len(self.pwm))
            rest = np.ascontiguousarray(self.pwm, "<u2").tobytes()
        try:
            fixed = struct.pack(f"<BB{layout}", VERSION, self.kind, *(values[name] for name in names))
        except (struct.error, KeyError) as error:
            raise TunnelError(f"{self.kind.name} cannot be packed: {error}") from error
        body = fixed + rest
        data = body + struct.pack("<HB", check(body), _END)
        if len(data) > _PAYLOAD:
            raise TunnelError(f"{self.kind.name} has {len(data)} bytes, at most {_PAYLOAD} fit")
        return data


def unpack(data: bytes) -> TunnelMessage:
    """A message from its bytes. Raises TunnelError that says what is wrong with them."""
    if len(data) < 2 + _TAIL or data[-1] != _END:
        raise TunnelError(f"message of {len(data)} bytes without its end mark: cut off on the way")
    if data[0] != VERSION:
        raise TunnelError(f"protocol version {data[0]}, expected {VERSION}: install the applet of this release")
    try:
        kind = Kind(data[1])
    except ValueError:
        raise TunnelError(f"kind {data[1]} is unknown") from None
    layout, names = _LAYOUTS[kind]
    size = 2 + struct.calcsize(f"<{layout}")
    if len(data) < size + _TAIL:
        raise TunnelError(f"{kind.name} has {len(data)} bytes, at least {size + _TAIL} are needed")
    if struct.unpack_from("<H", data, len(data) - _TAIL)[0] != check(data[:-_TAIL]):
        raise TunnelError(f"{kind.name} was changed on the way: its check does not agree")
    message = TunnelMessage(kind, dict(zip(names, struct.unpack_from(f"<{layout}", data, 2), strict=True)))
    rest = data[size:-_TAIL]
    width = 8 if kind in _FACTORS else 2 if kind == Kind.OVERRIDE else 0
    if len(rest) != message.values.get("motors", 0) * width:
        raise TunnelError(f"{kind.name} for {message.values.get('motors', 0)} motors carries {len(rest)} bytes")
    if kind in _FACTORS:
        message.factors = np.frombuffer(rest, "<i2").reshape(-1, 4)
    elif kind == Kind.OVERRIDE:
        message.pwm = np.frombuffer(rest, "<u2")
    return message


def wrap(data: bytes, target: tuple[int, int], payload_type: int = TO_AUTOPILOT) -> Message:
    """TUNNEL message to ``target`` (system, component)."""
    padded = data + bytes(_PAYLOAD - len(data))
    return dialect.MAVLink_tunnel_message(*target, payload_type, len(data), list(padded))


def unwrap(message: Message, payload_type: int = TO_COMPANION) -> TunnelMessage | None:
    """Our message in a TUNNEL, None when it carries somebody else's. Raises TunnelError."""
    if message.payload_type != payload_type:
        return None
    return unpack(bytes(message.payload[: min(message.payload_length, _PAYLOAD)]))


def check(data: bytes) -> int:
    """Sum over bytes that shows changes on the way, and tells tables apart."""
    total = 1
    for byte in data:
        total = (total * 31 + byte) % _CHECKS
    return total


def table_bytes(table: NDArray[np.int16]) -> bytes:
    """Bytes of factors (m, 4) int16, as they are stored."""
    return np.ascontiguousarray(table, "<i2").tobytes()


def table_check(failed: int, table: bytes) -> int:
    """Of one table and the mask that it is for: multiplied, so that two tables that change places are seen."""
    return check(table) * (failed + 1) % _CHECKS


def tables_check(tables: Mapping[int, bytes]) -> int:
    """Of all tables by failed mask, but that of no failure; in any order, so that one can be replaced."""
    return sum(table_check(failed, table) for failed, table in tables.items() if failed) % _CHECKS


def milliseconds(time_s: float) -> int:
    """A time of the autopilot's clock as the protocol carries it."""
    return max(round(1e3 * time_s), 0) % _MILLISECONDS


def following(sequence: int) -> int:
    """The next sequence number."""
    return (sequence + 1) % _SEQUENCES
