"""A second look at a motor that has just been declared: does all that was seen since its loss began still speak for it?

Two motors that stop at once can look, for the first tenth of a second, like one between them, and one is likelier. It
is then declared, and everything afterwards is explained without it. So the windows as they were go on for a moment, in
which that motor is one that may work, as before. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.onset import OnsetState


@dataclass(slots=True)
class SecondLook:
    """``onset``: the windows from before the declaration, going on; ``failed`` (m,) bool: what was declared until then;
    ``motor``: index of what was declared."""

    onset: OnsetState
    failed: NDArray[np.bool_]
    motor: int
    until_s: float

    def residual(
        self, residual: NDArray[np.float64], effectiveness_matrix: NDArray[np.float64], thrust: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """y (n,) as if ``motor`` had not been declared; ``residual`` (n,) is that without it, ``thrust`` (m,) w."""
        return np.asarray(residual - effectiveness_matrix[:, self.motor] * thrust[self.motor])
