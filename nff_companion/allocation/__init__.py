"""Allocation: one file per method behind :func:`allocate`.

Motor thrusts u = A demand, with B A = I (6.2). Methods: ``pinv`` (6.9), ``mca`` (6.11), ``kim`` (6.12), ``printed``
(6.13, 6.14 as published, made consistent) and ``trim`` (trim-consistent, the default).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation import kim, mca, pinv, printed, trim_consistent
from nff_companion.allocation.linear_program import LinearSolver
from nff_companion.allocation.problem import Problem, authority, problem_for
from nff_companion.core.tuning import DEFAULT, PlannerTuning
from nff_companion.errors import ConfigError

__all__ = ["METHODS", "Allocator", "Problem", "allocator", "authority", "problem_for"]

Allocator = Callable[[Problem], NDArray[np.float64]]
METHODS = ("pinv", "mca", "kim", "printed", "trim")


def allocator(method: str, tuning: PlannerTuning = DEFAULT.planner) -> Allocator:
    """The function that turns a Problem into A (m, n). Raises ConfigError for an unknown method."""
    solver = LinearSolver()
    functions: dict[str, Allocator] = {
        "pinv": pinv.solve,
        "mca": mca.solve,
        "kim": kim.solve,
        "printed": lambda problem: printed.solve(problem, solver),
        "trim": lambda problem: trim_consistent.solve(problem, solver, tuning.axis_authority_min),
    }
    if method not in functions:
        raise ConfigError(f"allocation method {method!r} is unknown: choose one of {', '.join(METHODS)}")
    return functions[method]
