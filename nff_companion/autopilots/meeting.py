"""Which adapter for the autopilot that was heard."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from nff_companion.allocation import allocator, tables
from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.base import Adapter
from nff_companion.autopilots.nff import NffAdapter
from nff_companion.autopilots.px4.adapter import Method, Px4Adapter
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect

Kind = Literal["nff", "ardupilot", "px4"]
Choice = Literal["auto", "nff", "ardupilot", "px4"]
_BY_AUTOPILOT: dict[int, Kind] = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
    dialect.MAV_AUTOPILOT_PX4: "px4",
    dialect.MAV_AUTOPILOT_GENERIC: "nff",
}


class Meeting:
    """Makes adapters for one vehicle; allocations ahead of time are computed once, at start."""

    def __init__(
        self,
        vehicle: Vehicle,
        choice: Choice,
        method: str,
        journal: Path,
        px4_method: Method = "scale",
        *,
        instance: int = 1,
        plans: dict[int, Plan] | None = None,
    ) -> None:
        """``instance`` tells companions apart; ``plans`` that exist already need not be computed again."""
        self._vehicle, self._choice, self._journal, self._px4_method = vehicle, choice, journal, px4_method
        self.instance = instance
        ahead = choice in ("auto", "ardupilot") and plans is None
        self._plans = tables.compute(vehicle, allocator(method)) if ahead else plans or {}

    def kind(self, autopilot: int, *, speaks_our_dialect: bool) -> Kind | None:
        """Adapter for an autopilot of this MAV_AUTOPILOT; None for one that cannot be served."""
        if self._choice != "auto":
            return self._choice
        return "nff" if speaks_our_dialect else _BY_AUTOPILOT.get(autopilot)

    def adapter(self, kind: Kind, target: tuple[int, int]) -> Adapter:
        """A new one, that knows nothing of its autopilot yet."""
        if kind == "ardupilot":
            return ArduPilotAdapter(self._vehicle, target, self._plans, self.instance)
        if kind == "px4":
            return Px4Adapter(self._vehicle, target, self._journal, self._px4_method)
        return NffAdapter(self._vehicle, target)
