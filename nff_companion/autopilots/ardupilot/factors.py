"""Allocation matrices in the units of ArduPilot's mixer.

Columns throttle, roll, pitch, yaw; the firmware scales its own frames so that the largest throttle factor is 1 and the
largest of each torque 0.5 (AP_MotorsMatrix::normalise_rpy_factors), and does not touch what a script loads.
"""

from __future__ import annotations

import contextlib

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot.tunnel import FACTOR_MAX, FACTOR_SCALE
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import AllocationInfeasible

_TORQUE = 0.5


def stock(vehicle: Vehicle) -> NDArray[np.float64]:
    """(m, 4): what the firmware's own frame would use."""
    x, y = vehicle.hub_position_m.T
    return np.column_stack(
        [np.ones_like(x), -_TORQUE * y / np.abs(y).max(), _TORQUE * x / np.abs(x).max(), _TORQUE * vehicle.spin]
    )


def unit(vehicle: Vehicle) -> NDArray[np.float64]:
    """(4,) mixer units of each axis for 1 of ours: loop gains stay what the pilot tuned."""
    return np.diag(vehicle.effectiveness @ stock(vehicle)).copy()


def of_matrix(vehicle: Vehicle, matrix: NDArray[np.float64]) -> NDArray[np.int16]:
    """(m, 4) int16 of an allocation matrix (m, 4). Raises AllocationInfeasible when an entry cannot be carried."""
    factors = matrix * unit(vehicle)
    if not np.isfinite(factors).all() or np.abs(factors).max() > FACTOR_MAX:
        raise AllocationInfeasible(
            f"factors up to {np.abs(factors).max():.1f}: the mixer takes at most {FACTOR_MAX:.1f}"
        )
    return np.round(factors * FACTOR_SCALE).astype(np.int16)


def of_plans(vehicle: Vehicle, plans: dict[int, Plan]) -> dict[int, NDArray[np.int16]]:
    """Factors (m, 4) int16 by failed mask; mask 0 is the stock mixer. A plan that cannot be carried has no table."""
    tables = {0: np.round(stock(vehicle) * FACTOR_SCALE).astype(np.int16)}
    for mask, plan in plans.items():
        with contextlib.suppress(AllocationInfeasible):
            tables[mask] = of_matrix(vehicle, plan.matrix)
    return tables
