"""Whether the machine kept up with a flight in real time. One that did not says nothing of the companion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

CRASHED, TOO_SLOW = 1, 3  # exit codes; 2 is a usage error, as everywhere
_CLOCK_RATIO = 0.95
RATE_RATIO = 0.8  # of the telemetry asked for, as the daemon itself has it
_STALE_SHARE, _STALE_MIN = 0.05, 3
# Signs that a machine is short of time, enough when nothing at all was applied.
_CLOCK_SIGN, _RATE_SIGN = 0.98, 0.95


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What was measured in the flight with the companion. ``rate_hz`` None: the daemon did not answer."""

    flown_s: float  # by the vehicle's clock
    wall_s: float
    asked_hz: float  # telemetry
    rate_hz: float | None
    commands_sent: int
    stale: int  # commands that the autopilot refused as too old
    expected: bool  # something failed, and the mode is one that acts
    acted: bool  # the autopilot had something of the companion's in force
    late_cycles: int = 0  # times that our own server was a quarter of a second behind
    lost_s: float = 0.0  # which it then gave up
    crashed: bool = False

    @property
    def clock_ratio(self) -> float:
        """Of the vehicle's clock to the wall clock."""
        return self.flown_s / self.wall_s if self.wall_s > 0.0 else 0.0


def judge(figures: Figures) -> dict[str, Any]:
    """``machine`` of a flight's document: too_slow, the reason, the figures."""
    reasons = _reasons(figures)
    return {
        "too_slow": bool(reasons),
        "reason": "; ".join(reasons),
        "clock_ratio": round(figures.clock_ratio, 3),
        "late_cycles": figures.late_cycles,
        "lost_s": round(figures.lost_s, 3),
        "asked_hz": figures.asked_hz,
        "rate_hz": None if figures.rate_hz is None else round(figures.rate_hz, 1),
        "commands_sent": figures.commands_sent,
        "stale": figures.stale,
        "applied": figures.acted,
    }


def _reasons(f: Figures) -> list[str]:
    reasons = []
    if f.clock_ratio < _CLOCK_RATIO:
        reasons.append(f"the vehicle's clock ran at {f.clock_ratio:.2f} of the wall clock")
    # The vehicle's time stands still with it: where it flew on, helped if that was to be expected, no harm was done.
    if f.late_cycles and (f.crashed or (f.expected and not f.acted)):
        count = "once" if f.late_cycles == 1 else f"{f.late_cycles} times"
        reasons.append(f"the vehicle stood still {count} and lost {f.lost_s:.2f} s")
    if f.rate_hz is None:
        reasons.append("the companion did not answer in time")
    # No telemetry at all is no matter of speed.
    elif 0.0 < f.rate_hz < RATE_RATIO * f.asked_hz:
        reasons.append(f"telemetry came at {f.rate_hz:.0f} of {f.asked_hz:.0f} Hz")
    if f.stale > max(_STALE_MIN, _STALE_SHARE * f.commands_sent):
        reasons.append(f"{f.stale} of {f.commands_sent} commands came too late")
    late = f.rate_hz is not None and 0.0 < f.rate_hz < _RATE_SIGN * f.asked_hz
    if f.expected and not f.acted and (f.stale or late or f.clock_ratio < _CLOCK_SIGN or reasons):
        reasons.append(
            f"nothing of the companion was ever applied: {f.commands_sent} commands sent, {f.stale} too late,"
            f" telemetry at {f.rate_hz or 0.0:.0f} of {f.asked_hz:.0f} Hz"
        )
    return reasons


def line(machine: dict[str, Any]) -> str:
    """One line for people."""
    if machine["too_slow"]:
        return f"the machine was too slow, this flight says nothing of the companion: {machine['reason']}"
    return (
        f"the machine kept up: clock {machine['clock_ratio']:.2f} of the wall's,"
        f" telemetry {machine['rate_hz'] or 0.0:.0f} of {machine['asked_hz']:.0f} Hz"
    )


def exit_code(document: dict[str, Any]) -> int:
    """0: the companion's flight ended in the air; 1: it crashed; 3: the machine was too slow to tell."""
    if document["machine"]["too_slow"]:
        return TOO_SLOW
    return CRASHED if document["companion"]["crashed"] else 0
