"""Frames onto a byte stream that does not block: whole and in order, or not at all."""

from __future__ import annotations

from collections.abc import Callable

LIMIT_BYTES = 1024  # a few frames: what waits longer is too old to be worth sending


class SendQueue:
    """What the line did not take at once goes before anything newer; a frame that finds no room is dropped whole.

    ``write`` takes bytes and returns how many of them it took, or raises BlockingIOError; other errors pass through.
    """

    def __init__(self, write: Callable[[bytes], int], limit_bytes: int = LIMIT_BYTES) -> None:
        self._write = write
        self._limit = limit_bytes
        self._waiting = b""

    def send(self, frame: bytes) -> bool:
        """Send ``frame`` after what waits; False when it was dropped."""
        if self._waiting and not self.flush():
            if len(self._waiting) + len(frame) > self._limit:
                return False
            self._waiting += frame
            return True
        self._waiting = frame
        self.flush()
        return True

    def flush(self) -> bool:
        """Write what waits as far as the line takes it; True when nothing remains."""
        while self._waiting:
            try:
                taken = self._write(self._waiting)
            except BlockingIOError:
                taken = 0
            if taken == 0:
                return False
            self._waiting = self._waiting[taken:]
        return True
