"""Sockets and the clock around a session: once round, wait for input, hand it in, send what comes out."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterable

from nff_companion.mavlink.hub import Hub
from nff_companion.session import Session
from nff_companion.vehicle_link import Outgoing

IDLE_S = 0.05  # longest wait for a datagram: heartbeats and the watchdog come from this loop
# Between two looks at what is due. There is time for one after a sample; without samples it comes a little later, so
# that what belongs to a sample and comes before it is not held up.
_DUE_S, _DUE_LATEST_S = 0.005, 0.012


class Loop:
    """One hub and one session. ``others``: descriptors that are not the hub's, with what serves them."""

    def __init__(self, urls: list[str], component: int, clock: Callable[[], float] = time.monotonic) -> None:
        """Raises ConfigError, EndpointError."""
        self.clock = clock
        self.poll = select.poll()
        self.hub = Hub(urls, 1, component, self.poll, clock())
        self._system: int | None = None
        self._due_s = clock()

    def turn(self, session: Session, wait_s: float, other: Callable[[int], None] | None = None) -> bool:
        """Once round; ``other`` is given descriptors with input that are not the hub's. Returns whether what is due was
        looked at too, which is not at every turn."""
        sampled = False
        for descriptor, _ in self.poll.poll(1e3 * wait_s):
            if not self.hub.owns(descriptor):
                if other is not None:
                    other(descriptor)
                continue
            for message, port in self.hub.read(descriptor, self.clock()):
                began, before = time.perf_counter(), session.reporter.counters.samples
                outgoing = session.take(message, port, self.clock())
                self._follow(session)
                self.send(outgoing)
                self.send(session.think())
                if session.reporter.counters.samples != before:
                    sampled = True
                    session.reporter.took(time.perf_counter() - began)
        now = self.clock()
        if 0.0 <= now - self._due_s < (_DUE_S if sampled else _DUE_LATEST_S):
            return False
        self._due_s = now
        self._count(session)
        outgoing = session.due(now)
        self._follow(session)
        self.send(outgoing)
        self.hub.maintain(now)
        return True

    def send(self, outgoing: Iterable[Outgoing]) -> None:
        """Send what a session wants to be sent."""
        now = self.clock()
        for item in outgoing:
            self.hub.send(item.message, item.port, now)

    def close(self) -> None:
        """Close the hub."""
        self.hub.close()

    def _follow(self, session: Session) -> None:
        """Speak as the vehicle's system, and to it, from when it is adopted."""
        if session.system == self._system:
            return
        self._system = session.system
        self.hub.adopt(session.system)
        if session.system is not None:
            self.hub.set_system(session.system)

    def _count(self, session: Session) -> None:
        counters = session.reporter.counters
        counters.bad_frames, counters.unsendable = self.hub.bad_frames, self.hub.unsendable
        counters.dropped = self.hub.dropped
