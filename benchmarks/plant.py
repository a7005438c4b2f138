"""Time of one autopilot cycle (2.5 ms) of the emulated vehicle: ``python benchmarks/plant.py``, printed as JSON."""

from __future__ import annotations

import json
import time

import numpy as np

from nff_companion.core import vehicle
from sitl import airframe
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions

_WARM_UP = 200
_CYCLES = 2000
_BLOCK = 8  # cycles between two solves of the comparison


def measure(vehicles: int) -> dict[str, float]:
    """Median cycle of ``vehicles`` octo-x in turbulent wind: us, over one solve of an 8 x 8 linear system, and how many
    times real time that is."""
    parameters = airframe.load(vehicle.path_of("octo-x"), vehicles=vehicles)
    seeds = list(range(1, vehicles + 1))
    fleet = Fleet(parameters, FleetOptions(seeds=seeds, height_m=10.0, wind_m_s=4.0, turbulence_m_s=1.0))
    matrix, right = np.eye(8) + 0.01, np.ones(8)
    for _ in range(_WARM_UP):
        fleet.step()
    cycles, solves = [], []
    for _ in range(_CYCLES // _BLOCK):
        for _ in range(_BLOCK):
            began = time.perf_counter()
            fleet.step()
            cycles.append(time.perf_counter() - began)
        for _ in range(_BLOCK):
            began = time.perf_counter()
            np.linalg.solve(matrix, right)
            solves.append(time.perf_counter() - began)
    cycle, solve = float(np.median(cycles)), float(np.median(solves))
    return {
        "vehicles": vehicles,
        "cycle_us": round(1e6 * cycle, 1),
        "over_solve": round(cycle / solve, 2),
        "times_real_time": round(1.0 / (AUTOPILOT_RATE_HZ * cycle), 1),
    }


if __name__ == "__main__":
    print(json.dumps([measure(1), measure(64)], indent=1))
