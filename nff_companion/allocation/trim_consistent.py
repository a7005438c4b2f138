"""Trim-consistent allocation: the printed program with the hover trim as a variable.

max  t_R + t_P + t_Y - max_j (u_h)_j / h
s.t. B u_h = (h, 0, 0, 0),  B A_i = t_i e_i,  0 <= u_h +- A_i <= 1
then A_T = u_h / h,  A_i := A_i / t_i   (after (6.13), (6.14))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.linear_program import LinearSolver, Program, nearest_optimal
from nff_companion.allocation.problem import Problem
from nff_companion.core.tuning import DEFAULT
from nff_companion.errors import AllocationInfeasible


def _program(b: NDArray[np.float64], hover: float) -> Program:
    """Columns: u_h (m), A_i (m each), t_i, and the largest (u_h)_j / h."""
    axes, motors = b.shape
    torques = axes - 1
    width = motors * axes + torques + 1
    rows = np.zeros((axes + torques * axes + 2 * torques * motors + motors, width))
    lower = np.zeros(len(rows))
    upper = np.zeros(len(rows))
    eye = np.eye(motors)
    rows[:axes, :motors] = b
    lower[0] = upper[0] = hover
    at = axes
    for i in range(1, axes):
        columns = slice(i * motors, (i + 1) * motors)
        rows[at : at + axes, columns] = b
        rows[at + i, motors * axes + i - 1] = -1.0
        at += axes
        for sign in (1.0, -1.0):
            rows[at : at + motors, :motors] = eye
            rows[at : at + motors, columns] = sign * eye
            upper[at : at + motors] = 1.0
            at += motors
    rows[at:, :motors] = eye
    rows[at:, -1] = -hover
    lower[at:] = -np.inf
    objective = np.zeros(width)
    objective[motors * axes : -1] = 1.0
    objective[-1] = -1.0
    return Program(
        objective=objective,
        rows=rows,
        lower=lower,
        upper=upper,
        column_lower=np.concatenate([np.zeros(motors), np.full(torques * motors, -1.0), np.zeros(torques), [0.0]]),
        column_upper=np.concatenate([np.ones(motors * axes), np.full(torques, 2.0), [np.inf]]),
    )


def solve(
    problem: Problem, solver: LinearSolver, authority_min: float = DEFAULT.planner.axis_authority_min
) -> NDArray[np.float64]:
    """A (m, n). Raises AllocationInfeasible when an axis has less than ``authority_min`` of its torque left at hover,
    SolverError."""
    b, hover = problem.reduced, problem.hover
    axes, motors = b.shape
    program = _program(b, hover)
    optimum = solver.solve(program)
    # Least effort: among equal authorities the smallest torque columns, and the trim nearest to the pseudo-inverse's.
    reference = np.full(len(optimum), np.nan)
    reference[:motors] = hover * np.linalg.pinv(b)[:, 0]
    reference[motors : motors * axes] = 0.0
    x = nearest_optimal(program, optimum, reference)
    torque = x[motors * axes : motors * axes + axes - 1]
    if torque.min() < authority_min:
        raise AllocationInfeasible(
            f"no torque left on {int((torque < authority_min).sum())} of the axes at hover: give up yaw, or land"
        )
    columns = x[motors : motors * axes].reshape(axes - 1, motors)
    matrix = np.column_stack([x[:motors] / hover, (columns / torque[:, None]).T])
    # Solver tolerance out: B A = I to rounding.
    return problem.expand(matrix @ np.linalg.inv(b @ matrix))
