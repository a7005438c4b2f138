"""The model/control pairs that are compared, by name: which parts of the companion are at work.

    baseline    u = A0 (-K e + x_d' - f)                                nothing is learnt
    nf          u = A0 (-K e + x_d' - f - phi a)                (6.15)  Neural-Fly alone
    b           u = Bhat^R (-K e + x_d' - f)                    (6.16)  full matrix adaptation
    eff         u = (B0 Hhat)^R (-K e + x_d' - f)               (6.17)  sparse effectiveness alone
    nff         u = (B0 Hhat)^R (-K e + x_d' - f - phi a)       (6.18)  both: what flies
    omniscient  as nff, but the failure is told at its moment, not found

K, its integrals among it, is the same for all. Where ours differ from the published ones:

- eff searches for failures in y less a constant phi a, which is not fed forward. Without it a steady wind is a loss.
- y covers thrust and torques. The lateral force, which no motor can give, is not learnt but measured, and fed forward
  by the laws that learn (``PipelineOptions.feed_lateral``; flown both ways in docs/learning.md).
- The right inverse is the pseudo-inverse for b, whose Bhat changes at every sample; for eff, nff and omniscient it is
  the allocation that flies. nf and omniscient look for no motor, so that their phi a may explain any size of residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LawName = Literal["baseline", "nf", "b", "eff", "nff", "omniscient"]
LateralFeed = Literal["learning", "always", "never"]  # by the laws that learn; by all; by none


@dataclass(frozen=True, slots=True)
class Law:
    """Parts at work."""

    identify: bool = False  # motors are found and allocated around
    learn: bool = False  # phi a is learnt by the network's basis, subtracted from y, and fed forward
    full_matrix: bool = False  # Bhat is learnt


LAWS: dict[str, Law] = {
    "baseline": Law(),
    "nf": Law(learn=True),
    "b": Law(full_matrix=True),
    "eff": Law(identify=True),
    "nff": Law(identify=True, learn=True),
    "omniscient": Law(learn=True),
}
