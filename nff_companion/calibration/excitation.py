"""Whether a record says enough of each number, and what to fly where it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nff_companion.calibration import model
from nff_companion.calibration.fit import Fit

_ROLL = "fly sharp stops and starts to the left and right, at 3 m/s or more"
_PITCH = "fly sharp stops and starts forwards and backwards, at 3 m/s or more"
_YAW = "turn quickly to both sides, ninety degrees and more"
_CLIMB = "climb and descend quickly, by 5 m, and fly fast stretches of some seconds"
_LONGER = "hover for a minute without wind, and turn slowly once around"


@dataclass(frozen=True, slots=True)
class Verdict:
    """``deviation`` that was reached, in the ``unit`` of ``most``, and what to fly; ``enough`` when nothing more."""

    name: str
    deviation: float
    most: float
    unit: str
    advice: str

    @property
    def enough(self) -> bool:
        """Whether the number may be relied upon."""
        return bool(self.deviation <= self.most)


def verdicts(fit: Fit) -> list[Verdict]:
    """Of everything that the companion relies on."""
    d, layout = fit.deviation, fit.layout
    lag_ms = 1e3 * float(np.exp(fit.x[model.LAG]))
    roll, pitch, yaw = (100.0 * fit.command_deviation).tolist()
    centre = d[model.centre_of(layout)]
    return [
        Verdict("acceleration per roll command", roll, 10.0, "%", _ROLL),
        Verdict("acceleration per pitch command", pitch, 10.0, "%", _PITCH),
        Verdict("acceleration per yaw command", yaw, 20.0, "%", _YAW),
        Verdict("motor lag", lag_ms * d[model.LAG], 10.0, "ms", _ROLL),
        Verdict("delay of the outputs", 1e3 * d[model.DELAY], 5.0, "ms", _ROLL),
        Verdict("thrust curve", d[model.EXPO], 0.15, "", _CLIMB),
        Verdict("centre of mass, forwards", 100.0 * centre[0], 2.5, "% of the arm", _LONGER),
        Verdict("centre of mass, to the right", 100.0 * centre[1], 2.5, "% of the arm", _LONGER),
    ]
