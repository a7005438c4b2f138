"""From an effectiveness estimate to a matrix that may be sent: which axes to keep, verified, with what is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation import Allocator, authority, problem_for
from nff_companion.allocation.lift import balanced_thrust
from nff_companion.allocation.problem import Problem
from nff_companion.allocation.verify import fault_of
from nff_companion.condition import read_only
from nff_companion.core.tuning import DEFAULT, PlannerTuning
from nff_companion.core.vehicle import YAW
from nff_companion.errors import AllocationInfeasible, SolverError


@dataclass(frozen=True, kw_only=True)
class Plan:
    """``matrix`` A (m, n) verified, right inverse of ``effectiveness`` B (n, m) of the motors left;
    ``released`` axes given up; ``unallocated`` (n,) demand not met at hover. Arrays are read-only."""

    matrix: NDArray[np.float64]
    effectiveness: NDArray[np.float64]
    released: tuple[int, ...]
    authority: NDArray[np.float64]  # (n - 1,)
    unallocated: NDArray[np.float64]

    @cached_property
    def norm(self) -> float:
        """sigma(A): largest singular value."""
        return float(np.linalg.norm(self.matrix, 2))


@dataclass(frozen=True, kw_only=True)
class Refusal:
    """No matrix may be sent, and why; ``lift`` False: the motors left cannot carry the weight at all."""

    reason: str
    lift: bool = True


def make_plan(
    allocate: Allocator,
    nominal: NDArray[np.float64],
    effectiveness: NDArray[np.float64],
    hover: float,
    *,
    alike: tuple[int, ...] = (),
    catching: bool = False,
    tuning: PlannerTuning = DEFAULT.planner,
) -> Plan | Refusal:
    """Matrix for motor ``effectiveness`` (m,): all axes when roll and pitch keep authority, else without yaw.

    ``alike``: motors (indices) that get the same command whatever is asked for, as one of them is lost and it is not
    known which: what is right for the one is right for the other, and yaw is not made of the difference of the two.
    """
    reason = ""
    if alike:
        nominal = nominal.copy()
        nominal[:, alike] = nominal[:, alike].mean(axis=1, keepdims=True)
    enough = tuning.catch_authority_min if catching else tuning.attitude_authority_min
    spare: Plan | None = None
    for released in ((), (YAW,)):
        try:
            problem = problem_for(nominal, effectiveness, hover, released, tuning.removed_below)
            matrix = allocate(problem)
            if alike:
                matrix = matrix.copy()
                matrix[list(alike)] = matrix[list(alike)].mean(axis=0)
        except (AllocationInfeasible, SolverError, np.linalg.LinAlgError) as error:
            reason = str(error)
            continue
        reason = fault_of(matrix, problem, tuning) or ""
        if reason:
            continue
        left = authority(matrix, hover)
        least = float(left[: YAW - 1].min())
        demand = np.zeros(nominal.shape[0])
        demand[0] = hover
        given = problem.effectiveness @ np.clip(matrix @ demand, 0.0, 1.0)
        plan = Plan(
            matrix=read_only(matrix),
            effectiveness=read_only(problem.effectiveness),
            released=released,
            authority=read_only(left),
            unallocated=read_only(demand - given),
        )
        if least >= (tuning.authority_floor if released else enough):
            return plan
        if least >= tuning.attitude_authority_min:
            spare = plan  # good enough should giving up yaw not work
        reason = f"roll/pitch authority at hover only {least:.2f}"
    return spare or Refusal(reason=reason, lift=balanced_thrust(nominal, effectiveness) >= hover)


def moved(
    plan: Plan, by: NDArray[np.float64], thrust: float, hover: float, tuning: PlannerTuning = DEFAULT.planner
) -> Plan | Refusal:
    """``plan`` with motor thrusts moved by ``by`` (m,), which turns and lifts nothing, while the thrust asked for is
    ``thrust``: through the column of thrust."""
    matrix = np.array(plan.matrix)
    matrix[:, 0] += by / thrust
    kept = np.ones(len(plan.effectiveness), bool)
    kept[list(plan.released)] = False
    active = np.any(plan.effectiveness != 0.0, axis=0)
    fault = fault_of(matrix, Problem(effectiveness=plan.effectiveness, hover=hover, active=active, kept=kept), tuning)
    return replace(plan, matrix=read_only(matrix)) if fault is None else Refusal(reason=fault)


def carried(
    plan: Plan, wrench: NDArray[np.float64], thrust: float, hover: float, tuning: PlannerTuning = DEFAULT.planner
) -> Plan:
    """``plan`` that gives ``wrench`` (n,) less than is asked for, while the thrust asked for is ``thrust``: through the
    column of thrust; as much of it as may be sent."""
    kept = np.ones(len(plan.effectiveness), bool)
    kept[list(plan.released)] = False
    active = np.any(plan.effectiveness != 0.0, axis=0)
    problem = Problem(effectiveness=plan.effectiveness, hover=hover, active=active, kept=kept)
    for refused in range(tuning.carry_steps):
        less = (1.0 - refused / tuning.carry_steps) * wrench / thrust
        matrix = np.array(plan.matrix)
        matrix[:, 0] -= matrix @ less
        wanted = np.eye(len(wrench))
        wanted[:, 0] -= less
        demand = (1.0 - refused / tuning.carry_steps) * wrench
        demand[0] += hover  # as it is asked for by now
        if fault_of(matrix, problem, tuning, wanted, demand) is None:
            return replace(plan, matrix=read_only(matrix))
    return plan
