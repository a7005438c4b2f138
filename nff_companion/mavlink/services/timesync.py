"""TIMESYNC: the offset between the autopilot's clock and ours, and the round trip.

https://mavlink.io/en/services/timesync.html
"""

from __future__ import annotations

from nff_companion.mavlink.codec import Message, dialect

_INTERVAL_NS = 1_000_000_000
_ROUND_TRIP_MAX_NS = 500_000_000
_RESTART_NS = 1_000_000_000  # a jump of the autopilot's clock
_SHARE = 0.1  # of a new measurement, once there are some
_HEADER, _FIELDS = 10, 16  # bytes of a frame before the payload, and of tc1 and ts1 in it


class TimeSync:
    """Asks the adopted autopilot once a second, and answers it in its own time. ``now_ns`` of our clock.

    Nobody else is answered, nor the autopilot before its time is known: where several companions answer, each in a
    clock of its own, the offset that the autopilot finds would jump.
    """

    def __init__(self, component: int = 191) -> None:
        """``component``: our id, for requests that name whom they ask."""
        self.round_trip_s: float | None = None
        self._component = component
        self._system: int | None = None
        self._offset_ns: int | None = None
        self._asked_ns: int | None = None  # the question whose answer has not come
        self._next_ns: int | None = None

    @property
    def offset_s(self) -> float | None:
        """The autopilot's clock minus ours; None while unknown."""
        return None if self._offset_ns is None else 1e-9 * self._offset_ns

    def adopt(self, system: int) -> None:
        """Speak with this system's autopilot; what was known of another one's clock is forgotten."""
        self._system = system
        self._offset_ns = self._asked_ns = self._next_ns = self.round_trip_s = None

    def autopilot_now_ns(self, now_ns: int) -> int | None:
        """The autopilot's clock at ``now_ns`` of ours; None while unknown."""
        return None if self._offset_ns is None else now_ns + self._offset_ns

    def tick(self, now_ns: int) -> list[Message]:
        """A request when one is due."""
        if self._next_ns is not None and now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + _INTERVAL_NS
        self._asked_ns = now_ns
        return [dialect.MAVLink_timesync_message(0, now_ns)]

    def observe(self, message: Message, now_ns: int) -> list[Message]:
        """Take a TIMESYNC; the answer to a request. What is late, or not the autopilot's, or not for us is dropped."""
        if (message.get_srcSystem(), message.get_srcComponent()) != (self._system, dialect.MAV_COMP_ID_AUTOPILOT1):
            return []
        if message.tc1 == 0:
            time_ns = self.autopilot_now_ns(now_ns)
            if time_ns is None or not self._for_us(message):
                return []
            return [dialect.MAVLink_timesync_message(time_ns, message.ts1)]
        if message.ts1 != self._asked_ns:
            return []  # the answer to somebody else's question, or heard a second time
        self._asked_ns = None
        round_trip_ns = now_ns - message.ts1
        if 0 <= round_trip_ns <= _ROUND_TRIP_MAX_NS:
            self._measured(message.tc1 - message.ts1 - round_trip_ns // 2, 1e-9 * round_trip_ns)
        return []

    def _measured(self, offset_ns: int, round_trip_s: float) -> None:
        known = self._offset_ns
        if known is None or self.round_trip_s is None or abs(offset_ns - known) > _RESTART_NS:
            self._offset_ns, self.round_trip_s = offset_ns, round_trip_s
        else:
            self._offset_ns = known + round(_SHARE * (offset_ns - known))
            self.round_trip_s += _SHARE * (round_trip_s - self.round_trip_s)

    def _for_us(self, request: Message) -> bool:
        """By target_system and target_component, extension fields that our dialect lacks; 0 or none: everybody."""
        frame, length = request.get_msgbuf(), request.get_header().mlen
        target = bytes(frame[_HEADER + _FIELDS : _HEADER + length]).ljust(2, b"\0")
        return target[0] in (0, self._system) and target[1] in (0, self._component)
