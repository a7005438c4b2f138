"""When to solve the allocation again, for which effectiveness, and what to keep when no new matrix may be used."""

from __future__ import annotations

import numpy as np

from nff_companion.allocation import Allocator
from nff_companion.allocation.plan import Plan, Refusal, make_plan
from nff_companion.core import sparse
from nff_companion.core.estimator import Estimate
from nff_companion.core.tuning import PlannerTuning
from nff_companion.core.vehicle import Vehicle


class PlannerOptions(PlannerTuning, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The numbers, and switches that trials alone set."""

    follow_estimate: bool = False  # the published way: allocate for the shaped estimate itself, nothing declared
    shape: bool = True  # of the estimate, (24)


class Planner:
    """Holds the matrix that should be in force; ``plan`` None is the autopilot's own."""

    def __init__(self, vehicle: Vehicle, allocate: Allocator, options: PlannerOptions) -> None:
        self._vehicle, self._allocate, self._options = vehicle, allocate, options
        self.plan: Plan | None = None
        self.refusal = ""
        self.rejected = 0
        self.planned_for = np.ones(vehicle.motors)  # NaN: not yet solved
        self.restart()
        self._untouched = True  # all motors healthy, the autopilot's own allocation in force
        healthy = make_plan(allocate, vehicle.effectiveness, np.ones(vehicle.motors), vehicle.hover, tuning=options)
        self.healthy = healthy if isinstance(healthy, Plan) else None

    def restart(self) -> None:
        """Telemetry was interrupted: the plan stays, its times do not."""
        self._planned_s = self._caught_s = self._declared_s = -np.inf
        self._catching = False
        self._low_since_s = np.full(self._vehicle.motors, np.nan)

    def forget(self) -> None:
        """The next flight starts with all motors."""
        self.plan, self.refusal = None, ""
        self.planned_for = np.ones_like(self.planned_for)

    def step(self, time_s: float, estimate: Estimate) -> None:
        """Solve the allocation again when what is believed of the motors has moved."""
        o = self._options
        clear = float(estimate.effectiveness.min()) >= (o.shape_full_at if o.shape else 1.0)
        clear = clear and not estimate.failed.any()
        if clear and self._untouched:
            return
        target = self._target(time_s, estimate)
        self._untouched = clear
        change = float(np.nan_to_num(np.abs(target - self.planned_for), nan=1.0).max())
        declared = bool(estimate.events)
        if declared:
            if len(estimate.events) > 1 or time_s - self._declared_s < o.double_within_s:
                self._caught_s = time_s + o.catch_s
            self._declared_s = time_s
        catching = time_s < self._caught_s
        caught = self._catching and not catching
        self._catching = catching
        if not (declared or caught) and (change < o.resolve_change or time_s - self._planned_s < o.resolve_interval_s):
            self._untouched = self._untouched and change == 0.0
            return
        self._planned_s, self.planned_for = time_s, target
        if (target == 1.0).all():
            self.plan, self.refusal = None, ""
            return
        self._untouched = False
        vehicle = self._vehicle
        plan = make_plan(
            self._allocate, vehicle.effectiveness, target, vehicle.hover, catching=catching, tuning=self._options
        )
        if isinstance(plan, Refusal):
            self.rejected += 1
            self.refusal = f"no new matrix: {plan.reason}"
            self.planned_for = np.full_like(target, np.nan)  # try again after the interval
            if self.plan is not None and self.plan.matrix[estimate.failed].any():
                self.plan = None  # it drives a motor that is dead: the autopilot's own reduced mixing is better
        else:
            self.plan, self.refusal = plan, ""

    def _target(self, time_s: float, estimate: Estimate) -> np.ndarray:
        """Effectiveness (m,) to allocate for: declared motors gone, a lasting partial loss shaped, the rest whole."""
        o = self._options
        if o.follow_estimate:
            eta = np.minimum(np.maximum(estimate.effectiveness, 0.0), 1.0)
            return sparse.shape(eta, o.shape_full_at, o.shape_none_below) if o.shape else eta
        low = (estimate.effectiveness < o.shape_full_at) & (estimate.deviation < o.deviation_max) & ~estimate.failed
        if int(low.sum()) > 1:
            low[:] = False  # several partial losses at once have look-alikes: nothing is done on a guess
        target = np.ones(self._vehicle.motors)
        if low.any():
            self._low_since_s = np.where(low, np.fmin(self._low_since_s, time_s), np.nan)
            lasting = time_s - np.nan_to_num(self._low_since_s, nan=np.inf) >= o.degraded_for_s
            shaped = sparse.shape(estimate.effectiveness, o.shape_full_at, o.shape_none_below)
            target = np.where(low & lasting, np.maximum(shaped, o.partial_min), target)
        else:
            self._low_since_s[:] = np.nan
        target[estimate.failed] = 0.0
        return target
