"""What is on the autopilot's card, by the applet's word, against what the airframe file says. Compared by checks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot import factors, tunnel
from nff_companion.autopilots.ardupilot.tunnel import Flag
from nff_companion.core.vehicle import Vehicle

_INTERVAL_S = 0.02  # between two tables
_RETRY_S = 0.5  # the same one again, when its arrival is not confirmed


class Card:
    """Tables by failed mask. The one of no failure is compared and never replaced. ``now_s`` of our clock."""

    def __init__(self, vehicle: Vehicle, plans: dict[int, Plan]) -> None:
        tables = factors.of_plans(vehicle, plans)
        self._stock_check = tunnel.check(tunnel.table_bytes(tables.pop(0)))
        self._tables = tables
        packed = {mask: tunnel.table_bytes(table) for mask, table in tables.items()}
        self._ours = {mask: tunnel.table_check(mask, table) for mask, table in packed.items()}
        self._ours_together = tunnel.tables_check(packed)
        self._without_yaw = {mask for mask in tables if plans[mask].released}
        self._sent_s = dict.fromkeys(tables, -np.inf)
        self._next_s = -np.inf
        self._theirs: dict[int, int] = {}
        self._count: int | None = None  # of their tables; None: not said
        self._checked = False  # the applet has looked at all of them
        self.stock_agrees: bool | None = None  # None: not said
        self.agrees = False  # all tables do

    def restarted(self) -> None:
        """The applet begins anew: what it had been given is gone."""
        self._theirs.clear()
        self._count, self._checked, self.stock_agrees, self.agrees = None, False, None, False
        self._sent_s = dict.fromkeys(self._tables, -np.inf)

    def heard(self, applied: Mapping[str, int]) -> None:
        """Take an APPLIED."""
        self.stock_agrees = applied["stock_check"] == self._stock_check
        self._count = applied["tables"] - 1
        agreed = self.agrees
        self._checked = bool(applied["flags"] & Flag.CHECKED)
        self.agrees = self._checked and applied["tables_check"] == self._ours_together
        if self.agrees:
            self._theirs = dict(self._ours)
            return
        if agreed:
            self._theirs.clear()  # somebody else has replaced some
        if applied["table"]:
            self._theirs[applied["table"]] = applied["table_check"]

    def stored(self, values: Mapping[str, int]) -> None:
        """Take a STORED."""
        self._theirs[values["failed"]] = values["check"]

    def differing(self) -> list[int]:
        """Masks whose table is known to be another one, or not there."""
        if self.agrees:
            return []
        all_named = self._count is not None and len(self._theirs) >= self._count
        return [
            mask for mask, check in self._ours.items() if self._theirs.get(mask, None if all_named else check) != check
        ]

    def without_yaw(self, failed: int) -> bool:
        """Whether the table of these motors gives up yaw."""
        return failed in self._without_yaw

    def report(self) -> str:
        """How many tables agree, in words."""
        equal = sum(self._theirs.get(mask) == check for mask, check in self._ours.items())
        text = f"{equal} of {len(self._ours)} are those of this airframe file"
        more = sum(mask not in self._ours for mask in self._theirs)
        text += f", {more} more are on the card" if more else ""
        if self.agrees:
            return text
        return f"{text}: install again" if self._checked else f"{text} so far: they are being compared"

    def upload(self, now_s: float) -> tuple[int, NDArray[np.int16]] | None:
        """The next table (m, 4) int16 to be sent, with its mask; None when none is due."""
        if now_s < self._next_s:
            return None
        for mask in self.differing():
            if now_s - self._sent_s[mask] >= _RETRY_S:
                self._sent_s[mask], self._next_s = now_s, now_s + _INTERVAL_S
                return mask, self._tables[mask]
        return None
