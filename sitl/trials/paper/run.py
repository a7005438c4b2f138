"""All flights of the comparison, over processes."""

from __future__ import annotations

import os

from sitl.trials.paper.scenario import GROUPS, Case, PaperOptions, Trace, fly
from sitl.trials.pool import pool_of


def run(options: PaperOptions, workers: int | None = None) -> list[Trace]:
    """Every controller, group and seed."""
    cases = [
        Case(controller, group, seed)
        for seed in range(1, options.seeds + 1)
        for controller in options.controllers
        for group in GROUPS
    ]
    count = min(workers or os.cpu_count() or 1, len(cases))
    if count == 1:
        return fly(options, cases)
    with pool_of(count) as pool:
        parts = pool.starmap(fly, [(options, cases[k::count]) for k in range(count)])
    return [trace for part in parts for trace in part]
