"""MAVLink 2 framing with our dialect: buffers in, messages out, and back. Never sees a socket."""

from __future__ import annotations

import importlib
import os
import struct
from types import ModuleType
from typing import Any

os.environ.setdefault("MAVLINK20", "1")
try:
    dialect: ModuleType = importlib.import_module("nff_companion.mavlink.dialect.nff")
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "the MAVLink dialect module is missing: run `make env`, or `python mavlink_dialect/generate.py`"
    ) from error

Message = Any
COMPANION_COMPONENT = 191
_MAGIC, _OVERHEAD = 0xFD, 12  # start of a MAVLink 2 frame; bytes besides its payload


def has_fast_crc() -> bool:
    """Whether the checksum is computed by fastcrc; without it parsing takes four times as long."""
    try:
        importlib.import_module("fastcrc")
    except ImportError:
        return False
    return True


class Codec:
    """Parser and packer of one link; counts what did not parse."""

    def __init__(self, system: int, component: int) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
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
        """Messages complete with ``data``; frames that do not parse are counted and dropped."""
        if self._whole_frame(data):
            # A datagram that is one frame, the rule on UDP, need not go through the byte-wise parser.
            try:
                message = self._mav.decode(bytearray(data))
                return [message] if message.get_msgId() >= 0 else []
            except (dialect.MAVError, struct.error):
                self.bad_frames += 1
                return []
        try:
            messages = self._mav.parse_buffer(data)
        except (dialect.MAVError, struct.error):
            self.bad_frames += 1
            return []
        if not messages:
            return []
        good = [m for m in messages if m.get_msgId() >= 0]
        self.bad_frames += len(messages) - len(good)
        return good

    def _whole_frame(self, data: bytes) -> bool:
        """Whether ``data`` is exactly one unsigned MAVLink 2 frame, and the parser has nothing left over."""
        return (
            len(data) > _OVERHEAD
            and data[0] == _MAGIC
            and data[2] == 0
            and len(data) == data[1] + _OVERHEAD
            and self._mav.buf_len() == 0
        )

    def pack(self, message: Message) -> bytes:
        """Frame with the next sequence number."""
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return bytes(data)
