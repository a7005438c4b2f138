"""Remedies of single and double failures, computed on the ground so that a declaration need not wait for one."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.px4.remedy import Advisor, NoRemedy, Remedy


class RemedyBook:
    """What ``advisor`` says, remembered."""

    def __init__(self, advisor: Advisor, motors: int) -> None:
        self._advisor = advisor
        self._known: dict[bytes, Remedy | NoRemedy] = {}
        self._ahead = sets_ahead(motors)

    def prepare_one(self) -> None:
        """One set more, a few milliseconds; nothing when all are known."""
        if self._ahead:
            self.of(self._ahead.pop())

    def of(self, effectiveness: NDArray[np.float64]) -> Remedy | NoRemedy:
        """Remedy for motor ``effectiveness`` (m,), computed when it is not known."""
        found = self._known.get(effectiveness.tobytes())
        if found is None:
            found = self._advisor.remedy(effectiveness)
            if np.isin(effectiveness, (0.0, 1.0)).all():
                self._known[effectiveness.tobytes()] = found
        return found


def sets_ahead(motors: int) -> list[NDArray[np.float64]]:
    """Effectiveness (m,) of every double and single failure, the singles last: they are taken from the end."""
    out = []
    for count in (2, 1):
        for failed in itertools.combinations(range(motors), count):
            eta = np.ones(motors)
            eta[list(failed)] = 0.0
            out.append(eta)
    return out
