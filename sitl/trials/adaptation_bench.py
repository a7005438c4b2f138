"""``nff bench adaptation``: one adaptation step with its basis network, timed inside a recorded forward flight."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from nff_companion.core import basis_network
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.disturbance import Disturbance
from nff_companion.errors import ConfigError
from sitl.trials.training import simulate

_SECONDS = 20.0
_WARM_UP = 200


def measure(airframe: str) -> dict[str, Any]:
    """Median and 99th percentile, us, of: features to phi, phi a, Joseph step, projection onto (6.8); and the median
    over that of ``numpy.linalg.solve`` on 8 x 8, interleaved."""
    vehicle = vehicle_model.load(airframe)
    basis = basis_network.for_vehicle(vehicle, "airframe")
    if basis is None:
        raise ConfigError(f"{airframe} names no network: nothing to measure")
    flight = simulate(airframe, 1, seconds=_SECONDS, test=True, workers=1).conditions[0]
    disturbance = Disturbance(vehicle, basis)
    norm = float(np.linalg.norm(np.linalg.pinv(vehicle.effectiveness), 2))
    state = disturbance.start()
    matrix, right = np.eye(8) + 0.01, np.ones(8)
    taken, solves = [], []
    for features, residual in zip(flight.features, flight.residual, strict=True):
        began = time.perf_counter()
        value = disturbance.basis(state, features, 0.005)
        disturbance.predict(state, value)
        state = disturbance.step(state, value, residual, 0.005, allocation_norm=norm)
        middle = time.perf_counter()
        np.linalg.solve(matrix, right)
        taken.append(middle - began)
        solves.append(time.perf_counter() - middle)
    median, high = np.percentile(1e6 * np.array(taken[_WARM_UP:]), [50.0, 99.0])
    return {
        "airframe": airframe,
        "motors": vehicle.motors,
        "functions": basis.functions,
        "median_us": round(float(median), 1),
        "p99_us": round(float(high), 1),
        "over_solve": round(float(median / np.median(1e6 * np.array(solves[_WARM_UP:]))), 2),
        "steps": len(taken) - _WARM_UP,
    }
