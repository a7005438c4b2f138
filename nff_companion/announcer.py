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
    Reason.EITHER: _CRITICAL,
    Reason.EITHER_NO_YAW: _CRITICAL,
    Reason.AMONG: _CRITICAL,
    Reason.PERHAPS: _CRITICAL,
    Reason.PROBING: _WARNING,
    Reason.MORE: _CRITICAL,
    Reason.UNRESPONSIVE: _CRITICAL,
    Reason.WEAK: _WARNING,
    Reason.WORN: _WARNING,
    Reason.WORN_OR_LOAD: _WARNING,
    Reason.PARTIAL: _WARNING,
    Reason.PARTIAL_NO_YAW: _WARNING,
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
# Of these the motors are the news: other ones are said anew.
_OF_MOTORS = {
    Reason.EITHER,
    Reason.EITHER_NO_YAW,
    Reason.AMONG,
    Reason.PERHAPS,
    Reason.MORE,
    Reason.UNRESPONSIVE,
    Reason.WEAK,
    Reason.WORN,
    Reason.WORN_OR_LOAD,
    Reason.PARTIAL,
    Reason.PARTIAL_NO_YAW,
}
_LENGTH = 50


class Announcer:
    """Makes STATUSTEXT. ``now_s`` of our clock."""

    def __init__(self) -> None:
        self._text = PilotText()
        self._last: Statement | None = None

    def event(self, event: Event, now_s: float) -> list[Message]:
        """A declaration, or its lifting."""
        if event.declared:
            text = f"Motor {event.motor} failed (eff {event.effectiveness:.2f})"
            return self._text.say(text, _CRITICAL, now_s)
        return self._text.say(f"Motor {event.motor} works again", _WARNING, now_s)

    def verdict(self, said: Statement, now_s: float) -> list[Message]:
        """When it begins; a verdict that goes on is in the status."""
        before, self._last = self._last, said
        if said.reason not in _SAID:
            return []
        goes_on = before is not None and said.reason is before.reason
        if goes_on and not (said.reason in _OF_MOTORS and said != before):
            return []
        return self._text.say(f"NFF: {said.text}"[:_LENGTH], _SAID[said.reason], now_s)

    def note(self, note: Statement, now_s: float, subject: str = "") -> list[Message]:
        """Something beside; notes of one ``subject`` count as the same."""
        return self._text.say(f"NFF: {note.text}"[:_LENGTH], _WARNING, now_s, subject)
