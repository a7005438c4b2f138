"""MAVLink framing with our dialect: buffers in, messages out, and back. Never sees a socket.

The frames are found here; those without texts are decoded and encoded in ``frame``, all others by the generated
dialect. Its own parser believes every header: two bytes of garbage make it swallow all frames of the next 267 bytes.
"""

from __future__ import annotations

import importlib
import os
import re
import struct
from types import ModuleType
from typing import Any

from nff_companion.mavlink.frame import formats

os.environ.setdefault("MAVLINK20", "1")
try:
    dialect: ModuleType = importlib.import_module("nff_companion.mavlink.dialect.nff")
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "the MAVLink dialect module is missing: run `make env`, or `python mavlink_dialect/generate.py`"
    ) from error

Message = Any
COMPANION_COMPONENT = 191

# https://mavlink.io/en/guide/serialization.html
_V1, _V2 = 0xFE, 0xFD
_HEADER_V1, _HEADER_V2 = 6, 10
_CHECKSUM, _SIGNATURE = 2, 13
_OVERHEAD_V2 = _HEADER_V2 + _CHECKSUM
_LONGEST = _OVERHEAD_V2 + 255 + _SIGNATURE
_SIGNED = 0x01
_TRIES = 256  # false headers in a row after which a datagram is given up: they cost more time than frames
_START = re.compile(b"[\xfd\xfe]")
_FORMATS = formats(dialect)


class Codec:
    """Parser and packer of one link; counts what did not parse."""

    def __init__(self, system: int, component: int) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._left = b""  # of a stream: a frame that has begun
        self._counted = 0  # bytes of it that belong to a bad frame which was counted
        self.bad_frames = 0

    @property
    def system(self) -> int:
        """Our system id."""
        return int(self._mav.srcSystem)

    @system.setter
    def system(self, value: int) -> None:
        self._mav.srcSystem = value

    @property
    def component(self) -> int:
        """Our component id."""
        return int(self._mav.srcComponent)

    def parse(self, data: bytes) -> list[Message]:
        """Messages complete with ``data``, the next piece of a stream; what does not parse is counted and passed over.

        A false header delays the frames that it spans, until its checksum has been seen to fail; none is lost.
        """
        message = None if self._left else self._only(data)
        if message is not None:
            self._counted = 0
            return [message]
        return self._scan(self._left + data, last=False)

    def parse_datagram(self, data: bytes) -> list[Message]:
        """Messages of one datagram. A frame does not continue in the next one: what is incomplete is a bad frame."""
        message = self._only(data)
        if message is not None:
            return [message]
        kept = self._left, self._counted
        self._counted = 0
        out = self._scan(data, last=True)
        self._left, self._counted = kept
        return out

    def forget(self) -> None:
        """The stream starts anew: what has begun in it is not continued."""
        self._left, self._counted = b"", 0

    def pack(self, message: Message) -> bytes:
        """Frame with the next sequence number. Raises struct.error, OverflowError for what a field cannot hold."""
        mav = self._mav
        known = _FORMATS.get(message.get_msgId())
        if known is None:
            data = bytes(message.pack(mav))
        else:
            data = known.encode(message, mav.seq, mav.srcSystem, mav.srcComponent)
        mav.seq = (mav.seq + 1) % 256
        return data

    # -- frames -------------------------------------------------------------------------------------------------

    def _only(self, data: bytes) -> Message | None:
        """The message when ``data`` is one good unsigned MAVLink 2 frame and nothing else, as is the rule on UDP."""
        if len(data) < _OVERHEAD_V2 or data[0] != _V2 or data[2] or len(data) != data[1] + _OVERHEAD_V2:
            return None
        return self._decode(data)

    def _scan(self, data: bytes, *, last: bool) -> list[Message]:
        """Messages within ``data``; a frame that has begun at its end is kept, unless that is the ``last`` of it."""
        out: list[Message] = []
        at, end, tries = 0, len(data), _TRIES
        while at < end:
            if data[at] != _V2 and data[at] != _V1:
                header = _START.search(data, at)
                start, at = at, end if header is None else header.start()
                self._bad(start, at)
                continue
            if last and tries == 0:
                self._bad(at, end)
                at = end
                break
            tries -= 1
            size, known = _header(data, at)
            whole = size <= end - at
            if known and not whole and not last:
                break
            if size == 0 or (last and not whole):
                self._bad(at, at + 1)
            elif not known:
                # Its checksum cannot be known: no bad frame, but perhaps no frame either, and what it spans is seen.
                self._counted = max(self._counted, at + size)
            else:
                message = self._decode(data[at : at + size])
                if message is not None:
                    out.append(message)
                    at, self._counted, tries = at + size, 0, _TRIES
                    continue
                self._bad(at, at + size, whole=True)
            at += 1
        self._left, self._counted = data[at:], max(self._counted - at, 0)
        return out

    def _bad(self, start: int, end: int, *, whole: bool = False) -> None:
        """Count what is no frame, once with what it lies in or adjoins; a ``whole`` frame adjoins nothing."""
        if not self._counted or start > self._counted - whole:
            self.bad_frames += 1
        self._counted = max(self._counted, end)

    def _decode(self, frame: bytes) -> Message | None:
        """The message; None when the checksum or the content is wrong, or its id unknown."""
        if frame[0] == _V2 and not frame[2]:
            known = _FORMATS.get(frame[7] | frame[8] << 8 | frame[9] << 16)
            if known is not None:
                return known.decode(frame)
        try:
            message = self._mav.decode(bytearray(frame))
        except (dialect.MAVError, struct.error):
            return None
        return None if type(message) is dialect.MAVLink_unknown else message


def _header(data: bytes, at: int) -> tuple[int, bool]:
    """(length of the frame, whether its message is known) by the header at ``at``; length 0: this is none.

    A header that is cut off may become the longest of frames.
    """
    have = len(data) - at
    if data[at] == _V1:
        if have < _HEADER_V1:
            return _LONGEST, True
        return data[at + 1] + _HEADER_V1 + _CHECKSUM, data[at + 5] in dialect.mavlink_map
    if have >= 3 and data[at + 2] & ~_SIGNED:
        return 0, False  # flags that must be understood, and are not
    if have < _HEADER_V2:
        return _LONGEST, True
    signature = _SIGNATURE if data[at + 2] else 0
    known = int.from_bytes(data[at + 7 : at + 10], "little") in dialect.mavlink_map
    return data[at + 1] + _OVERHEAD_V2 + signature, known
