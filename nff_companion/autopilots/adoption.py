"""Whose companion we are: the vehicle is adopted, can be lost, and won again; never while acting."""

from __future__ import annotations

from dataclasses import dataclass

from nff_companion.autopilots.base import Adapter
from nff_companion.autopilots.meeting import Kind, Meeting
from nff_companion.condition import Reason, Statement
from nff_companion.mavlink.codec import Message, dialect

_SILENT_S = 5.0  # a vehicle not heard for so long is gone
_SPEAKS_S, _SPEAKS = 1.0, 3  # our dialect is spoken by who said it so often within this time: one may be a stray
_AUTOPILOT = dialect.MAV_COMP_ID_AUTOPILOT1
# Heartbeats of these types are no vehicle whose motors could be reallocated.
_NO_VEHICLE = frozenset(
    {
        dialect.MAV_TYPE_ANTENNA_TRACKER,
        dialect.MAV_TYPE_GCS,
        dialect.MAV_TYPE_ONBOARD_CONTROLLER,
        dialect.MAV_TYPE_GIMBAL,
        dialect.MAV_TYPE_ADSB,
        dialect.MAV_TYPE_CAMERA,
        dialect.MAV_TYPE_CHARGING_STATION,
        dialect.MAV_TYPE_FLARM,
        dialect.MAV_TYPE_SERVO,
        dialect.MAV_TYPE_ODID,
        dialect.MAV_TYPE_BATTERY,
        dialect.MAV_TYPE_LOG,
        dialect.MAV_TYPE_IMU,
        dialect.MAV_TYPE_GPS,
        dialect.MAV_TYPE_WINCH,
        dialect.MAV_TYPE_FIXED_WING,
        dialect.MAV_TYPE_GROUND_ROVER,
        dialect.MAV_TYPE_SURFACE_BOAT,
        dialect.MAV_TYPE_SUBMARINE,
        dialect.MAV_TYPE_AIRSHIP,
        dialect.MAV_TYPE_FREE_BALLOON,
        dialect.MAV_TYPE_ROCKET,
        dialect.MAV_TYPE_FLAPPING_WING,
        dialect.MAV_TYPE_KITE,
        dialect.MAV_TYPE_PARAFOIL,
        dialect.MAV_TYPE_PARACHUTE,
        dialect.MAV_TYPE_OSD,
        dialect.MAV_TYPE_ILLUMINATOR,
        dialect.MAV_TYPE_SPACECRAFT_ORBITER,
        dialect.MAV_TYPE_GROUND_QUADRUPED,
        dialect.MAV_TYPE_GRIPPER,
    }
)


@dataclass(slots=True)
class _Vehicle:
    autopilot: int
    heard_s: float
    heartbeat: Message
    dialect_last_s: float = -float("inf")
    dialect_count: int = 0


class Adoption:
    """``system`` 0: the one vehicle that is heard; else this one alone. ``now_s`` of our clock."""

    def __init__(self, meeting: Meeting, system: int) -> None:
        self._meeting, self._wanted = meeting, system
        self._vehicles: dict[int, _Vehicle] = {}
        self._kind: Kind | None = None
        self._refused: int | None = None
        self._others: set[int] = set()  # systems whose heartbeat is no vehicle's
        self.adapter: Adapter | None = None

    @property
    def system(self) -> int | None:
        """Of the vehicle adopted."""
        return None if self.adapter is None else self.adapter.target[0]

    def hear(self, message: Message, now_s: float, *, acting: bool) -> bool:
        """Take one message; whether it comes from the autopilot adopted. ``acting``: nothing may change now."""
        if message.get_srcComponent() != _AUTOPILOT:
            return False
        system = message.get_srcSystem()
        known = self._vehicles.get(system)
        if message.get_type() == "HEARTBEAT":
            if not is_vehicle(message):
                self._others.add(system)
                return False
            if known is None:
                known = self._vehicles[system] = _Vehicle(message.autopilot, now_s, message)
            known.autopilot, known.heartbeat = message.autopilot, message
        if known is None:
            return False
        known.heard_s = now_s
        applied = message.get_msgId() == dialect.MAVLINK_MSG_ID_NFF_APPLIED
        if applied:
            _note_dialect(known, now_s)
        if not acting and (applied or self.adapter is None or known.heartbeat is message):
            self._settle(now_s)  # what time alone changes is settled by ``tick``
        return system == self.system

    def tick(self, now_s: float, *, acting: bool) -> None:
        """Time passes: who is silent is forgotten."""
        if not acting:
            self._settle(now_s)

    def knows(self, system: int) -> bool:
        """Whether a heartbeat of this system's autopilot has been heard."""
        return system in self._vehicles or system in self._others

    def obstacle(self, *, acting: bool) -> Statement | None:
        """Why the vehicle adopted may be the wrong one."""
        if self._wanted or acting or len(self._vehicles) < 2:
            return None
        return Statement(Reason.AMBIGUOUS, " and ".join(map(str, sorted(self._vehicles))))

    def instead(self) -> Statement | None:
        """Who else is heard, now that the telemetry of the vehicle adopted has stopped: it may have come back under
        another number."""
        others = [system for system in sorted(self._vehicles) if system != self.system]
        if self.system is None or not others:
            return None
        return Statement(Reason.ANOTHER_SYSTEM, f"not from {self.system}, system {others[0]} is heard")

    def notes(self) -> list[Statement]:
        """What the pilot should hear."""
        out = [Statement(Reason.SECOND_VEHICLE, str(s)) for s in sorted(self._vehicles) if s != self.system]
        if self._refused is not None:
            out.append(Statement(Reason.CONTRADICTION, f"autopilot {self._refused} is not supported"))
        return out

    def _settle(self, now_s: float) -> None:
        for system in [s for s, v in self._vehicles.items() if now_s - v.heard_s > _SILENT_S]:
            del self._vehicles[system]
        if self.system is not None and self.system not in self._vehicles:
            self.adapter = self._kind = None
        if self.adapter is None:
            for system in self._vehicles:
                if self._wanted in (0, system) and self._adopt(system, now_s):
                    break
        elif self._kind_of(self._vehicles[self.adapter.target[0]], now_s) != self._kind:
            self._adopt(self.adapter.target[0], now_s)

    def _adopt(self, system: int, now_s: float) -> bool:
        vehicle = self._vehicles[system]
        kind = self._kind_of(vehicle, now_s)
        self._refused = vehicle.autopilot if kind is None else None
        if kind is None:
            return False
        self._kind = kind
        self.adapter = self._meeting.adapter(kind, (system, _AUTOPILOT))
        self.adapter.observe(vehicle.heartbeat, now_s)  # whether it is armed, a second before it is said again
        return True

    def _kind_of(self, vehicle: _Vehicle, now_s: float) -> Kind | None:
        speaks = vehicle.dialect_count >= _SPEAKS and now_s - vehicle.dialect_last_s <= _SILENT_S
        return self._meeting.kind(vehicle.autopilot, speaks_our_dialect=speaks)


def is_vehicle(heartbeat: Message) -> bool:
    """Whether it is of an autopilot whose motors could be reallocated."""
    return heartbeat.type not in _NO_VEHICLE and heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID


def _note_dialect(vehicle: _Vehicle, now_s: float) -> None:
    if now_s - vehicle.dialect_last_s > _SPEAKS_S:
        vehicle.dialect_count = 0
    vehicle.dialect_count += 1
    vehicle.dialect_last_s = now_s
