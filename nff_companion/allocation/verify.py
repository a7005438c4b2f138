"""Every matrix is checked before it leaves the process."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.problem import Problem
from nff_companion.core.tuning import DEFAULT, PlannerTuning


def fault_of(
    matrix: NDArray[np.float64],
    problem: Problem,
    tuning: PlannerTuning = DEFAULT.planner,
    wanted: NDArray[np.float64] | None = None,
    demand: NDArray[np.float64] | None = None,
) -> str | None:
    """What is wrong with A (m, n) for ``problem``; None when it may be used.

    Checks: shape, finite, B A = ``wanted`` (n, n; None: I) on the axes kept, gain bound, removed motors idle,
    thrusts within 0..1 at ``demand`` (n,; None: hover).
    """
    axes, motors = problem.effectiveness.shape
    if matrix.shape != (motors, axes):
        return f"shape {matrix.shape}, expected {(motors, axes)}"
    if not np.isfinite(matrix).all():
        return "entries are not finite"
    largest = float(np.abs(matrix).max())
    if largest > tuning.gain_max:
        return f"gain {largest:.1f} exceeds {tuning.gain_max}"
    kept = problem.kept
    wanted = np.eye(axes) if wanted is None else wanted
    error = float(np.abs((problem.effectiveness @ matrix - wanted)[np.ix_(kept, kept)]).max())
    if error > tuning.identity_tolerance:
        return f"B A differs from what it should be by {error:.1e}"
    if np.any(matrix[~problem.active] != 0.0):
        return "a removed motor is driven"
    trim = matrix[:, 0] * problem.hover if demand is None else matrix @ demand
    if trim.min() < -1e-9 or trim.max() > 1.0 + 1e-9:
        return f"hover needs motor thrusts from {trim.min():.2f} to {trim.max():.2f}, outside 0..1"
    return None
