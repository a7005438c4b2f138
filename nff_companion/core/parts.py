"""Which parts are at work. What flies is the default; the others are injected by research and cannot be configured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Estimate
from nff_companion.core.vehicle import Vehicle


class MatrixAdaptation(Protocol):
    """An adapted effectiveness matrix and its right inverse, in place of the allocation that flies."""

    def start(self) -> Any:
        """Nothing learnt."""

    def step(self, state: Any, estimate: Estimate, dt_s: float) -> Any:
        """One sample."""

    def allocation(self, state: Any, fallback: NDArray[np.float64]) -> tuple[Any, NDArray[np.float64]]:
        """The right inverse (m, n), ``fallback`` where there is none."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """NFF (6.18): motors are found and allocated around, phi a is learnt and fed forward, and so is the drag."""

    name: str = "nff"
    identify: bool = True
    learn: bool = True  # phi a by the network's basis, subtracted from y and fed forward
    feed_lateral: bool = True  # the lateral specific force, measured
    # Of a log: nobody flies by a matrix, lifts a declaration, or learns from what is handed out. The same is found.
    judged: bool = False
    joint: float = 0.0  # 0: phi a first, then losses; else together, phi a off by so many deviations
    target: Callable[[Estimate], NDArray[np.float64]] | None = None  # another rule for what to allocate for
    adapt: Callable[[Vehicle], MatrixAdaptation] | None = None
    estimator: Callable[[Vehicle, float], Any] | None = None  # a peer in place of ours


FLOWN = Parts()
