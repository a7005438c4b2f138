"""STATUSTEXT to the pilot: short, and never a flood that hides what matters."""

from __future__ import annotations

from collections import deque

from nff_companion.mavlink.codec import Message, dialect

_LENGTH = 50
_BURST, _BURST_S = 5, 10.0  # ordinary texts
_REPEAT_S = 30.0  # the same text again


class PilotText:
    """Rate limit: errors and worse always pass, once each second; others at most five in ten seconds."""

    def __init__(self) -> None:
        self._sent: deque[float] = deque(maxlen=_BURST)
        self._last: dict[str, float] = {}
        self.withheld = 0

    def say(self, text: str, severity: int, now_s: float, subject: str = "") -> list[Message]:
        """The message to send; none when it is withheld. Texts of one ``subject`` count as the same text."""
        critical = severity <= dialect.MAV_SEVERITY_ERROR
        again_s = 1.0 if critical else _REPEAT_S
        key = subject or text
        if now_s - self._last.get(key, -float("inf")) < again_s:
            self.withheld += 1
            return []
        full = len(self._sent) == _BURST and now_s - self._sent[0] < _BURST_S
        if full and not critical:
            self.withheld += 1
            return []
        if not critical:
            self._sent.append(now_s)
        if len(self._last) > 100:
            self._last = {t: s for t, s in self._last.items() if now_s - s < _REPEAT_S}
        self._last[key] = now_s
        return [dialect.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:_LENGTH])]
