"""What the motors left can lift at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.linear_program import LinearSolver, Program
from nff_companion.core.vehicle import PITCH, ROLL, THRUST
from nff_companion.errors import AllocationInfeasible, SolverError


def balanced_thrust(
    nominal: NDArray[np.float64], effectiveness: NDArray[np.float64], solver: LinearSolver | None = None
) -> float:
    """Largest thrust, in normalised units, with roll and pitch torque in balance and yaw let go.

    ``nominal`` B0 (n, m) normalised, ``effectiveness`` (m,) in 0..1:  max B_T u,  B_R u = B_P u = 0,  0 <= u <= eta.
    """
    motors = nominal.shape[1]
    program = Program(
        objective=nominal[THRUST],
        rows=nominal[[ROLL, PITCH]],
        lower=np.zeros(2),
        upper=np.zeros(2),
        column_lower=np.zeros(motors),
        column_upper=np.asarray(effectiveness, float),
    )
    try:
        u = (solver or LinearSolver()).solve(program)
    except (AllocationInfeasible, SolverError):
        return 0.0
    return float(nominal[THRUST] @ u)
