"""The published linear program (6.13), [L] (32), in its consistent reading.

max  h B_T A_T + sum_i [B_i (h A_T + A_i) - B_i (h A_T - A_i)],  0 <= A_T <= 1, B_{R,P,Y} A_T = 0,
     0 <= h A_T +- A_i <= 1, B_j A_i = 0 for all j != i; then (6.14).

As printed, [T] weights the thrust term without h and asks B_T A_i = h (infeasible with a motor dead), and [L]
forces thrust h at a trim that cannot give it: both contradict (6.14). Its optimum is a face, not a point; as in the
paper the vertex that the simplex method ends in is taken, which is why this method is a reference and not flown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.linear_program import LinearSolver, Program
from nff_companion.allocation.problem import Problem, normalised_columns


def _program(b: NDArray[np.float64], hover: float) -> Program:
    axes, motors = b.shape
    torques = axes - 1
    width = motors * axes
    eye = np.eye(motors)
    rows: list[NDArray[np.float64]] = []
    lower: list[NDArray[np.float64]] = []
    upper: list[NDArray[np.float64]] = []

    def block(entries: dict[int, NDArray[np.float64]], low: float, high: float) -> None:
        height = next(iter(entries.values())).shape[0]
        row = np.zeros((height, width))
        for index, value in entries.items():
            row[:, index * motors : (index + 1) * motors] = value
        rows.append(row)
        lower.append(np.full(height, low))
        upper.append(np.full(height, high))

    block({0: b[1:]}, 0.0, 0.0)
    objective = np.zeros(width)
    objective[:motors] = hover * b[0]
    for i in range(1, torques + 1):
        block({i: np.delete(b, i, axis=0)}, 0.0, 0.0)
        block({0: hover * eye, i: eye}, 0.0, 1.0)
        block({0: hover * eye, i: -eye}, 0.0, 1.0)
        objective[i * motors : (i + 1) * motors] = 2.0 * b[i]
    column_lower = np.concatenate([np.zeros(motors), np.full(motors * torques, -1.0)])
    return Program(
        objective=objective,
        rows=np.vstack(rows),
        lower=np.concatenate(lower),
        upper=np.concatenate(upper),
        column_lower=column_lower,
        column_upper=np.ones(width),
    )


def solve(problem: Problem, solver: LinearSolver) -> NDArray[np.float64]:
    """A (m, n). Raises AllocationInfeasible, SolverError."""
    b = problem.reduced
    x = solver.solve(_program(b, problem.hover))
    return problem.expand(normalised_columns(problem, x.reshape(b.shape[0], b.shape[1]).T))
