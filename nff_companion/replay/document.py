"""What ``nff replay`` writes of a flight."""

from __future__ import annotations

from typing import Any

from nff_companion.core.vehicle import AXES
from nff_companion.replay.flight import LogFlight
from nff_companion.replay.judge import Fault, Judgement


def document(flight: LogFlight, judgement: Judgement, duration_s: float) -> dict[str, Any]:
    """For JSON; times in s from the first record."""
    explained = judgement.explained
    values = [None] * len(AXES) if explained is None else [round(float(value), 3) for value in explained]
    return {
        "file": str(flight.path),
        "system": flight.system,
        "verdict": judgement.verdict,
        "reason": judgement.reason,
        "frame": None if flight.frame is None else flight.frame.text,
        "duration_s": round(duration_s, 3),
        "judged_s": round(judgement.judged_s, 3),
        "refused_samples": judgement.refused,
        "explained": dict(zip(AXES, values, strict=True)),
        "faults": [_fault(fault) for fault in judgement.faults],
        "notes": list(flight.notes),
    }


def _fault(fault: Fault) -> dict[str, Any]:
    return {
        "motor": fault.motor,
        "time_s": round(fault.time_s, 4),
        "effectiveness": round(fault.effectiveness, 3),
        "confidence": round(fault.confidence, 4),
        "lifted_s": None if fault.lifted_s is None else round(fault.lifted_s, 4),
    }


def line(flight: dict[str, Any]) -> str:
    """One flight in words."""
    system = "" if flight["system"] is None else f" (system {flight['system']})"
    if flight["verdict"] == "not_judged":
        return f"{flight['file']}{system}: not judged: {flight['reason']}"
    faults = [
        f"motor {fault['motor']} at {fault['time_s']:.3f} s (effectiveness {fault['effectiveness']:.2f}"
        + ("" if fault["lifted_s"] is None else f", lifted at {fault['lifted_s']:.3f} s")
        + ")"
        for fault in flight["faults"]
    ]
    note = "" if not flight["reason"] else f"; {flight['reason']}"
    return f"{flight['file']}{system}: {', '.join(faults) or 'no fault'} ({flight['judged_s']:.1f} s judged{note})"
