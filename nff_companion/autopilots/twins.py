"""Another companion on the same vehicle: the later one observes.

Companions tell each other apart by a number drawn at their start, which their heartbeats carry above the mode
(``custom_mode`` = instance * 256 + mode).
"""

from __future__ import annotations

from nff_companion.condition import Mode, Reason, Statement
from nff_companion.mavlink.codec import Message, dialect

FIRST_COMPONENT, LAST_COMPONENT = 191, 194
_HEARD_S = 3.0  # heartbeats come once a second
_LISTEN_S = 2.5  # who is heard this soon after our start was here first


def custom_mode(instance: int, mode: Mode) -> int:
    """Of our heartbeat."""
    return (instance & 0xFFFF) << 8 | int(mode)


class Twins:
    """Hears other companions. ``now_s`` of our clock."""

    def __init__(self, instance: int, now_s: float) -> None:
        self._instance, self._started_s = instance, now_s
        self._first: tuple[int, float] | None = None  # component and last heartbeat of the one that was here first
        self._later: tuple[int, float] | None = None

    def hear(self, message: Message, system: int | None, now_s: float) -> None:
        """Take one message; heartbeats of companions of our vehicle's ``system`` count."""
        component = message.get_srcComponent()
        if not FIRST_COMPONENT <= component <= LAST_COMPONENT or message.get_type() != "HEARTBEAT":
            return
        other = message.custom_mode >> 8
        if message.type != dialect.MAV_TYPE_ONBOARD_CONTROLLER or other == self._instance:
            return  # something else, or our own heartbeat come back
        if system is not None and message.get_srcSystem() != system:
            return
        known = self._first is not None and now_s - self._first[1] <= _HEARD_S
        together = now_s - self._started_s <= _LISTEN_S and self._later is None
        if known or together:
            self._first = (component, now_s)
        else:
            self._later = (component, now_s)

    def obstacle(self, now_s: float) -> Statement | None:
        """Why we may not act: another one does."""
        if self._first is None or now_s - self._first[1] > _HEARD_S:
            return None
        return Statement(Reason.TWIN, f"component {self._first[0]}")

    def notes(self, now_s: float) -> list[Statement]:
        """What the pilot should hear."""
        if self._later is None or now_s - self._later[1] > _HEARD_S:
            return []
        return [Statement(Reason.LATER_TWIN, f"component {self._later[0]}")]
