"""The allocation problem: an effectiveness matrix for what is left, hover fraction, and the axes kept.

Normalised units: each row of B over the sum of its positive entries on the healthy airframe, so demand 1 is all that
the motors could give on that axis. Pure: numpy in, numpy out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import DEFAULT
from nff_companion.errors import AllocationInfeasible


@dataclass(frozen=True, kw_only=True)
class Problem:
    """``effectiveness`` (n, m) = B0 Hhat with removed motors still in place as zero columns; ``hover`` h in 0..1.

    ``kept`` (n,) bool: axes that the matrix must serve; the others are given up (zero columns of A).
    """

    effectiveness: NDArray[np.float64]
    hover: float
    active: NDArray[np.bool_]  # (m,) bool, motors that take part
    kept: NDArray[np.bool_]

    @property
    def reduced(self) -> NDArray[np.float64]:
        """B of kept axes and active motors."""
        return self.effectiveness[np.ix_(self.kept, self.active)]

    def expand(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """A (m, n) with zero rows and columns for what was left out, from A of the reduced problem."""
        axes, motors = self.effectiveness.shape
        full = np.zeros((motors, axes))
        full[np.ix_(self.active, self.kept)] = matrix
        return full


def problem_for(
    nominal: NDArray[np.float64],
    effectiveness: NDArray[np.float64],
    hover: float,
    released: tuple[int, ...] = (),
    removed_below: float = DEFAULT.planner.removed_below,
) -> Problem:
    """Problem for ``nominal`` B0 (n, m) and motor effectiveness (m,) in 0..1, giving up the axes ``released``; columns
    of motors with less than ``removed_below`` are removed.

    Raises AllocationInfeasible when the motors left do not span the kept axes.
    """
    eta = np.asarray(effectiveness, float)
    active = eta >= removed_below
    kept = np.ones(nominal.shape[0], bool)
    kept[list(released)] = False
    problem = Problem(effectiveness=nominal * np.where(active, eta, 0.0), hover=hover, active=active, kept=kept)
    left = problem.reduced
    if left.shape[1] < left.shape[0] or np.linalg.matrix_rank(left, tol=1e-6) < left.shape[0]:
        raise AllocationInfeasible(
            f"motors {[int(i) + 1 for i in np.flatnonzero(active)]} do not span {int(kept.sum())} axes: "
            "give up yaw, or land"
        )
    return problem


def normalised_columns(problem: Problem, columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """A = Abar (B Abar)^-1, equation (6.14). Raises AllocationInfeasible when B Abar is singular."""
    product = problem.reduced @ columns
    if np.linalg.cond(product) > 1e9:
        raise AllocationInfeasible("the allocation columns do not span the wrench: motors left cannot balance")
    return cast("NDArray[np.float64]", np.linalg.solve(product.T, columns.T).T)


def authority(matrix: NDArray[np.float64], hover: float) -> NDArray[np.float64]:
    """Demand (n - 1,) that each axis after thrust can take in both directions at hover before a motor saturates."""
    trim = matrix[:, 0] * hover
    room = np.minimum(trim, 1.0 - trim)
    out = np.zeros(matrix.shape[1] - 1)
    for axis in range(1, matrix.shape[1]):
        column = np.abs(matrix[:, axis])
        used = column > 1e-12
        out[axis - 1] = max(float((room[used] / column[used]).min()), 0.0) if used.any() else 0.0
    return out
