"""Minimum-norm right inverse (6.9): blind to saturation."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.problem import Problem


def solve(problem: Problem) -> NDArray[np.float64]:
    """A (m, n) = B^T (B B^T)^-1."""
    return problem.expand(cast("NDArray[np.float64]", np.linalg.pinv(problem.reduced)))
