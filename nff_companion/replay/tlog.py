"""MAVLink telemetry logs (.tlog): 8 bytes big-endian microseconds of arrival, then the frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError
from nff_companion.mavlink.codec import Codec, Message, dialect

_STAMP = struct.Struct(">Q")
_V1, _V2 = 0xFE, 0xFD
_SIGNATURE = 13
_SIGNED = 0x01


def frames(path: Path) -> Iterator[tuple[float, bytes]]:
    """(arrival in s since 1970, frame) of each record. Raises LogError when the file is not a tlog."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    at = 0
    while at + _STAMP.size + 8 <= len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        start = at + _STAMP.size
        magic, length = data[start], data[start + 1]
        if magic == _V2:
            size = length + 12 + (_SIGNATURE if data[start + 2] & _SIGNED else 0)
        elif magic == _V1:
            size = length + 8
        else:
            raise LogError(f"{path}: no MAVLink frame at byte {start}; is it a tlog?")
        if start + size > len(data):
            return
        yield 1e-6 * stamp, data[start : start + size]
        at = start + size
    if at == 0:
        raise LogError(f"{path} holds no record; is it a tlog?")


def messages(path: Path) -> Iterator[tuple[float, Message]]:
    """(arrival in s, message) of each frame of an autopilot that our dialect knows."""
    codec = Codec(255, dialect.MAV_COMP_ID_MISSIONPLANNER)
    for stamp, frame in frames(path):
        for message in codec.parse(frame):
            if message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
                yield stamp, message


def samples(path: Path, vehicle: Vehicle) -> Iterator[tuple[float, Sample]]:
    """(arrival in s, sample), by the decoder of the live link."""
    decoder = TelemetryDecoder(vehicle)
    for stamp, message in messages(path):
        sample = decoder.observe(message)
        if sample is not None:
            yield stamp, sample


def first_stamp(path: Path) -> float:
    """Arrival of the first record, s since 1970."""
    return next(frames(path))[0]
