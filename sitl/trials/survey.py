"""Surveys: every single or double failure, or long healthy flights, in virtual time on all cores."""

from __future__ import annotations

import itertools
import math
import os
import statistics
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from nff_companion.condition import Mode
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.decision import Event
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials import forward, healthy
from sitl.trials.comparison import rms_ratio
from sitl.trials.personality import prepared
from sitl.trials.pool import pool_of
from sitl.trials.research.detectors import detector_of
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight, temporary_card
from sitl.uncertainty import LEVELS

FAULT_AT_S = 5.0
FLY_ON_S = 20.0
FORWARD_FAULT_S = (10.0, 20.0)  # in forward flight, drawn from the seed and the motors
HEIGHT_M = 10.0
TURBULENCE_SHARE = 0.25


class Script(Protocol):
    """Sets the goals of a fleet over time."""

    def step(self, time_s: float) -> None:
        """Goals for ``time_s``."""


@dataclass(frozen=True, kw_only=True)
class SurveyOptions:
    """What to fly. ``model_error`` is a fraction."""

    airframe: str = "octo-x"
    thrust_to_weight: float | None = None
    seeds: int = 3
    first_seed: int = 1
    rate_hz: float = 200.0
    link_delay_s: float = 0.010
    model_error: float = 0.10
    wind_m_s: float = 4.0
    speed_m_s: float = 0.0
    mode: Mode = Mode.ALLOCATE
    detector: str = "sparse"
    personality: str = "plain"
    compare: bool = False
    rotor_speeds: bool = False
    forward: bool = False  # legs of up to 12 m/s instead of hover, or of the healthy script
    network: str = "airframe"
    joint: float = 0.0
    level: str = "calibrated"  # of what the file says beside mass, inertia and thrust: how far off it is


@dataclass(slots=True)
class _Record:
    """What one vehicle did after the failure."""

    max_tilt_deg: float = 0.0
    max_position_error_m: float = 0.0
    position_rms_m: float = 0.0


def failure_sets(motors: int, *, pairs: bool) -> list[tuple[int, ...]]:
    """All single motors, or all pairs, numbered from 1."""
    return list(itertools.combinations(range(1, motors + 1), 2 if pairs else 1))


def run(options: SurveyOptions, sets: list[tuple[int, ...]], workers: int | None = None) -> dict[str, Any]:
    """Fly every set with every seed, with and without the companion; the document that ``nff survey`` prints."""
    flights = [(motors, seed) for motors in sets for seed in _seeds(options, options.seeds)]
    results = _spread(_fly_failures, options, flights, workers)
    return {"options": _described(options), "flights": results, "summary": summary(results)}


def run_healthy(options: SurveyOptions, minutes: float, workers: int | None = None) -> dict[str, Any]:
    """Fly ``minutes`` without a failure, split over vehicles with different seeds."""
    count = max(1, round(minutes * 60.0 / healthy.DURATION_S))
    results = _spread(_fly_healthy, options, [((), seed) for seed in _seeds(options, count)], workers)
    document: dict[str, Any] = {"options": _described(options), "flights": results, "summary": summary(results)}
    document["summary"]["minutes"] = count * healthy.DURATION_S / 60.0
    if options.compare:
        document["summary"]["position_rms_ratio"] = rms_ratio(
            [f["position_rms_m"] for f in results], [f["baseline_position_rms_m"] for f in results]
        )
    return document


def _seeds(options: SurveyOptions, count: int) -> range:
    return range(options.first_seed, options.first_seed + count)


def _described(options: SurveyOptions) -> dict[str, Any]:
    return {
        "airframe": options.airframe,
        "first_seed": options.first_seed,
        "rate_hz": options.rate_hz,
        "link_delay_ms": 1e3 * options.link_delay_s,
        "model_error_percent": 100.0 * options.model_error,
        "wind_m_s": options.wind_m_s,
        "speed_m_s": options.speed_m_s,
        "mode": options.mode.name.lower(),
        "detector": options.detector,
        "personality": options.personality,
        "rotor_speeds": options.rotor_speeds,
        "forward": options.forward,
        "network": options.network,
        "joint": options.joint,
        "level": options.level,
    }


def _spread(
    function: Any, options: SurveyOptions, flights: list[tuple[tuple[int, ...], int]], workers: int | None
) -> list[dict[str, Any]]:
    """Share the flights out to processes and put the results back in order."""
    count = min(workers or os.cpu_count() or 1, len(flights))
    shares = [flights[k::count] for k in range(count)]
    if count == 1:
        parts = [function(options, shares[0])]
    else:
        with pool_of(count) as pool:
            parts = pool.starmap(function, [(options, share) for share in shares])
    out: list[dict[str, Any]] = [{} for _ in flights]
    for k, part in enumerate(parts):
        out[k::count] = part
    return out


def _build(
    options: SurveyOptions, seeds: list[int], faults: list[Fault], companions: list[int], card: str, **fleet: Any
) -> VirtualFlight:
    """``card``: folder for what the personality keeps."""
    nominal = plant_airframe.load(
        vehicle_model.path_of(options.airframe), vehicles=len(seeds), thrust_to_weight=options.thrust_to_weight
    )
    fleet_options = FleetOptions(
        seeds=seeds,
        model_error=options.model_error,
        wind_m_s=options.wind_m_s,
        turbulence_m_s=TURBULENCE_SHARE * options.wind_m_s,
        height_m=forward.HEIGHT_M if options.forward else HEIGHT_M,
        uncertainty=LEVELS[options.level](),
        **fleet,
    )
    model = vehicle_model.load(options.airframe, thrust_to_weight=options.thrust_to_weight)
    personality = prepared(options.personality, model, TrialOptions().allocation, card)
    detector = detector_of(options.detector, options.joint, rotor_speeds=options.rotor_speeds)
    chosen = TrialOptions(mode=options.mode, network=options.network, parts=detector.parts, tuning=detector.tuning)
    return VirtualFlight(
        Fleet(nominal, fleet_options, faults),
        dict.fromkeys(companions, chosen),
        airframe=options.airframe,
        thrust_to_weight=options.thrust_to_weight,
        rate_hz=options.rate_hz,
        link_delay_s=options.link_delay_s,
        workshop=personality.workshop,
        px4=personality.px4,
        rotor_speeds=options.rotor_speeds,
    )


def _fly_failures(options: SurveyOptions, flights: list[tuple[tuple[int, ...], int]]) -> list[dict[str, Any]]:
    """First half of the fleet with companion, second half the same vehicles without."""
    count = len(flights)
    both = flights * 2
    at = [_fault_s(options, motors, seed) for motors, seed in both]
    faults = [
        Fault(vehicle=index, motor=motor, start_s=at[index])
        for index, (motors, _) in enumerate(both)
        for motor in motors
    ]
    with temporary_card() as card:
        flight = _build(options, [seed for _, seed in both], faults, list(range(count)), card)
        fleet = flight.fleet
        if options.speed_m_s:
            fleet.autopilot.position.goal_velocity[:, 0] = options.speed_m_s
            fleet.autopilot.position.goal_velocity[:, 1] = 0.0
        script = forward.Script(fleet, [seed for _, seed in both], forward.SPEEDS_M_S) if options.forward else None
        records = _record_until(flight, min(at), max(at) + FLY_ON_S, script)
    survived = ~fleet.state.crashed
    results = []
    for index, (motors, seed) in enumerate(flights):
        events = _declarations(flight.companions[index])
        named = sorted({event.motor for _, event in events})
        times = [time_s for time_s, event in events if event.motor in motors]
        results.append(
            {
                "motors": list(motors),
                "seed": seed,
                "baseline_survived": bool(survived[count + index]),
                "survived": bool(survived[index]),
                "named": named,
                "delay_s": round(max(times) - at[index], 4) if set(motors) <= set(named) else None,
                "max_tilt_deg": round(records[index].max_tilt_deg, 2),
                "max_position_error_m": round(records[index].max_position_error_m, 3),
                "baseline_max_tilt_deg": round(records[count + index].max_tilt_deg, 2),
                "baseline_max_position_error_m": round(records[count + index].max_position_error_m, 3),
                "false_alarms": sum(time_s < at[index] for time_s, _ in events),
            }
        )
    return results


def _fault_s(options: SurveyOptions, motors: tuple[int, ...], seed: int) -> float:
    return float(np.random.default_rng([seed, *motors]).uniform(*FORWARD_FAULT_S)) if options.forward else FAULT_AT_S


def _fly_healthy(options: SurveyOptions, flights: list[tuple[tuple[int, ...], int]]) -> list[dict[str, Any]]:
    """With ``options.compare`` the second half of the fleet are the same vehicles without the companion."""
    count = len(flights)
    seeds = [seed for _, seed in flights] * (2 if options.compare else 1)
    with temporary_card() as card:
        gusts = None if options.forward else healthy.gusts(seeds)
        flight = _build(options, seeds, [], list(range(count)), card, gusts=gusts)
        script: Script = (
            forward.Script(flight.fleet, seeds, forward.SPEEDS_M_S) if options.forward else healthy.Script(flight.fleet)
        )
        records = _record_until(flight, 0.0, healthy.DURATION_S, script)
    results = []
    for index, (_, seed) in enumerate(flights):
        events = _declarations(flight.companions[index])
        baseline = records[count + index].position_rms_m if options.compare else None
        results.append(
            {
                "motors": [],
                "seed": seed,
                "baseline_survived": None,
                "survived": not bool(flight.fleet.state.crashed[index]),
                "named": sorted({event.motor for _, event in events}),
                "delay_s": None,
                "max_tilt_deg": round(records[index].max_tilt_deg, 2),
                "max_position_error_m": round(records[index].max_position_error_m, 3),
                "position_rms_m": round(records[index].position_rms_m, 4),
                "baseline_position_rms_m": None if baseline is None else round(baseline, 4),
                "false_alarms": len(events),
                "declared_at_s": [round(time_s, 3) for time_s, _ in events],
            }
        )
    return results


def _declarations(companion: TrialCompanion) -> list[tuple[float, Event]]:
    return [(time_s, event) for time_s, event in companion.events if event.declared]


def _record_until(flight: VirtualFlight, from_s: float, until_s: float, script: Script | None = None) -> list[_Record]:
    """Fly on; worst tilt and distance from the intended path of each vehicle while it is up."""
    fleet = flight.fleet
    tilt = np.zeros(fleet.vehicles)
    error = np.zeros(fleet.vehicles)
    squares, counted = np.zeros(fleet.vehicles), np.zeros(fleet.vehicles)
    for _ in range(math.ceil((until_s - fleet.time_s) * AUTOPILOT_RATE_HZ)):
        if script is not None:
            script.step(fleet.time_s)
        flight.step()
        if fleet.time_s <= from_s:
            continue
        up = ~fleet.state.crashed
        distance = np.linalg.norm(fleet.state.position_m - fleet.autopilot.position.path, axis=1)
        tilt = np.where(up, np.maximum(tilt, rotation.tilt_of(fleet.state.quaternion)), tilt)
        error = np.where(up, np.maximum(error, distance), error)
        squares += np.where(up, distance**2, 0.0)
        counted += up
    rms = np.sqrt(squares / np.maximum(counted, 1.0))
    return [_Record(float(np.degrees(t)), float(e), float(r)) for t, e, r in zip(tilt, error, rms, strict=True)]


def summary(flights: list[dict[str, Any]]) -> dict[str, Any]:
    """Totals of the flights; delays over the flights in which all failed motors were named."""
    delays = [f["delay_s"] for f in flights if f["delay_s"] is not None]
    tilts = [f["max_tilt_deg"] for f in flights]
    base = [f["baseline_max_tilt_deg"] for f in flights if "baseline_max_tilt_deg" in f]
    return {
        "flights": len(flights),
        "survived": sum(f["survived"] for f in flights),
        "baseline_survived": sum(bool(f["baseline_survived"]) for f in flights),
        "lost_though_baseline_survived": sum(bool(f["baseline_survived"]) and not f["survived"] for f in flights),
        "misnamed": sum(bool(set(f["named"]) - set(f["motors"])) for f in flights),
        "missed": sum(bool(set(f["motors"]) - set(f["named"])) for f in flights),
        "false_alarms": sum(f["false_alarms"] for f in flights),
        "delay_median_s": round(statistics.median(delays), 4) if delays else None,
        "delay_max_s": max(delays) if delays else None,
        "max_tilt_median_deg": round(statistics.median(tilts), 2) if tilts else None,
        "baseline_max_tilt_median_deg": round(statistics.median(base), 2) if base else None,
    }
