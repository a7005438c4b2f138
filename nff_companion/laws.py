"""The model/control pairs that are compared, by name: which parts of the companion are at work.

    baseline    u = A0 (-K e + x_d' - f)                                nothing is learnt
    nf          u = A0 (-K e + x_d' - f - phi a)                (6.15)  Neural-Fly alone
    b           u = Bhat^R (-K e + x_d' - f)                    (6.16)  full matrix adaptation
    eff         u = (B0 Hhat)^R (-K e + x_d' - f)               (6.17)  sparse effectiveness alone
    nff         u = (B0 Hhat)^R (-K e + x_d' - f - phi a)       (6.18)  both: what flies
    omniscient  as nff, but eta is told, not found

K, its integrals among it, is the same for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

LawName = Literal["baseline", "nf", "b", "eff", "nff", "omniscient"]


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
