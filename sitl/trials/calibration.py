"""Calibration measured: vehicles off from their airframe file are flown, their logs calibrated, and the files that come
out compared with the truth; and, flown with them, how soon each motor's failure is named.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import model
from nff_companion.calibration.fit import Fit
from nff_companion.condition import Mode
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NffError
from nff_companion.replay.calibrate import Calibration, Start, calibrate
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials import flown_log, true_file
from sitl.trials.pool import pool_of
from sitl.trials.virtual import TrialOptions, VirtualFlight
from sitl.uncertainty import Uncertainty

FIRST_SEED = 101
_WIND_M_S, _TURBULENCE_M_S, _HEIGHT_M, _MODEL_ERROR = 3.0, 0.75, 20.0, 0.10
_FAIL_S, _END_S = 5.0, 11.0
FILES = ("exact", "calibrated", "estimated")
_WITHIN = {"acceleration_per_output": 0.05, "acceleration": 0.05, "lag_ms": 5.0, "delay_ms": 3.0, "expo": 0.1}


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions:
    """What to fly. ``identify``: fail each motor with each of the ``FILES``."""

    airframe: str = "octo-x"
    vehicles: int = 50
    seconds: float = 180.0
    first_seed: int = FIRST_SEED
    identify: bool = False


def measure(options: CalibrationOptions, workers: int | None = None) -> dict[str, Any]:
    """The document of ``nff bench calibration``."""
    seeds = range(options.first_seed, options.first_seed + options.vehicles)
    count = min(workers or os.cpu_count() or 1, options.vehicles)
    with tempfile.TemporaryDirectory(prefix="nff-calibration-") as folder:
        jobs = [(options, list(seeds)[k::count], folder) for k in range(count)]
        with pool_of(count) as pool:
            vehicles = sorted((v for part in pool.starmap(_vehicles, jobs) for v in part), key=lambda v: int(v["seed"]))
    return {
        "airframe": options.airframe,
        "seconds": options.seconds,
        "vehicles": vehicles,
        "summary": summary(vehicles),
    }


def summary(vehicles: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares within what is wanted, and within two deviations, of all numbers; delays of the declarations."""
    made = [v for v in vehicles if "errors" in v]
    out: dict[str, Any] = {"vehicles": len(vehicles), "calibrated": len(made)}
    for key, most in _WITHIN.items():
        errors = np.array([np.atleast_1d(v["errors"][key]) for v in made])
        if not len(errors):
            continue
        out[key] = {
            "within": round(float(np.mean(np.abs(errors) <= most)), 3),
            "wanted": most,
            "median": round(float(np.median(np.abs(errors))), 4),
            "worst": round(float(np.abs(errors).max()), 4),
        }
        if key in made[0]["deviations"]:
            deviations = np.array([np.atleast_1d(v["deviations"][key]) for v in made])
            out[key]["within_two_deviations"] = round(float(np.mean(np.abs(errors) <= 2.0 * deviations)), 3)
    for name in FILES:
        flights = [f for v in vehicles for f in v.get("failures", []) if f["file"] == name]
        if flights:
            delays = [f["delay_s"] for f in flights if f["delay_s"] is not None]
            out[name] = {
                "flights": len(flights),
                "missed": sum(f["delay_s"] is None for f in flights),
                "wrong": sum(bool(f["wrong"]) for f in flights),
                "delay_median_s": round(float(np.median(delays)), 4) if delays else None,
                "delay_max_s": round(max(delays), 4) if delays else None,
            }
    return out


def _options(seeds: list[int]) -> FleetOptions:
    return FleetOptions(
        seeds=seeds,
        model_error=_MODEL_ERROR,
        wind_m_s=_WIND_M_S,
        turbulence_m_s=_TURBULENCE_M_S,
        height_m=_HEIGHT_M,
        uncertainty=Uncertainty.estimated(),
    )


def _vehicles(options: CalibrationOptions, seeds: list[int], folder: str) -> list[dict[str, Any]]:
    """Fly these together, calibrate each."""
    nominal = vehicle_model.path_of(options.airframe)
    fleet = Fleet(plant_airframe.load(nominal, vehicles=len(seeds)), _options(seeds))
    place = Path(folder) / f"from{seeds[0]}"
    place.mkdir()
    logs = [place / f"{seed}.tlog" for seed in seeds]
    flown_log.write(fleet, logs, options.seconds)
    out = []
    for index, (seed, log) in enumerate(zip(seeds, logs, strict=True)):
        true = place / f"true{seed}.toml"
        true.write_text(true_file.text(nominal, fleet.parameters, index), encoding="utf-8")
        out.append(_one(options, seed, log, true))
    return out


def _one(options: CalibrationOptions, seed: int, log: Path, true: Path) -> dict[str, Any]:
    try:
        found = calibrate([log], Start(airframe=options.airframe), f"seed{seed}")
    except NffError as error:
        return {"seed": seed, "refused": str(error)}
    made = log.with_suffix(".toml")
    made.write_text(found.text, encoding="utf-8")
    errors, deviations = compare(found, vehicle_model.load(str(made)), vehicle_model.load(str(true)))
    document: dict[str, Any] = {
        "seed": seed,
        "errors": errors,
        "deviations": deviations,
        "order": found.order.best.text,
    }
    if options.identify:
        files = dict(zip(FILES, (str(true), str(made), options.airframe), strict=True))
        document["failures"] = [f for name, file in files.items() for f in _failures(options, seed, name, file)]
    return document


def compare(found: Calibration, made: Vehicle, true: Vehicle) -> tuple[dict[str, Any], dict[str, Any]]:
    """Errors and deviations of ``made``, by what was ``found``: of roll, pitch and yaw accelerations by all of the lift
    that there is at the mean outputs (what a lost motor takes away), and by a change of the outputs there (what a
    command does), as shares.

    The two differ by the thrust curve, which is less well known than what a command does. The delay is that of output
    and gyro's filter together: of a filter that is not what the file says it takes the difference.
    """
    fit, layout = found.fit, found.fit.layout
    at_mean = true.acceleration_effectiveness * float(true.thrust_fraction(np.array(fit.mean_output)))
    lift = float(np.exp(fit.x[model.gains_of(layout)][model.THRUST]))
    at_mean = at_mean * lift / at_mean[model.THRUST].sum()
    mine = model.accelerations(fit.x, layout)
    turning = (model.ROLL, model.PITCH, model.YAW)
    gains = [float(mine[k] @ layout.rows[k] / (at_mean[k] @ layout.rows[k]) - 1.0) for k in turning]
    shape, d = model.shape_of(fit.x, layout.full), fit.deviation
    steeper = model.steepness(fit.x, layout, fit.mean_output)[0] / _steepness(fit, true.thrust_fraction)
    lag_s = 0.5 * (shape.lag_up_s + shape.lag_down_s)
    true_lag_s = 0.5 * float(np.mean(true.rotors.time_constant_up_s + true.rotors.time_constant_down_s))
    late_s = true.telemetry.output_delay_s + _filtered_s(true)
    errors = {
        "acceleration": gains,
        "acceleration_per_output": [(1.0 + gain) * steeper - 1.0 for gain in gains],
        "lag_ms": 1e3 * (lag_s - true_lag_s),
        "delay_ms": 1e3 * (shape.delay_s + _filtered_s(made) - late_s),
        "expo": shape.expo - true.command.thrust_expo,
    }
    deviations = {
        "acceleration": d[model.gains_of(layout)][1:].tolist(),
        "acceleration_per_output": fit.command_deviation.tolist(),
        "lag_ms": 1e3 * lag_s * float(d[model.LAG]),
        "delay_ms": 1e3 * float(d[model.DELAY]),
        "expo": float(d[model.EXPO]),
    }
    return errors, deviations


def _filtered_s(vehicle: Vehicle) -> float:
    """Delay of the gyro's filter, a second-order Butterworth, below its cut-off."""
    cutoff_hz = vehicle.telemetry.gyro_filter_hz
    return math.sqrt(2.0) / (2.0 * math.pi * cutoff_hz) if cutoff_hz else 0.0


def _steepness(fit: Fit, fraction: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> float:
    """Relative change of thrust with output, at the mean outputs."""
    low, middle, high = fraction(fit.mean_output + np.array([-1e-3, 0.0, 1e-3])).tolist()
    return (high - low) / 2e-3 / middle


def _failures(options: CalibrationOptions, seed: int, name: str, file: str) -> list[dict[str, Any]]:
    """Each motor lost in hover, the companion knowing the vehicle by ``file``."""
    nominal = plant_airframe.load(vehicle_model.path_of(options.airframe), vehicles=1)
    motors = nominal.motors
    faults = [
        Fault(vehicle=vehicle, motor=motor, start_s=_FAIL_S) for vehicle, motor in enumerate(range(1, motors + 1))
    ]
    fleet = Fleet(
        plant_airframe.load(vehicle_model.path_of(options.airframe), vehicles=motors),
        _options([seed] * motors),
        faults,
    )
    flight = VirtualFlight(
        fleet, {k: TrialOptions(mode=Mode.ALLOCATE, network="none") for k in range(motors)}, airframe=file
    )
    while fleet.time_s < _END_S:
        flight.step()
    out = []
    for index, companion in enumerate(flight.companions):
        named = [(time_s, event.motor) for time_s, event in companion.events if event.declared]
        right = [time_s - _FAIL_S for time_s, motor in named if motor == index + 1 and time_s >= _FAIL_S]
        wrong = sorted({motor for _, motor in named if motor != index + 1})
        delay_s = None if not right else round(right[0], 4)
        out.append({"file": name, "motor": index + 1, "delay_s": delay_s, "wrong": wrong})
    return out
