"""What goes through TUNNEL between the companion and the applet; ``lua/modules/nff_protocol.lua`` is its twin.

Little endian. Every message: version u8 (1), kind u8, the fields below, what repeats, check u16 over all before it
(ArduPilot hands frames with a wrong CRC to scripts too), end mark u8 (0xA5: MAVLink 2 cuts trailing zeros). Sequence
numbers are u16 and wrap; ``sample_ms`` is the time since the autopilot's boot of the telemetry sample that a command
answers.

| kind | to | fields |
|---|---|---|
| 1 HEARTBEAT | autopilot | sequence u16, mode u8 |
| 2 TABLE | autopilot | sequence u16, failed u16, flags u8, motors u8, factors |
| 3 DECLARATION | autopilot | sequence u16, sample_ms u32, failed u16 |
| 4 MATRIX | autopilot | sequence u16, sample_ms u32, timeout_ms u16, failed u16, flags u8, motors u8, factors |
| 5 RELEASE | autopilot | sequence u16, sample_ms u32 |
| 6 OVERRIDE | autopilot | sequence u16, sample_ms u32, timeout_ms u16, motors u8, pwm |
| 129 APPLIED | companion | sequence u16, time_ms u32, boot_ms u32, declaration u16, matrix u16 and override u16 |
|     |           | sequence, failed u16, source u8, flags u8, motors u8, tables u8, accepted u16, refused u16 [7] |
| 130 STORED | companion | sequence u16, failed u16, check u16 |

``failed`` is a mask, bit 0 motor 1. ``factors`` are i16 [motors][4], 1/4096 of ArduPilot's mixer units, columns
throttle, roll, pitch, yaw; ``pwm`` is u16 [motors] in microseconds, 0: left to the mixer. Flags of TABLE and MATRIX:
1 yaw given up; of APPLIED: :class:`Flag`. Source: 0 stock, 1 declaration, 2 matrix, 3 override. Refused: `REFUSALS`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from nff_companion.errors import TunnelError
from nff_companion.mavlink.codec import Message, dialect

VERSION = 1
TO_AUTOPILOT, TO_COMPANION = 54100, 54101
FACTOR_SCALE = 4096
FACTOR_MAX = 32767 / FACTOR_SCALE
REFUSALS = ("range", "format", "stale", "replay", "dimension", "disarmed", "unsupported")
_END = 0xA5
_TAIL = 3  # check and end mark
_PAYLOAD = 128
_MILLISECONDS = 2**31  # integers of the applet have 32 bits, and a sign
_SEQUENCES = 2**16


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


_LAYOUTS: dict[Kind, tuple[str, tuple[str, ...]]] = {
    Kind.HEARTBEAT: ("HB", ("sequence", "mode")),
    Kind.TABLE: ("HHBB", ("sequence", "failed", "flags", "motors")),
    Kind.DECLARATION: ("HIH", ("sequence", "sample_ms", "failed")),
    Kind.MATRIX: ("HIHHBB", ("sequence", "sample_ms", "timeout_ms", "failed", "flags", "motors")),
    Kind.RELEASE: ("HI", ("sequence", "sample_ms")),
    Kind.OVERRIDE: ("HIHB", ("sequence", "sample_ms", "timeout_ms", "motors")),
    Kind.APPLIED: (
        "HIIHHHHBBBBH7H",
        (
            "sequence",
            "time_ms",
            "boot_ms",
            "declaration_sequence",
            "matrix_sequence",
            "override_sequence",
            "failed",
            "source",
            "flags",
            "motors",
            "tables",
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
    factors: np.ndarray | None = None
    pwm: np.ndarray | None = None

    def pack(self) -> bytes:
        """Bytes. Raises TunnelError when a field is missing or does not fit."""
        layout, names = _LAYOUTS[self.kind]
        values = dict(self.values)
        rest = b""
        if self.kind in _FACTORS:
            if self.factors is None:
                raise TunnelError(f"{self.kind.name} has no factors")
            values.setdefault("motors", len(self.factors))
            rest = np.ascontiguousarray(self.factors, "<i2").tobytes()
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
        total = (total * 31 + byte) % 65521
    return total


def milliseconds(time_s: float) -> int:
    """A time of the autopilot's clock as the protocol carries it."""
    return max(round(1e3 * time_s), 0) % _MILLISECONDS


def following(sequence: int) -> int:
    """The next sequence number."""
    return (sequence + 1) % _SEQUENCES
