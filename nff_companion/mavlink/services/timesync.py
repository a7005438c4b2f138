"""TIMESYNC: the offset between the autopilot's clock and ours, and the round trip."""

from __future__ import annotations

from nff_companion.mavlink.codec import Message, dialect

_INTERVAL_S = 1.0
_ROUND_TRIP_MAX_S = 0.5
_SHARE = 0.1  # of a new measurement, once there are some


class TimeSync:
    """Asks once a second, answers whoever asks. ``now_ns`` of our clock."""

    def __init__(self) -> None:
        self.offset_s: float | None = None  # the autopilot's clock minus ours
        self.round_trip_s: float | None = None
        self._next_s = -float("inf")

    def tick(self, now_ns: int) -> list[Message]:
        """A request when one is due."""
        if 1e-9 * now_ns < self._next_s:
            return []
        self._next_s = 1e-9 * now_ns + _INTERVAL_S
        return [dialect.MAVLink_timesync_message(0, now_ns)]

    def observe(self, message: Message, now_ns: int) -> list[Message]:
        """Take a TIMESYNC; the answer to a request. Replies that are late or not ours are dropped."""
        if message.tc1 == 0:
            return [dialect.MAVLink_timesync_message(now_ns, message.ts1)]
        round_trip = 1e-9 * (now_ns - message.ts1)
        if not 0.0 <= round_trip <= _ROUND_TRIP_MAX_S:
            return []
        offset = 1e-9 * (message.tc1 - message.ts1) - 0.5 * round_trip
        if self.offset_s is None or abs(offset - self.offset_s) > 1.0:  # first, or the autopilot has been restarted
            self.offset_s, self.round_trip_s = offset, round_trip
        else:
            self.offset_s += _SHARE * (offset - self.offset_s)
            self.round_trip_s = (1 - _SHARE) * (self.round_trip_s or round_trip) + _SHARE * round_trip
        return []
