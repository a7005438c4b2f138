"""Solve times and torque at hover of the allocation methods."""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation import METHODS, Allocator, allocator, authority, problem_for
from nff_companion.core import vehicle as vehicle_model
from nff_companion.errors import AllocationInfeasible, SolverError

_REPEATS = 5


def _case(
    allocate: Allocator, nominal: NDArray[np.float64], failed: tuple[int, ...], hover: float
) -> NDArray[np.float64] | None:
    eta = np.ones(nominal.shape[1])
    eta[[m - 1 for m in failed]] = 0.0
    try:
        return allocate(problem_for(nominal, eta, hover))
    except (AllocationInfeasible, SolverError, np.linalg.LinAlgError):
        return None


def measure(*, airframe: str, hover: float) -> dict[str, Any]:
    """The document of ``nff bench allocation``; no torque (zeros) where a method has no solution with all axes."""
    vehicle = vehicle_model.load(airframe)
    chosen = hover or vehicle.hover
    nominal = vehicle.effectiveness
    motors = range(1, vehicle.motors + 1)
    cases: list[tuple[int, ...]] = [(), *((m,) for m in motors), *itertools.combinations(motors, 2)]
    methods: dict[str, Any] = {}
    for name in METHODS:
        allocate = allocator(name)
        torque: dict[str, list[float]] = {}
        times: list[float] = []
        for failed in cases:
            matrix = None
            for _ in range(_REPEATS):
                began = time.perf_counter()
                matrix = _case(allocate, nominal, failed, chosen)
                times.append(1e6 * (time.perf_counter() - began))
            label = "+".join(map(str, failed)) or "healthy"
            left = np.zeros(vehicle.axes - 1) if matrix is None else authority(matrix, chosen)
            torque[label] = [round(float(t), 4) for t in left]
        methods[name] = {
            "median_us": round(float(np.median(times)), 1),
            "p99_us": round(float(np.percentile(times, 99)), 1),
            "torque": torque,
        }
    return {"airframe": airframe, "hover": chosen, "methods": methods}
