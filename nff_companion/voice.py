"""What is said without being asked: to the pilot, to ground stations and to other companions."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from nff_companion.announcer import Announcer
from nff_companion.autopilots.twins import Rank
from nff_companion.condition import Reason, Statement
from nff_companion.core.decision import Event
from nff_companion.mavlink.codec import Message
from nff_companion.reporting import Moment, Reporter

_HEARTBEAT_S = 1.0
_HOST_S = 2.0


class Voice:
    """Messages for all ports. ``now_s`` of our clock."""

    def __init__(self, reporter: Reporter, host_status: Callable[[], Message] | None, *, act: bool) -> None:
        """``host_status`` makes ONBOARD_COMPUTER_STATUS; ``act`` False: a check before the flight, which is silent but
        for its heartbeat."""
        self._reporter, self._host_status, self._act = reporter, host_status, act
        self._announcer = Announcer()
        self._next_heartbeat_s = self._next_host_s = -float("inf")

    def event(self, event: Event, now_s: float) -> list[Message]:
        """A declaration, or its lifting."""
        if not self._act:
            return []
        return [self._reporter.event(event), *self._announcer.event(event, now_s)]

    def verdict(self, said: Statement, now_s: float) -> list[Message]:
        """Where it is not the one of last time."""
        return self._announcer.verdict(said, now_s) if self._act else []

    def notes(self, notes: Iterable[Statement], now_s: float) -> list[Message]:
        """Things beside."""
        if not self._act:
            return []
        return [message for note in notes for message in self._announcer.note(note, now_s)]

    def slow_streams(self, slow: dict[str, tuple[float, float]], now_s: float) -> list[Message]:
        """Streams that do not come as asked: name to (rate heard, rate asked)."""
        out: list[Message] = []
        if self._act:
            for name, (rate, asked) in slow.items():
                note = Statement(Reason.SLOW_STREAM, f"{name} {rate:.0f} Hz, {asked:.0f}")
                out += self._announcer.note(note, now_s, name)
        return out

    def due(
        self, moment: Callable[[], Moment], rank: Rank, now_s: float, *, well: bool, changed: bool
    ) -> list[Message]:
        """Heartbeat, status, and how the computer fares; ``moment`` is asked for where something is due. ``changed``:
        our rank, which others must know at once. A companion that is not ``well`` (its estimator fails) has no
        heartbeat: whoever relies on it must see that."""
        out: list[Message] = []
        if changed:
            self._next_heartbeat_s = now_s
        if now_s >= self._next_heartbeat_s and well:
            self._next_heartbeat_s = now_s + _HEARTBEAT_S
            out.append(self._reporter.heartbeat(moment().output, rank, act=self._act))
        if not self._act:
            return out
        if self._reporter.is_due(now_s):
            out += self._reporter.due(moment(), now_s)
        if self._host_status is not None and now_s >= self._next_host_s:
            self._next_host_s = now_s + _HOST_S
            out.append(self._host_status())
        return out
