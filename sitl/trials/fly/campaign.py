"""Many flights on real firmware, one after the other or a few at a time."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

from nff_companion.core.vehicle import Vehicle
from sitl.trials.comparison import rms_ratio
from sitl.trials.fly import arducopter, px4
from sitl.trials.fly.arducopter import FlyOptions
from sitl.trials.fly.pilot import FlightError
from sitl.trials.survey import failure_sets

_NEIGHBOUR = 1.05  # of the least distance between two motors


def adjacent_pairs(vehicle: Vehicle) -> list[tuple[int, ...]]:
    """Pairs of motors that are neighbours."""
    position = vehicle.position_m

    def distance(pair: tuple[int, ...]) -> float:
        a, b = position[pair[0] - 1], position[pair[1] - 1]
        return float(((a - b) ** 2).sum() ** 0.5)

    pairs = failure_sets(vehicle.motors, pairs=True)
    least = min(map(distance, pairs))
    return [pair for pair in pairs if distance(pair) <= _NEIGHBOUR * least]


def sets_of(name: str, vehicle: Vehicle) -> list[tuple[int, ...]]:
    """Failure sets of a campaign: singles, adjacent, pairs, or healthy (ten flights without a failure)."""
    if name == "adjacent":
        return adjacent_pairs(vehicle)
    if name == "healthy":
        return [()] * 10
    return failure_sets(vehicle.motors, pairs=name == "pairs")


def run(
    options: FlyOptions,
    sets: list[tuple[int, ...]],
    *,
    baseline: bool,
    jobs: int = 1,
    say: Callable[[dict[str, Any]], None] = lambda flight: None,
) -> dict[str, Any]:
    """Fly every set; a flight that did not get as far as its failure is tried once more, then reported."""

    def one(index: int) -> dict[str, Any]:
        chosen = replace(options, failures=list(sets[index]), instance=options.instance + index % jobs)
        return _attempt(lambda: arducopter.run(chosen, baseline=baseline), chosen.failures, say)

    with ThreadPoolExecutor(jobs) as pool:
        # A worker takes every jobs-th flight: two at once never share an instance.
        shares = pool.map(lambda k: [one(i) for i in range(k, len(sets), jobs)], range(jobs))
        parts = list(shares)
    flights: list[dict[str, Any]] = [{} for _ in sets]
    for k, part in enumerate(parts):
        flights[k::jobs] = part
    return {"flights": flights, "summary": summary(flights)}


def run_px4(
    options: px4.FlyOptions,
    sets: list[tuple[int, ...]],
    *,
    baseline: bool,
    say: Callable[[dict[str, Any]], None] = lambda flight: None,
) -> dict[str, Any]:
    """The same on PX4, one flight at a time; a healthy campaign flies different seeds."""
    flights = []
    for index, failures in enumerate(sets):
        seed = options.seed if failures else options.seed + index
        chosen = replace(options, failures=list(failures), seed=seed)
        flights.append(_attempt(partial(px4.run, chosen, baseline=baseline), chosen.failures, say))
    return {"flights": flights, "summary": summary(flights)}


def _attempt(
    fly: Callable[[], dict[str, Any]], failures: list[int], say: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """One flight, tried twice; its document, or the error of the second attempt."""
    for attempt in (1, 2):
        try:
            flight = fly()
            flight["attempt"] = attempt
            if "error" not in flight:
                break
        except FlightError as error:
            flight = {"options": {"failures": failures}, "error": str(error), "attempt": attempt}
    say(flight)
    return flight


def summary(flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Totals; delays are from the failure to its declaration, and to the declaration's arrival on the autopilot."""
    flown = [f for f in flights if "companion" in f]
    faults = [fault for f in flown for fault in f["companion"]["faults"]]
    delays = [f["delay_s"] for f in faults if f["delay_s"] is not None]
    applied = [f["applied_delay_s"] for f in faults if f["applied_delay_s"] is not None]
    base = [f["baseline"] for f in flown if "baseline" in f]

    def median(values: list[float]) -> float | None:
        return round(statistics.median(values), 4) if values else None

    ratio = rms_ratio([f["companion"]["position_rms_m"] for f in flown], [b["position_rms_m"] for b in base])
    return {
        "flights": len(flown),
        "errors": len(flights) - len(flown),
        "too_slow": sum(f.get("machine", {}).get("too_slow", False) for f in flights),
        "survived": sum(not f["companion"]["crashed"] for f in flown),
        "baseline_survived": sum(not b["crashed"] for b in base) if base else None,
        "motors_failed": len(faults),
        "named": len(delays),
        "false_alarms": sum(f["companion"]["false_alarms"] for f in flown),
        "delay_median_s": median(delays),
        "delay_max_s": max(delays, default=None),
        "applied_delay_median_s": median(applied),
        "applied_delay_max_s": max(applied, default=None),
        "position_error_median_m": median([f["companion"]["max_position_error_m"] for f in flown]),
        "position_error_max_m": max((f["companion"]["max_position_error_m"] for f in flown), default=None),
        "baseline_position_error_median_m": median([b["max_position_error_m"] for b in base]),
        "position_rms_ratio": ratio,
        "height_lost_max_m": max((f["companion"]["height_lost_m"] or 0.0 for f in flown), default=None),
        "baseline_height_lost_min_m": min((b["height_lost_m"] or 0.0 for b in base), default=None),
        "tilt_median_deg": median([f["companion"]["max_tilt_deg"] for f in flown]),
        "baseline_tilt_median_deg": median([b["max_tilt_deg"] for b in base]),
    }
