"""One of two motors above each other works again while another fails: what neither explains alone.

Of the two, half of what they give together is believed lost (core/mates.py). Where the one that failed works again both
give more, and a motor that fails meanwhile looks like others, or like a pair with one that works. Pure.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import hypotheses
from nff_companion.core.ambiguity import needed
from nff_companion.core.mates import HALF
from nff_companion.core.onset import OnsetSums
from nff_companion.core.tuning import DecisionTuning
from nff_companion.core.weighing import Hypothesis


def _with_the_two(sums: OnsetSums, two: tuple[int, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """S (K, m + 1, m + 1) and q (K, m + 1) with one motor more, the loss of which in full is that both of ``two`` give
    what is believed lost of them."""
    chosen, share = list(two), HALF - 1.0
    column = share * np.add.reduce(sums.matrix[:, :, chosen], axis=2)  # (K, m)
    corner = share * np.add.reduce(column[:, chosen], axis=1)
    rows = np.concatenate((sums.matrix, column[:, None, :]), axis=1)
    last = np.concatenate((column, corner[:, None]), axis=1)
    more = share * np.add.reduce(sums.vector[:, chosen], axis=1)
    return np.concatenate((rows, last[:, :, None]), axis=2), np.concatenate((sums.vector, more[:, None]), axis=1)


def beside(
    found: Hypothesis,
    sums: OnsetSums,
    two: tuple[int, ...],
    failed: NDArray[np.bool_],
    gamma: float,
    tuning: DecisionTuning,
) -> Hypothesis:
    """``found``, with its margin also over that one of ``two`` works again and another motor is lost; or that motor,
    where this explains better. ``failed`` (m,) bool are declared."""
    least = tuning.look_share * tuning.improvement_min
    others = np.array([i for i in np.flatnonzero(~failed).tolist() if i not in two], np.intp)
    if not len(others) or hypotheses.together(sums.matrix, sums.vector, two, 1.0 - HALF) < least:
        return found
    matrix, vector = _with_the_two(sums, two)
    scores = hypotheses.pairs(matrix, vector, gamma, others, np.full(len(others), len(failed)))
    gains = scores.improvement.max(axis=0) - tuning.pair_min
    best, before = int(gains.argmax()), found.improvement - tuning.pair_min * (len(found.motors) > 1)
    if gains[best] <= before:
        rivals = [gain for gain, motor in zip(gains.tolist(), others.tolist(), strict=True) if found.motors != (motor,)]
        margin = min(found.margin, before - max(rivals, default=0.0))
        return replace(found, margin=margin, beside=min(found.beside, margin))
    window = int(scores.improvement[:, best].argmax())
    e, chosen = scores.e[window, best], [int(others[best]), len(failed)]
    fit = float(vector[window][chosen] @ e - 0.5 * e @ matrix[window][np.ix_(chosen, chosen)] @ e)
    rivals = [*np.delete(gains, best).tolist(), before if found.motors != (chosen[0],) else 0.0]
    margin = float(gains[best]) - max([*rivals, hypotheses.together(sums.matrix, sums.vector, two, 1.0 - HALF)])
    return Hypothesis(
        motors=(chosen[0],),
        loss=(-float(e[0]),),
        improvement=float(gains[best]),
        margin=margin,
        beside=margin,
        explained=2.0 * fit / max(float(sums.energy[window]), 1e-12),
        age_s=float(sums.age_s[window]),
        overruled=margin < needed(float(gains[best]), tuning),
    )
