"""Maximum control authority (6.11): every motor fully up or down; only right where B sign(B^T) is diagonal."""

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.problem import Problem, normalised_columns


def solve(problem: Problem) -> NDArray[np.float64]:
    """A (m, n) = sign(B^T) scaled by (6.14), which also removes the cross-coupling of an asymmetric airframe."""
    return problem.expand(normalised_columns(problem, np.sign(problem.reduced).T))
