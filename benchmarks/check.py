"""Measure what budgets.toml bounds; exit code 1 when a budget is broken.

Run with ``make bench``. Figures are printed as JSON.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import plant

from nff_companion.companion import Companion
from nff_companion.condition import Condition, Mode
from nff_companion.core import basis_network, vehicle
from nff_companion.core.sample import Sample
from sitl.trials import adaptation_bench, allocation_bench, loop_bench
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.virtual import TrialOptions, VirtualFlight


def step_over_solve() -> float:
    """Median time of a companion step over that of ``numpy.linalg.solve`` on 8 x 8, interleaved."""
    samples: list[Sample] = []

    def record(sample: Sample) -> Sample:
        samples.append(sample)
        return sample

    flight = VirtualFlight(
        make_fleet(DemoOptions(failures=[])), {0: TrialOptions(mode=Mode.OBSERVE)}, airframe="octo-x", alter=record
    )
    for _ in range(400 * 6):
        flight.step()
    model = vehicle.load("octo-x")
    companion = Companion(model, 200.0, network=basis_network.for_vehicle(model, "airframe"))
    state, condition = companion.start(Mode.OBSERVE), Condition()
    matrix, right = np.eye(8) + 0.01, np.ones(8)
    steps, solves = [], []
    for sample in samples:
        began = time.perf_counter()
        state, _ = companion.step(state, sample, condition)
        middle = time.perf_counter()
        np.linalg.solve(matrix, right)
        steps.append(middle - began)
        solves.append(time.perf_counter() - middle)
    return float(np.median(steps[600:]) / np.median(solves[600:]))


def main() -> int:
    budgets = tomllib.loads((Path(__file__).parent / "budgets.toml").read_text(encoding="utf-8"))
    loop = loop_bench.measure(rate_hz=400.0, seconds=10.0, airframe="octo-x")
    methods = allocation_bench.measure(airframe="octo-x", hover=0.0)["methods"]
    trim, pinv = methods["trim"]["median_us"], methods["pinv"]["median_us"]
    adaptation = adaptation_bench.measure("octo-x")
    found = {
        "loop": {
            "ratio_p50_max": loop["ratio_p50"],
            "ratio_p99_max": round(loop["p99_us"] / loop["echo_p50_us"], 2),
            "rss_mb_max": loop["rss_mb"],
        },
        "allocation": {"trim_median_us_max": trim, "trim_over_pinv_max": round(trim / pinv, 2)},
        "adaptation": {"median_us_max": adaptation["median_us"], "over_solve_max": adaptation["over_solve"]},
        "plant": {
            "cycle_over_solve_max": plant.measure(1)["over_solve"],
            "fleet_over_solve_max": plant.measure(64)["over_solve"],
        },
        "step": {"step_over_solve_max": round(step_over_solve(), 2)},
    }
    broken = [
        f"{room}.{key}: {value} > {budgets[room][key]}"
        for room, values in found.items()
        for key, value in values.items()
        if value > budgets[room][key]
    ]
    print(json.dumps({"found": found, "loop": loop, "broken": broken}, indent=1))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
