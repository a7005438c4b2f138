"""Simulated flights without failures, to train and to score a network on."""

from __future__ import annotations

import os

from nff_companion.core import vehicle as vehicle_model
from nff_companion.training.dataset import Condition, Dataset, Recorder
from sitl import airframe as plant_airframe
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials import forward
from sitl.trials.pool import pool_of
from sitl.trials.virtual import sample_of

RATE_HZ = 200.0
MODEL_ERROR = 0.10
TURBULENCE_SHARE = 0.25
# The two sets have no wind, no speed of a leg and no seed in common; nor has the first one a wind in common with the
# surveys and comparisons. Speeds pass through all values on the way.
TRAIN_SPEEDS_M_S, TRAIN_WINDS_M_S = (0.0, 3.0, 6.0, 9.0, 11.0, 13.0), (0.0, 2.5, 4.5, 6.5)
TEST_SPEEDS_M_S, TEST_WINDS_M_S = forward.SPEEDS_M_S, (3.0, 5.0, 7.0)
_TRAIN_SEEDS, _TEST_SEEDS = 1000, 5000


def simulate(
    airframe: str, flights: int, *, seconds: float = 60.0, test: bool = False, seed: int = 0, workers: int | None = None
) -> Dataset:
    """``flights`` of ``seconds`` each: every one a condition of its own vehicle and wind."""
    first = (_TEST_SEEDS if test else _TRAIN_SEEDS) + 10_000 * seed
    winds = TEST_WINDS_M_S if test else TRAIN_WINDS_M_S
    speeds = TEST_SPEEDS_M_S if test else TRAIN_SPEEDS_M_S
    jobs = [(first + k, winds[k % len(winds)]) for k in range(flights)]
    count = min(workers or os.cpu_count() or 1, flights)
    shares = [(airframe, jobs[k::count], speeds, seconds) for k in range(count)]
    if count == 1:
        parts = [_fly(*shares[0])]
    else:
        with pool_of(count) as pool:
            parts = pool.starmap(_fly, shares)
    out: list[Condition | None] = [None] * flights
    for k, part in enumerate(parts):
        out[k::count] = part
    return Dataset([condition for condition in out if condition is not None])


def _fly(
    airframe: str, jobs: list[tuple[int, float]], speeds_m_s: tuple[float, ...], seconds: float
) -> list[Condition]:
    seeds, winds = [seed for seed, _ in jobs], [wind for _, wind in jobs]
    fleet = Fleet(
        plant_airframe.load(vehicle_model.path_of(airframe), vehicles=len(jobs)),
        FleetOptions(
            seeds=seeds,
            model_error=MODEL_ERROR,
            wind_m_s=winds,
            turbulence_m_s=[TURBULENCE_SHARE * wind for wind in winds],
            height_m=forward.HEIGHT_M,
        ),
    )
    script = forward.Script(fleet, seeds, speeds_m_s)
    recorders = [Recorder(vehicle_model.load(airframe), RATE_HZ) for _ in jobs]
    every = round(AUTOPILOT_RATE_HZ / RATE_HZ)
    while fleet.time_s < seconds:
        script.step(fleet.time_s)
        fleet.step()
        if fleet.cycle % every == 0:
            for index, recorder in enumerate(recorders):
                if not fleet.state.crashed[index]:
                    recorder.add(sample_of(fleet, index))
    return [
        recorder.condition(f"seed {seed}, wind {wind:g} m/s")
        for recorder, seed, wind in zip(recorders, seeds, winds, strict=True)
    ]
