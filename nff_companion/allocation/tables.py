"""Allocation computed ahead: a plan for every set of up to two failed motors: a declaration switches at once."""

from __future__ import annotations

import itertools

import numpy as np

from nff_companion.allocation import Allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.core.tuning import DEFAULT, PlannerTuning
from nff_companion.core.vehicle import Vehicle


def mask_of(motors: tuple[int, ...]) -> int:
    """Bit mask of motors numbered from 1; bit 0 is motor 1."""
    return sum(1 << (motor - 1) for motor in motors)


def compute(
    vehicle: Vehicle, allocate: Allocator, failures: int = 2, tuning: PlannerTuning = DEFAULT.planner
) -> dict[int, Plan]:
    """Plans by failed mask. A set that no matrix can fly has none.

    Pairs are computed as for a vehicle that is still being caught: yaw is given up where roll and pitch are short.
    """
    plans: dict[int, Plan] = {}
    numbers = range(1, vehicle.motors + 1)
    for count in range(1, min(failures, max(1, vehicle.motors - vehicle.axes)) + 1):
        for failed in itertools.combinations(numbers, count):
            effectiveness = np.ones(vehicle.motors)
            effectiveness[[motor - 1 for motor in failed]] = 0.0
            plan = make_plan(
                allocate, vehicle.effectiveness, effectiveness, vehicle.hover, catching=count > 1, tuning=tuning
            )
            if isinstance(plan, Plan):
                plans[mask_of(failed)] = plan
    return plans
