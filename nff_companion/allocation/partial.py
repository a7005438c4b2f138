"""Partial losses that are allocated around: of one motor at a time, and none comes or goes twice within some seconds.

By the sparse estimate a motor that has lost a part, in fast flight, is now this one and now whole, or its neighbour. A
mixer that follows each of them flies worse than one that holds what it had reason for. Pure.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import PlannerTuning


class PartialState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``held`` (m,): effectiveness that is allocated for, 1: the motor counts as whole. Times (m,) by the autopilot's
    clock: since when a motor seems to have lost a part (NaN: it does not), when it last did, and when what is held of
    it last came or went (NaN: before the telemetry stopped). ``last_s``: of the last sample."""

    held: NDArray[np.float64]
    low_since_s: NDArray[np.float64]
    low_s: NDArray[np.float64]
    changed_s: NDArray[np.float64]
    last_s: float = -np.inf

    @staticmethod
    def start(motors: int) -> PartialState:
        """All motors whole."""
        nothing = np.full(motors, -np.inf)
        return PartialState(held=np.ones(motors), low_since_s=np.full(motors, np.nan), low_s=nothing, changed_s=nothing)

    @property
    def any(self) -> bool:
        """Something is held."""
        return float(self.held.min()) < 1.0

    def interrupted(self) -> PartialState:
        """The telemetry stopped: what is held stays, the times do not hold."""
        start = PartialState.start(len(self.held))
        return replace(start, held=self.held, changed_s=np.where(self.held < 1.0, np.nan, -np.inf))


class Partial:
    """Constants."""

    def __init__(self, tuning: PlannerTuning) -> None:
        self._tuning = tuning
        whole = tuning.shape_full_at - tuning.shape_none_below
        # A matrix for less than this would be no other one, and nothing is held for which nothing is done.
        self._begins = tuning.shape_full_at - tuning.resolve_change * whole

    def step(self, state: PartialState, time_s: float, estimate: Estimate, *, trusted: bool) -> PartialState:
        """One sample. ``trusted`` False: what begins to look like a partial loss may be an error of the model."""
        o, eta = self._tuning, estimate.effectiveness
        theirs = estimate.failed.copy()  # of those that are declared something else is done
        theirs[list(estimate.either)] = True
        loss, held = (eta < o.shape_full_at) & ~theirs, state.held < 1.0
        if not (loss.any() or held.any() or np.isfinite(state.low_since_s).any()):
            return state
        if time_s - state.last_s > o.partial_pause_s:  # nothing was looked at meanwhile
            state = replace(state, low_since_s=np.full(len(eta), np.nan), low_s=np.where(held, time_s, -np.inf))
        # Several at once have look-alikes: nothing more is done on a guess.
        known = loss & (estimate.deviation < o.deviation_max) & (int(loss.sum()) == 1)
        if estimate.weak_shows:  # then it is no other one that begins
            others = np.ones_like(held)
            others[list(estimate.weak)] = False
            known &= held | ~others
        low_since = np.where(known & (trusted | held), np.fmin(state.low_since_s, time_s), np.nan)
        low = np.where(loss, time_s, state.low_s)
        changed = np.where(np.isnan(state.changed_s), time_s, state.changed_s)
        may_change = time_s - changed >= o.partial_hold_s
        over = held & (theirs | (may_change & (time_s - low >= o.partial_over_s)))
        now = np.where(over, 1.0, np.where(held & known, eta, state.held))
        if float(now.min()) == 1.0:
            lasting = time_s - np.nan_to_num(low_since, nan=np.inf) >= o.degraded_for_s
            now = np.where(lasting & may_change & ~over & (eta < self._begins), eta, now)
        changed = np.where((now < 1.0) != held, time_s, changed)
        return PartialState(held=now, low_since_s=low_since, low_s=low, changed_s=changed, last_s=time_s)
