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
  by the laws that learn (``Parts.feed_lateral``; flown both ways in docs/learning.md).
- The right inverse is the pseudo-inverse for b, whose Bhat changes at every sample; for eff, nff and omniscient it is
  the allocation that flies. nf and omniscient look for no motor, so that their phi a may explain any size of residual.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import sparse
from nff_companion.core.estimate import Estimate
from nff_companion.core.parts import FLOWN, Parts
from sitl.trials.research.adapted import AdaptedMatrix

_NOTHING = Parts(name="baseline", identify=False, learn=False, feed_lateral=False)

LAWS: dict[str, Parts] = {
    "baseline": _NOTHING,
    "nf": replace(_NOTHING, name="nf", learn=True, feed_lateral=True),
    "b": replace(_NOTHING, name="b", adapt=AdaptedMatrix),
    "eff": replace(_NOTHING, name="eff", identify=True),
    "nff": FLOWN,
    "omniscient": replace(_NOTHING, name="omniscient", learn=True, feed_lateral=True),
}

_FULL_AT, _NONE_BELOW = 0.75, 0.30  # zeta and xi of the paper's figures


def shaped(estimate: Estimate) -> NDArray[np.float64]:
    """The published way: allocate for the estimate itself (m,), shaped by (24); nothing is declared."""
    return sparse.shape(np.clip(estimate.effectiveness, 0.0, 1.0), _FULL_AT, _NONE_BELOW)


def unshaped(estimate: Estimate) -> NDArray[np.float64]:
    """The same without the shaping."""
    return np.clip(estimate.effectiveness, 0.0, 1.0)
