"""What is said of a PX4 before and beside the flight."""

from __future__ import annotations

from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.px4.parameter_change import ParameterChange
from nff_companion.autopilots.px4.record import Record
from nff_companion.autopilots.px4.versions import behaviour, text_of
from nff_companion.condition import Reason, Statement


def of_version(version: tuple[int, int, int] | None) -> Finding:
    """Whether it is known what this version does."""
    if version is None:
        return Finding("version", False, "PX4 has not said its version")
    if behaviour(version) is None:
        return Finding("version", False, f"PX4 {text_of(version)}: not known here")
    return Finding("version", True, f"PX4 {text_of(version)}")


def of_rotors(trouble: Statement | None, *, read: bool) -> Finding:
    """Whether its rotors are those of the airframe file."""
    if read:
        return Finding("rotors", True, "agree with the airframe")
    return Finding("rotors", False, "not read yet" if trouble is None else trouble.text)


def of_journal(change: ParameterChange, trouble: Statement | None, *, armed: bool, permit: Permit) -> Finding:
    """Whether parameters are still changed."""
    if trouble is not None and trouble.reason == Reason.JOURNAL:
        return Finding("journal", False, trouble.detail)
    if not change.touched:
        return Finding("journal", True, "clean")
    if armed:
        return Finding("journal", None, "parameters are changed; they are restored when the vehicle disarms")
    if change.refused:
        return Finding("journal", False, f"parameters are still changed: {', '.join(change.refused.values())}")
    if permit == Permit.LISTEN and change.as_found:
        return Finding("journal", None, "left over, and nothing is changed: run the companion, it removes it")
    if permit == Permit.LISTEN:
        return Finding("journal", False, "parameters are still changed: run the companion, it restores them")
    return Finding("journal", False, "parameters are being restored")


def notes(change: ParameterChange, record: Record, *, on_ground: bool, permit: Permit) -> tuple[Statement, ...]:
    """What the pilot should hear of parameters and journal."""
    out = []
    if on_ground and change.touched and change.refused:
        out.append(Statement(Reason.STILL_CHANGED, ", ".join(change.refused.values())))
    elif on_ground and change.touched and permit == Permit.LISTEN and not change.as_found:
        out.append(Statement(Reason.STILL_CHANGED, "run the companion, it restores them"))
    if record.stays:
        out.append(Statement(Reason.JOURNAL_STAYS, record.stays))
    return tuple(out)


def of_state_folder(record: Record) -> Finding:
    """Whether a journal can be written."""
    if not record.tried:
        return Finding("state folder", False, "not tried yet")
    return Finding("state folder", not record.trouble, record.trouble or "a journal can be written")
