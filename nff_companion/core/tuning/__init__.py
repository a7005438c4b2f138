"""Every number that decides whether a vehicle is re-mixed in flight: one table, each with unit, range and reason.

A configuration file sets them as ``[tuning.decision] explained_min = 0.8``; docs/tuning.md is made of it by
``python -m nff_companion.daemon.document``. Structs made in code (by trials) are not checked; ``check`` is for what
comes from outside. Physical constants and guards of rounding stay where they are used.
"""

from __future__ import annotations

from typing import Any

import msgspec

from nff_companion.core.tuning.action import (
    CompanionTuning,
    FlightPhaseTuning,
    HandoverTuning,
    LawTuning,
    OverrideTuning,
    PlannerTuning,
    ProbeTuning,
)
from nff_companion.core.tuning.decision import DecisionTuning, EstimatorTuning, OnsetTuning, RotorSpeedTuning
from nff_companion.core.tuning.estimation import (
    AdaptationTuning,
    BalanceTuning,
    CurveTuning,
    DisturbanceTuning,
    NetworkTuning,
    ResidualTuning,
    SampleRateTuning,
    SlidLoadTuning,
    SparseTuning,
)
from nff_companion.core.tuning.fit import FitTuning
from nff_companion.core.tuning.proposal import ProposalTuning
from nff_companion.core.tuning.relations import check_relations
from nff_companion.core.tuning.span import check_fields
from nff_companion.core.tuning.wear import WearTuning

__all__ = [
    "DEFAULT",
    "AdaptationTuning",
    "BalanceTuning",
    "CompanionTuning",
    "CurveTuning",
    "DecisionTuning",
    "DisturbanceTuning",
    "EstimatorTuning",
    "FitTuning",
    "FlightPhaseTuning",
    "HandoverTuning",
    "LawTuning",
    "NetworkTuning",
    "OnsetTuning",
    "OverrideTuning",
    "PlannerTuning",
    "ProbeTuning",
    "ProposalTuning",
    "ResidualTuning",
    "RotorSpeedTuning",
    "SampleRateTuning",
    "SlidLoadTuning",
    "SparseTuning",
    "Tuning",
    "WearTuning",
    "check",
]


class Tuning(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All of it; one set for all airframes (losses and noises are scaled by the airframe)."""

    residual: ResidualTuning = ResidualTuning()
    disturbance: DisturbanceTuning = DisturbanceTuning()
    balance: BalanceTuning = BalanceTuning()
    curve: CurveTuning = CurveTuning()
    adaptation: AdaptationTuning = AdaptationTuning()
    network: NetworkTuning = NetworkTuning()
    sparse: SparseTuning = SparseTuning()
    slid_load: SlidLoadTuning = SlidLoadTuning()
    onset: OnsetTuning = OnsetTuning()
    decision: DecisionTuning = DecisionTuning()
    estimator: EstimatorTuning = EstimatorTuning()
    rotor_speed: RotorSpeedTuning = RotorSpeedTuning()
    sample_rate: SampleRateTuning = SampleRateTuning()
    flight_phase: FlightPhaseTuning = FlightPhaseTuning()
    fit: FitTuning = FitTuning()
    proposal: ProposalTuning = ProposalTuning()
    wear: WearTuning = WearTuning()
    planner: PlannerTuning = PlannerTuning()
    handover: HandoverTuning = HandoverTuning()
    probe: ProbeTuning = ProbeTuning()
    override: OverrideTuning = OverrideTuning()
    law: LawTuning = LawTuning()
    companion: CompanionTuning = CompanionTuning()

    def having(self, subject: str, **changes: Any) -> Tuning:
        """The same with some fields of one subject changed, unchecked: ``having("decision", explained_min=0.8)``."""
        changed = msgspec.structs.replace(getattr(self, subject), **changes)
        return msgspec.structs.replace(self, **{subject: changed})


DEFAULT = Tuning()


def check(tuning: Tuning) -> None:
    """Raises ConfigError naming key, value and what is allowed where a number is of the wrong type, not finite, out of
    range, or at odds with another one."""
    check_fields(tuning, "tuning")
    check_relations(tuning)
