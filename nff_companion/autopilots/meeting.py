"""Which adapter for the autopilot that was heard."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from nff_companion.allocation import allocator, tables
from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.base import Adapter
from nff_companion.autopilots.nff import NffDialectAdapter
from nff_companion.autopilots.px4.adapter import Method, Px4Adapter
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect

Kind = Literal["auto", "nff", "ardupilot", "px4"]


class Meeting:
    """Makes adapters for one vehicle; allocations ahead of time are computed once, at start."""

    def __init__(self, vehicle: Vehicle, kind: Kind, method: str, journal: Path, px4_method: Method = "scale") -> None:
        self._vehicle, self._kind, self._journal, self._px4_method = vehicle, kind, journal, px4_method
        self._plans: dict[int, Plan] = tables.compute(vehicle, allocator(method)) if kind != "nff" else {}

    def first(self, target: tuple[int, int], autopilot: int) -> Adapter | None:
        """Adapter for an autopilot of this MAV_AUTOPILOT; None for one that we cannot serve."""
        kind: str = self._kind
        if kind == "auto":
            kind = {
                dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
                dialect.MAV_AUTOPILOT_PX4: "px4",
                dialect.MAV_AUTOPILOT_GENERIC: "nff",
            }.get(autopilot, "")
        if kind == "ardupilot":
            return ArduPilotAdapter(self._vehicle, target, self._plans)
        if kind == "px4":
            return Px4Adapter(self._vehicle, target, self._journal, self._px4_method)
        return NffDialectAdapter(self._vehicle, target) if kind == "nff" else None

    def better(self, adapter: Adapter, message_id: int) -> Adapter | None:
        """Another adapter when the autopilot turns out to speak our dialect, whatever its heartbeat says."""
        if self._kind != "auto" or adapter.name == "nff" or message_id != dialect.MAVLINK_MSG_ID_NFF_APPLIED:
            return None
        return NffDialectAdapter(self._vehicle, adapter.target)
