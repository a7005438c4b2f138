"""What the pilot hears: texts that are short, said when something begins, and never a flood."""

from __future__ import annotations

from nff_companion.condition import Reason, Statement
from nff_companion.core.decision import Event
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.pilot_text import PilotText

_WARNING = dialect.MAV_SEVERITY_WARNING
_ERROR, _CRITICAL = dialect.MAV_SEVERITY_ERROR, dialect.MAV_SEVERITY_CRITICAL
# Verdicts that are said when they begin, and how loudly.
_SAID = {
    Reason.REALLOCATED: _WARNING,
    Reason.REALLOCATED_NO_YAW: _WARNING,
    Reason.STOPPED: _WARNING,
    Reason.NO_LIFT: _CRITICAL,
    Reason.NO_PLAN: _CRITICAL,
    Reason.NOT_TOLD: _CRITICAL,
    Reason.NOT_CONFIRMED: _CRITICAL,
    Reason.TWIN: _ERROR,
    Reason.AMBIGUOUS: _ERROR,
    Reason.RATE: _ERROR,
    Reason.CARD_DIFFERS: _ERROR,
    Reason.WRONG_FILE: _ERROR,
    Reason.UNCONFIRMED: _WARNING,
    Reason.TELEMETRY_STOPPED: _ERROR,
    Reason.ANOTHER_SYSTEM: _ERROR,
}
_LENGTH = 50


class Announcer:
    """Makes STATUSTEXT. ``now_s`` of our clock."""

    def __init__(self) -> None:
        self._text = PilotText()
        self._last: Reason | None = None

    def event(self, event: Event, now_s: float) -> list[Message]:
        """A declaration, or its lifting."""
        if event.declared:
            text = f"Motor {event.motor} failed (eff {event.effectiveness:.2f})"
            return self._text.say(text, _CRITICAL, now_s)
        return self._text.say(f"Motor {event.motor} works again", _WARNING, now_s)

    def verdict(self, said: Statement, now_s: float) -> list[Message]:
        """When it begins; a verdict that goes on is in the status."""
        before, self._last = self._last, said.reason
        if said.reason is before or said.reason not in _SAID:
            return []
        return self._text.say(f"NFF: {said.text}"[:_LENGTH], _SAID[said.reason], now_s)

    def note(self, note: Statement, now_s: float, subject: str = "") -> list[Message]:
        """Something beside; notes of one ``subject`` count as the same."""
        return self._text.say(f"NFF: {note.text}"[:_LENGTH], _WARNING, now_s, subject)
