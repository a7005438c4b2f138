"""Minimum-norm right inverse (6.9): blind to saturation."""

import numpy as np

from nff_companion.allocation.problem import Problem


def solve(problem: Problem) -> np.ndarray:
    """A (m, n) = B^T (B B^T)^-1."""
    return problem.expand(np.linalg.pinv(problem.reduced))
