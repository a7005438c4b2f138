"""Other companions on the same vehicle: one acts, the others observe.

Companions tell each other apart by a number drawn at their start, which their heartbeats carry above the mode
(``custom_mode`` = rank << 24 | instance << 8 | mode). Who may act, has listened for a while and heard nobody who claims
the vehicle, claims it, and keeps it until it falls silent or may not act. Of two who claim (they could not hear each
other), or of two who have only just started, one is first: who acts before who does not, then the lower number. Both
decide by the same rule.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from nff_companion.condition import Mode, Reason, Statement
from nff_companion.mavlink.codec import Message, dialect

FIRST_COMPONENT, LAST_COMPONENT = 191, 194
_HEARD_S = 3.0  # heartbeats come once a second
_LISTEN_S = 2.5  # after the first message heard


class Rank(IntEnum):
    """Among companions of one vehicle."""

    BYSTANDER = 0  # may not act: the operator's mode is observe, or its estimator fails
    CANDIDATE = 1
    CLAIMANT = 2


def custom_mode(instance: int, mode: Mode, rank: Rank) -> int:
    """Of our heartbeat; ``instance`` 0: nobody's (a check before the flight)."""
    return int(rank) << 24 | (instance & 0xFFFF) << 8 | int(mode)


@dataclass(frozen=True, slots=True)
class _Other:
    component: int
    heard_s: float
    rank: int
    acts: bool


class Twins:
    """Hears other companions. ``now_s`` of our clock."""

    def __init__(self, instance: int) -> None:
        self._instance = instance
        self._listening_since_s: float | None = None
        self._others: dict[int, _Other] = {}
        self.rank = Rank.BYSTANDER

    def hear(self, message: Message, system: int | None, now_s: float) -> None:
        """Take one message; heartbeats of companions of our vehicle's ``system`` count."""
        if self._listening_since_s is None:
            self._listening_since_s = now_s
        component = message.get_srcComponent()
        if not FIRST_COMPONENT <= component <= LAST_COMPONENT or message.get_type() != "HEARTBEAT":
            return
        other = message.custom_mode >> 8 & 0xFFFF
        if message.type != dialect.MAV_TYPE_ONBOARD_CONTROLLER or other in (0, self._instance):
            return  # another program's, a check's, or our own come back
        if system is not None and message.get_srcSystem() != system:
            return
        acts = message.custom_mode & 0xFF != Mode.OBSERVE
        self._others[other] = _Other(component, now_s, message.custom_mode >> 24 & 3, acts)

    def step(self, now_s: float, *, acting: bool, able: bool) -> bool:
        """Claim the vehicle, or give it up; whether our rank changed. ``able``: we may act and can."""
        self._others = {i: o for i, o in self._others.items() if now_s - o.heard_s <= _HEARD_S}
        before = self.rank
        if not able:
            self.rank = Rank.BYSTANDER
            return before != self.rank
        self.rank = max(before, Rank.CANDIDATE)
        listened = self._listening_since_s is not None and now_s - self._listening_since_s >= _LISTEN_S
        first = listened and self._before_us(acting=acting) is None
        self.rank = Rank.CLAIMANT if first else Rank.CANDIDATE
        return before != self.rank

    def obstacle(self, now_s: float, *, acting: bool) -> Statement | None:
        """Why we may not act: another one is first."""
        if not self._others:
            return None
        other = self._before_us(acting=acting)
        if other is None or now_s - other.heard_s > _HEARD_S:
            return None
        return Statement(Reason.TWIN, f"component {other.component}")

    def notes(self, now_s: float) -> list[Statement]:
        """What the pilot should hear, where we are first."""
        if self._before_us(acting=False) is not None:
            return []
        heard = [o for o in self._others.values() if now_s - o.heard_s <= _HEARD_S]
        return [Statement(Reason.LATER_TWIN, f"component {other.component}") for other in heard[:1]]

    def _before_us(self, *, acting: bool) -> _Other | None:
        ours = (self.rank, self.rank == Rank.CLAIMANT and acting, -self._instance)
        for instance, other in sorted(self._others.items()):
            theirs = (other.rank, other.rank == Rank.CLAIMANT and other.acts, -instance)
            if other.rank != Rank.BYSTANDER and theirs > ours:
                return other
        return None
