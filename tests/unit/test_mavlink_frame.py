"""Frames decoded by our own hand are the messages that the generated dialect makes of them."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.frame import formats

FORMATS = formats(dialect)
LIBRARY = dialect.MAVLink(None, srcSystem=1, srcComponent=1)


def frame_of(kind: Any, payload: bytes, rng: np.random.Generator) -> bytes:
    """A good frame of any payload, cut where it ends in zeros."""
    payload = payload.rstrip(b"\0") or b"\0"
    numbers = rng.integers(0, 256, 4).tolist()
    body = struct.pack("<BBBBBB", len(payload), 0, *numbers) + struct.pack("<I", kind.id)[:3] + payload
    return b"\xfd" + body + struct.pack("<H", dialect.x25crc(body + bytes([kind.crc_extra])).crc)


def described(message: Any) -> str:
    """Every attribute, the header's too; text, so that NaN equals NaN."""
    return repr(sorted((k, v) for k, v in vars(message).items() if k != "_header")) + repr(vars(message._header))


@pytest.mark.parametrize("kind", [dialect.mavlink_map[number] for number in FORMATS], ids=lambda kind: kind.msgname)
def test_a_frame_is_decoded_as_the_library_does(kind: Any, rng: np.random.Generator) -> None:
    size = kind.unpacker.size
    for length in (size, size, max(size // 2, 1), 0, min(size + 7, 255)):  # cut, empty, and with what is appended later
        payload = rng.bytes(length).ljust(size, b"\0")
        frame = frame_of(kind, payload, rng)
        ours, theirs = FORMATS[kind.id].decode(frame), LIBRARY.decode(bytearray(frame))
        assert type(ours) is type(theirs)
        assert described(ours) == described(theirs)


def test_a_changed_bit_anywhere_is_a_bad_frame(rng: np.random.Generator) -> None:
    kind = dialect.MAVLink_highres_imu_message
    frame = frame_of(kind, rng.bytes(kind.unpacker.size), rng)
    for place in range(1, len(frame)):
        changed = bytearray(frame)
        changed[place] ^= 1 << int(rng.integers(8))
        assert FORMATS[kind.id].decode(bytes(changed)) is None


def test_what_holds_texts_is_left_to_the_library() -> None:
    texts = {number for number, kind in dialect.mavlink_map.items() if "char" in kind.fieldtypes}
    assert set(FORMATS) == set(dialect.mavlink_map) - texts
    assert dialect.MAVLINK_MSG_ID_STATUSTEXT in texts


@pytest.mark.parametrize("kind", [dialect.mavlink_map[number] for number in FORMATS], ids=lambda kind: kind.msgname)
def test_a_message_is_encoded_as_the_library_does(kind: Any, rng: np.random.Generator) -> None:
    size = kind.unpacker.size
    for length in (size, size, size // 2, 0):  # what ends in zeros is cut
        message = LIBRARY.decode(bytearray(frame_of(kind, rng.bytes(length).ljust(size, b"\0"), rng)))
        sequence, system, component = rng.integers(0, 256, 3).tolist()
        library = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        library.seq = sequence
        assert FORMATS[kind.id].encode(message, sequence, system, component) == message.pack(library)


@pytest.mark.parametrize(
    ("field", "value"),
    [("target_system", 256), ("target_system", -1), ("target_system", 0.5), ("sample_usec", None), ("outputs", [0.5])],
)
def test_what_a_field_cannot_hold_is_refused(field: str, value: object) -> None:
    message = dialect.MAVLink_nff_actuator_override_message(1, 1, 100, 1, 1, 8, [0.5] * 16)
    assert hasattr(message, field)
    setattr(message, field, value)
    with pytest.raises((struct.error, OverflowError)):
        FORMATS[message.id].encode(message, 0, 1, 1)
