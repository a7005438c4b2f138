"""Losses that cannot be told apart: the sets of motors that explain the residual as well as the best of them.

Two motors on opposite arms turn nothing when they stop, whichever of the pairs it is; two that are an arm apart turn
what one of them and a part of another turn too. By how much the best leads then is the model's error, and what is done
about a guess takes two motors off that work. The answer is the set, "1+2 or 7+8": said, and kept out of what is learnt,
until one of them leads or none is left. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from nff_companion.core.tuning import DecisionTuning

Motors = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Among:
    """Sets of motors (indices from 0), the best first; since when one of them has been believed, and when last.
    ``told``: for long enough to be said."""

    sets: tuple[Motors, ...]
    since_s: float
    seen_s: float
    told: bool = False


def needed(improvement: float, tuning: DecisionTuning) -> float:
    """Margin over the next hypothesis that tells two apart, nats: what the model has wrong grows with what it has to
    explain."""
    return max(tuning.margin_min, tuning.margin_share * improvement)


def followed(before: Among | None, time_s: float, alike: tuple[Motors, ...], tuning: DecisionTuning) -> Among | None:
    """``before`` a sample later: ``alike`` cannot be told apart now; empty: there is nothing, or one leads."""
    if not alike:
        return before if before is not None and time_s - before.seen_s < tuning.among_hold_s else None
    if before is None:
        return Among(sets=alike, since_s=time_s, seen_s=time_s)
    if before.told and set(alike) <= set(before.sets):
        return replace(before, seen_s=time_s)  # the sets that were said stay while they hold
    told = before.told or time_s - before.since_s >= tuning.among_after_s - 1e-9
    return Among(sets=alike, since_s=before.since_s, seen_s=time_s, told=told)
