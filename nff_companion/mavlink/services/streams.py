"""What arrives against what was asked for, by message."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from nff_companion.mavlink.codec import Message, dialect

_WINDOW_S = 2.0
_ENOUGH = 0.8  # of the rate asked for
_ENOUGH_SAMPLES = 0.9  # of the inertial samples: the estimator is built for their rate
_REQUEST_S = 1.0
_OPTIONAL_TRIES = 5


@dataclass(frozen=True)
class Stream:
    """A message that the companion asks for, and how often; ``required``: flying without it is said to the pilot.

    ``asked_hz``: where more must be asked for than ``rate_hz`` is to come; 0: the same.
    """

    message_id: int
    rate_hz: float
    required: bool = True
    asked_hz: float = 0.0


def _enough_hz(stream: Stream) -> float:
    samples = stream.message_id == dialect.MAVLINK_MSG_ID_HIGHRES_IMU
    return (_ENOUGH_SAMPLES if samples else _ENOUGH) * stream.rate_hz - 0.5


def name_of(message_id: int) -> str:
    """Name of a message."""
    known = dialect.mavlink_map.get(message_id)
    return str(message_id) if known is None else str(known.msgname)


class StreamMonitor:
    """Arrival times by message id. ``now_s`` is any monotonic clock."""

    def __init__(self) -> None:
        self._arrivals: dict[int, deque[float]] = {}
        self._asked: dict[int, int] = {}
        self._asked_s = -float("inf")
        self._first_asked_s: float | None = None

    def ask_again(self) -> None:
        """The autopilot may have restarted: what it did not have is asked for again."""
        self._asked.clear()

    def heard(self, message_id: int, now_s: float) -> None:
        """Note one message."""
        times = self._arrivals.get(message_id)
        if times is None:
            times = self._arrivals[message_id] = deque(maxlen=400)
        times.append(now_s)

    def rate_hz(self, message_id: int, now_s: float) -> float:
        """Rate over the last seconds; 0 when silent."""
        times = self._arrivals.get(message_id)
        if times is None:
            return 0.0
        while times and now_s - times[0] > _WINDOW_S:
            times.popleft()
        if len(times) < 2:
            return 0.0
        return (len(times) - 1) / max(now_s - times[0], 1e-3)

    def slow(self, streams: Iterable[Stream], now_s: float) -> dict[str, tuple[float, float]]:
        """Streams that do not come as asked: name to (rate heard, rate asked). Empty until there was time to obey."""
        if self._first_asked_s is None or now_s - self._first_asked_s < 2.0 * _WINDOW_S:
            return {}
        out = {}
        for stream in streams:
            rate = self.rate_hz(stream.message_id, now_s)
            if stream.required and rate < _enough_hz(stream):
                out[name_of(stream.message_id)] = (rate, stream.rate_hz)
        return out

    def requests(self, streams: Iterable[Stream], target: tuple[int, int], now_s: float) -> list[Message]:
        """SET_MESSAGE_INTERVAL for what does not come as asked, at most once a second."""
        if now_s - self._asked_s < 0.9 * _REQUEST_S:
            return []
        self._asked_s = now_s
        if self._first_asked_s is None:
            self._first_asked_s = now_s
        out = []
        for stream in streams:
            if self.rate_hz(stream.message_id, now_s) >= _enough_hz(stream):
                continue
            asked = self._asked.get(stream.message_id, 0)
            if not stream.required and stream.message_id not in self._arrivals and asked >= _OPTIONAL_TRIES:
                continue  # this autopilot does not have it
            self._asked[stream.message_id] = asked + 1
            out.append(interval(stream, target))
        return out


def interval(stream: Stream, target: tuple[int, int]) -> Message:
    """SET_MESSAGE_INTERVAL for one stream."""
    return dialect.MAVLink_command_long_message(
        *target,
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
        0,
        float(stream.message_id),
        1e6 / (stream.asked_hz or stream.rate_hz),
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )
