"""One step of the companion: sample, condition and orders in; what is believed and what should be in force out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nff_companion.allocation.plan import Plan
from nff_companion.condition import Mode, Statement, read_only
from nff_companion.core.decision import Event
from nff_companion.core.estimator import Estimate


@dataclass(frozen=True)
class Output:
    """Result of one step; arrays are read-only. ``plan`` is what should be in force: None, the autopilot's own."""

    time_s: float  # of the last good sample, by the autopilot's clock
    mode: Mode  # in effect
    obstacle: Statement | None  # why it is not the mode asked for, or why what was decided has no matrix
    flying: bool
    failed: np.ndarray  # (m,) bool
    effectiveness: np.ndarray  # (m,)
    deviation: np.ndarray  # (m,)
    degraded: np.ndarray  # (m,) bool: allocated around, not declared
    events: tuple[Event, ...]
    plan: Plan | None
    override: np.ndarray | None  # (m,) motor outputs 0..1
    estimate: Estimate | None
    unallocated: np.ndarray  # (n,)
    rejected: int  # matrices that failed the check so far
    bad_samples: int

    @cached_property
    def believed(self) -> np.ndarray:
        """(m,) effectiveness to be told: 0 of what is declared, of a partial loss what is left, of the rest 1."""
        partly = np.where(self.degraded, np.clip(self.effectiveness, 0.1, 1.0), 1.0)
        return read_only(np.where(self.failed, 0.0, partly))
