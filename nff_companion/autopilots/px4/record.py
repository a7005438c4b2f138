"""When the journal is tried, written and cleared: tried at the start, written at arming, cleared when all is undone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nff_companion.autopilots.px4.journal import Entry, Journal
from nff_companion.errors import JournalError

_RETRY_S = 5.0  # a disk that fails may also be slow: not at every turn


class Record:
    """The journal of one vehicle. ``now_s`` is any monotonic clock; nothing here raises."""

    def __init__(self, path: Path) -> None:
        self._journal = Journal(path)
        self.trouble = ""  # why it cannot be written
        self.stays = ""  # why it could not be removed
        self.tried = False
        self.ours = False  # a file is there that this companion wrote or took over
        self._covered: Mapping[str, float] | None = None
        self._next_try_s = self._next_clear_s = -np.inf

    def read(self, autopilot: str) -> list[Entry]:
        """What an earlier run left. Raises JournalError."""
        return self._journal.read(autopilot)

    def take_over(self, found: Mapping[str, float]) -> None:
        """The file that is there belongs to these values."""
        self.ours, self._covered = True, found

    def covers(self, found: Mapping[str, float]) -> bool:
        """Whether these very values are on the disk."""
        return self._covered is found

    def try_out(self, now_s: float) -> None:
        """At the start, and while it cannot be written: whether it can."""
        if (self.tried and not self.trouble) or now_s < self._next_try_s:
            return
        self.tried, self._next_try_s = True, now_s + _RETRY_S
        try:
            self._journal.probe()
            self.trouble = ""
        except JournalError as error:
            self.trouble = str(error)

    def write(self, autopilot: str, found: Mapping[str, float], kinds: Mapping[str, int], now_s: float) -> None:
        """Put what was found on the disk, unless it is known that this is impossible."""
        if self.trouble:
            return
        try:
            self._journal.write(autopilot, [Entry(name, value, kinds[name]) for name, value in found.items()])
            self.take_over(found)
        except JournalError as error:
            self.trouble, self._next_try_s = str(error), now_s + _RETRY_S

    def clear(self, now_s: float) -> None:
        """Remove the file, now and then until it is gone."""
        if now_s < self._next_clear_s:
            return
        try:
            self._journal.clear()
            self.ours, self._covered, self.stays = False, None, ""
        except JournalError as error:
            self.stays, self._next_clear_s = str(error), now_s + _RETRY_S
