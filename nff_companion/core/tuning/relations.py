"""What must hold between two numbers, each of which may be in range for itself."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from nff_companion.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Relation:
    """``lower`` < ``upper`` (or <=, ``equal``) by dotted keys under ``tuning``; vectors by element."""

    lower: str
    upper: str
    why: str
    equal: bool = True

    @property
    def sign(self) -> str:
        """As it is written."""
        return "<=" if self.equal else "<"

    def holds(self, tuning: Any) -> bool:
        """In ``tuning``, a Tuning."""
        low, high = value_at(tuning, self.lower), value_at(tuning, self.upper)
        pairs = zip(low, high, strict=True) if isinstance(low, tuple) else ((low, high),)
        return all(a <= b if self.equal else a < b for a, b in pairs)


RELATIONS = (
    Relation("residual.smoothing_s", "residual.lateral_s", "the lateral force is the slow one"),
    Relation("disturbance.floor_share", "disturbance.ceiling_share", "the deviation believed lies between"),
    Relation("disturbance.share_prior", "disturbance.share_max", "the share begins where it may be"),
    Relation("decision.settled_s", "onset.ages_s.11", "an onset must be able to get so old"),
    Relation("onset.standing_s.1", "onset.ages_s.11", "the memory is as long as the oldest onset"),
    Relation("decision.loss_others", "decision.loss_gradual", "a motor named is not its own rival", equal=False),
    Relation("decision.confirm_s", "decision.confirm_ambiguous_s", "a pair is confirmed no sooner"),
    Relation("decision.confirm_ambiguous_s", "decision.confirm_gradual_s", "a gradual loss is confirmed last"),
    Relation("decision.confirm_gradual_s", "decision.lift_s", "lifting takes longer than declaring"),
    Relation("estimator.freeze_max_s", "estimator.freeze_sure_s", "what is sure is kept from phi a for longer"),
    Relation("rotor_speed.stopped_share", "rotor_speed.turning_share", "stopped is not turning", equal=False),
    Relation("rotor_speed.fresh_s", "rotor_speed.frozen_s", "a reading grows old before its sender has stopped"),
    Relation("sample_rate.same_share", "sample_rate.off_share", "what is the same is not off"),
    Relation("sample_rate.intervals_least", "sample_rate.intervals", "so many are kept"),
    Relation("flight_phase.ended_share", "flight_phase.thrust_share", "a flight that began has not ended", equal=False),
    Relation("flight_phase.sure_after_s", "flight_phase.assumed_after_s", "an assumption needs longer"),
    Relation("flight_phase.height_m", "flight_phase.impact_below_m", "what was hit near the ground is the ground"),
    Relation("wear.loss_ends", "wear.loss_min", "a loss that is said has not ended", equal=False),
    Relation("wear.alike", "wear.recent", "what agrees is what is compared"),
    Relation("planner.shape_none_below", "planner.shape_full_at", "the line of (24) rises between them", equal=False),
    Relation("planner.removed_below", "planner.partial_min", "a motor that is not declared stays in use"),
    Relation("planner.removed_below", "planner.shape_full_at", "a whole motor is not removed", equal=False),
    Relation("planner.authority_floor", "planner.attitude_authority_min", "yaw is given up before flying is"),
    Relation("planner.attitude_authority_min", "planner.catch_authority_min", "catching asks for more"),
    Relation("override.priority.3", "override.priority.0", "heading yields to height"),
    Relation("override.priority.0", "override.priority.1", "height yields to roll"),
    Relation("override.priority.0", "override.priority.2", "height yields to pitch"),
    Relation("law.yaw_rate_max_rad_s", "law.rate_max_rad_s", "yaw is slower than roll and pitch"),
)
RISING = ("onset.ages_s", "onset.standing_s")  # vectors whose elements must rise


def value_at(root: Any, key: str) -> Any:
    """Value of a dotted key, numbers being places in a vector."""
    return functools.reduce(
        lambda at, part: at[int(part)] if part.isdigit() else getattr(at, part), key.split("."), root
    )


def key_of(key: str) -> str:
    """As people are shown it: places in vectors count from 1."""
    *above, last = key.split(".")
    return f"{'.'.join(above)}[{int(last) + 1}]" if last.isdigit() else key


def check_relations(tuning: Any) -> None:
    """Raises ConfigError naming both keys and values of the first relation that does not hold. ``tuning``: a Tuning
    whose fields are in range, each for itself."""
    for relation in RELATIONS:
        if not relation.holds(tuning):
            low, high = value_at(tuning, relation.lower), value_at(tuning, relation.upper)
            raise ConfigError(
                f"tuning.{key_of(relation.lower)} = {low!r} must be {relation.sign}"
                f" tuning.{key_of(relation.upper)} = {high!r}:"
                f" {relation.why}"
            )
    for key in RISING:
        vector = value_at(tuning, key)
        if not all(a < b for a, b in pairwise(vector)):
            raise ConfigError(f"tuning.{key} = {vector!r}: each must be greater than the one before")
    left = 1.0 - tuning.decision.loss_gradual
    if left >= tuning.decision.lift_effectiveness:
        raise ConfigError(
            f"tuning.decision.lift_effectiveness = {tuning.decision.lift_effectiveness!r} must be above"
            f" 1 - tuning.decision.loss_gradual = {left!r}: a motor lifted would be declared"
            " again"
        )
