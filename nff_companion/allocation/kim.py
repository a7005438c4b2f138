"""Kim's allocation (6.12): argmin ||A||_F + (1/m) sum |A_T - mean A_T| with B A = I and A_T >= 0."""

import daqp
import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.problem import Problem
from nff_companion.errors import SolverError

_ITERATIONS = 50


def solve(problem: Problem) -> NDArray[np.float64]:
    """A (m, n).

    The torque columns only enter the norm, so they are those of the pseudo-inverse. The thrust column a minimises
    sqrt(c^2 + |a|^2) + (1/m) sum |a - mean a|: with s the root at the optimum this is the quadratic program with
    |a|^2 / (2 s), iterated on s.
    """
    b = problem.reduced
    axes, motors = b.shape
    inverse = np.linalg.pinv(b)
    rest = float((inverse[:, 1:] ** 2).sum())
    demand = np.zeros(axes)
    demand[0] = 1.0
    centre = np.eye(motors) - np.full((motors, motors), 1.0 / motors)
    # x = [a, d] with -d <= a - mean a <= d
    rows = np.block([[b, np.zeros((axes, motors))], [centre, -np.eye(motors)], [-centre, -np.eye(motors)]])
    upper = np.concatenate([np.full(2 * motors, 1e20), demand, np.zeros(2 * motors)])
    lower = np.concatenate([np.zeros(2 * motors), demand, np.full(2 * motors, -1e20)])
    sense = np.zeros(len(upper), np.int32)
    sense[2 * motors : 2 * motors + axes] = 5
    linear = np.concatenate([np.zeros(motors), np.full(motors, 1.0 / motors)])
    column = inverse[:, 0]
    size = float(np.sqrt(rest + column @ column))
    for _ in range(_ITERATIONS):
        weight = np.diag(np.concatenate([np.full(motors, 1.0 / size), np.full(motors, 1e-6)]))
        x, _, flag, _ = daqp.solve(weight, linear, rows, upper, lower, sense)
        if flag != 1:
            raise SolverError(f"kim: the quadratic program ended with flag {flag}; use another allocation method")
        column = x[:motors]
        new = float(np.sqrt(rest + column @ column))
        if abs(new - size) < 1e-9:
            break
        size = new
    return problem.expand(np.column_stack([column, inverse[:, 1:]]))
