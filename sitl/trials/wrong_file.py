"""Flights with an airframe file that is another vehicle's: is it noticed, and is nothing declared?

The vehicle that flies is the shipped airframe, or as far from it as an estimated file is; its companion is given a file
that was altered, asks to allocate, and has nobody's word for the file.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.fit import FitVerdict
from nff_companion.errors import ConfigError
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials.personality import prepared
from sitl.trials.pool import pool_of
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight, temporary_card
from sitl.uncertainty import Uncertainty

SECONDS = 20.0
HEIGHT_M = 10.0
WINDS_M_S = (0.0, 2.0, 4.0)
_FAULT_S = 6.0  # of the flights with a failure
_FLEET = 25  # vehicles flown together
_MODEL_ERROR = 0.1  # of an estimated file
_YAW_RATE_RAD_S = math.radians(45.0)
# Numbers of a file that may each be wrong by themselves: table and keys.
NUMBERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "mass": ("airframe", ("mass_kg",)),
    "inertia": ("airframe", ("inertia_kg_m2",)),
    "arm": ("rotor", ("arm_m", "x_m", "y_m")),
    "thrust": ("motor", ("max_thrust_n",)),
    "lag": ("motor", ("time_constant_up_s", "time_constant_down_s")),
    "torque": ("motor", ("torque_per_thrust_m",)),
    "expo": ("command", ("thrust_expo",)),
}
OTHER_FRAMES = {"octo-x": "hexa-x", "coax-x8": "octo-x", "octo-plus": "octo-x"}  # whose files are taken by mistake
KINDS = ("right", "estimated", "failure", "spins", "swap", "half", "twice", "frame", *NUMBERS)
NOT_CONTRADICTED = ("right", "estimated", "failure")


@dataclass(frozen=True)
class Case:
    """One flight: what is wrong with the file, by which ``factor``, or which motors (from 1)."""

    kind: str
    factor: float = 1.0
    motors: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """In short."""
        if self.motors:
            return f"{self.kind} {', '.join(map(str, self.motors))}"
        return self.kind if self.factor == 1.0 else f"{self.kind} x {self.factor:g}"


class Pilot(Protocol):
    """Who flies the fleet."""

    def step(self, time_s: float) -> None:
        """Goals for ``time_s`` since the start."""


class Script:
    """An ordinary first flight: hover, three steps of 3 m, turns of 45 degrees a second, a climb of 2 m."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._start = fleet.autopilot.position.goal.copy()

    def step(self, time_s: float) -> None:
        """Goals for ``time_s`` since the start."""
        position = self._fleet.autopilot.position
        forward, aside = 3.0 <= time_s < 15.0, 7.0 <= time_s < 18.0
        offset = np.array([3.0 * forward, 3.0 * aside, -2.0 * (time_s >= 12.0)])
        turn = (7.0 <= time_s < 9.0) - (9.0 <= time_s < 11.0)
        position.goal = self._start + offset
        position.goal_yaw_rate = np.full(self._fleet.vehicles, turn * _YAW_RATE_RAD_S)


def draw(count: int, airframe: str, rng: np.random.Generator) -> list[Case]:
    """Cases of all kinds in turn, what is wrong drawn."""
    motors = vehicle_model.load(airframe).motors
    cases = []
    for k in range(count):
        kind = KINDS[k % len(KINDS)]
        if kind == "frame" and airframe not in OTHER_FRAMES:
            kind = "spins"
        if kind == "swap":
            one, other = sorted(rng.choice(motors, 2, replace=False).tolist())
            cases.append(Case(kind, motors=(one + 1, other + 1)))
        elif kind == "failure":
            cases.append(Case(kind, motors=(1 + int(rng.integers(motors)),)))
        elif kind in ("half", "twice"):
            cases.append(Case(kind, 0.5 if kind == "half" else 2.0))
        elif kind in NUMBERS:
            cases.append(Case(kind, float(rng.choice([0.7, 1.3]))))
        else:
            cases.append(Case(kind))
    return cases


def altered(airframe: str, case: Case, path: Path) -> str:
    """The file of ``airframe`` with what ``case`` has wrong, as ``path``; the airframe itself where nothing is."""
    if case.kind in NOT_CONTRADICTED:
        return airframe
    if case.kind == "frame":
        return OTHER_FRAMES[airframe]
    data = tomllib.loads(vehicle_model.path_of(airframe).read_text(encoding="utf-8"))
    rotors: list[dict[str, Any]] = data["rotor"]
    if case.kind == "spins":
        for rotor in rotors:
            rotor["spin"] = {"cw": "ccw", "ccw": "cw"}[rotor["spin"]]
    elif case.kind == "swap":
        one, other = (motor - 1 for motor in case.motors)
        rotors[one], rotors[other] = rotors[other], rotors[one]
    else:
        table, keys = NUMBERS["mass" if case.kind in ("half", "twice") else case.kind]
        for owner in rotors if table == "rotor" else [data[table]]:
            for key in keys:
                if key in owner:
                    owner[key] = _times(owner[key], case.factor, 1.0 if key == "thrust_expo" else math.inf)
    path.write_text(_toml(data), encoding="utf-8")
    return str(path)


def _times(value: float | list[float], factor: float, most: float) -> float | list[float]:
    return [min(factor * v, most) for v in value] if isinstance(value, list) else min(factor * value, most)


def _toml(data: dict[str, Any]) -> str:
    """Tables of numbers, lists of them and texts."""
    lines = []
    for name, content in data.items():
        for table in content if isinstance(content, list) else [content]:
            lines.append(f"[[{name}]]" if isinstance(content, list) else f"[{name}]")
            for key, value in table.items():
                text = '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"' if isinstance(value, str) else value
                lines.append(f"{key} = {text}")
    return "\n".join(lines) + "\n"


def _first_flight(flight: VirtualFlight) -> Script:
    return Script(flight.fleet)


def fly(
    airframe: str,
    cases: list[Case],
    seed: int,
    *,
    rate_hz: float = 200.0,
    seconds: float = SECONDS,
    begin: Callable[[VirtualFlight], Pilot] = _first_flight,
    height_m: float = HEIGHT_M,
    personality: str = "plain",
) -> list[Any]:
    """One row a case: what the companion declared, thought of its file, and said, in so many ``seconds`` of flight from
    ``height_m`` (0: from the ground); ``begin`` gives who flies. The autopilot is set up for what flies. What is wrong
    with a file that is refused is found before the flight, at 0 s."""
    rows: list[Any] = [None] * len(cases)
    with temporary_card() as folder:
        files = [altered(airframe, case, Path(folder) / f"{index}.toml") for index, case in enumerate(cases)]
        refused = {index: why for index, file in enumerate(files) if (why := _refusal(file)) is not None}
        for guessed, error, uncertainty in (
            (False, 0.0, Uncertainty.exact()),
            (True, _MODEL_ERROR, Uncertainty.estimated()),
        ):
            group = [
                index
                for index, case in enumerate(cases)
                if index not in refused and (case.kind == "estimated") == guessed
            ]
            if not group:
                continue
            seeds = [seed + index for index in group]
            wind = [WINDS_M_S[index % len(WINDS_M_S)] for index in range(len(group))]
            options = FleetOptions(
                seeds=seeds,
                model_error=error,
                uncertainty=uncertainty,
                wind_m_s=wind,
                turbulence_m_s=[0.25 * w for w in wind],
                height_m=height_m,
            )
            faults = [
                Fault(vehicle=place, motor=cases[index].motors[0], start_s=_FAULT_S)
                for place, index in enumerate(group)
                if cases[index].kind == "failure"
            ]
            companions = {
                place: TrialOptions(mode=Mode.ALLOCATE, confirmed=False, airframe=files[index])
                for place, index in enumerate(group)
            }
            autopilot = prepared(personality, vehicle_model.load(airframe), TrialOptions().allocation, folder)
            plants = plant_airframe.load(vehicle_model.path_of(airframe), vehicles=len(group))
            flight = VirtualFlight(
                Fleet(plants, options, faults),
                companions,
                airframe=airframe,
                rate_hz=rate_hz,
                workshop=autopilot.workshop,
                px4=autopilot.px4,
            )
            flown = _flown(flight, seconds, begin(flight))
            for place, index in enumerate(group):
                rows[index] = {**flown[place], "seed": seeds[place], "wind_m_s": wind[place]}
    for index, why in refused.items():
        rows[index] = {**_unflown(why), "seed": seed + index, "wind_m_s": None}
    about = {"airframe": airframe, "personality": personality}
    return [{**about, "case": case.name, "kind": case.kind, **row} for case, row in zip(cases, rows, strict=True)]


def _refusal(file: str) -> str | None:
    """Why an airframe file is not taken at all."""
    try:
        vehicle_model.load(file)
    except ConfigError as error:
        return str(error)
    return None


def _unflown(why: str) -> dict[str, Any]:
    """A row of a file that was refused."""
    nothing: dict[str, Any] = {"declared": [], "off": [], "fits_s": None, "acted": False}
    return nothing | {"contradicted_s": 0.0, "survived": True, "verdict": "refused", "text": why, "says": why}


def _flown(flight: VirtualFlight, seconds: float, script: Pilot) -> list[dict[str, Any]]:
    """Fly; what each companion made of it."""
    seen: list[dict[str, Any]] = [{"contradicted_s": None, "fits_s": None, "acted": False} for _ in flight.companions]
    for _ in range(math.ceil(seconds * AUTOPILOT_RATE_HZ)):
        script.step(flight.fleet.time_s)
        flight.step()
        for row, companion in zip(seen, flight.companions, strict=True):
            _note(row, companion, flight.fleet.time_s)
    for row, companion in zip(seen, flight.companions, strict=True):
        output = companion.output
        row["declared"] = [[round(time_s, 2), e.motor] for time_s, e in companion.events if e.declared]
        row["survived"] = not bool(flight.fleet.state.crashed[companion.index])
        row["verdict"], row["text"] = output.fit.verdict.value, output.fit.text
        row["says"] = companion.session.moment().verdict.text
        row["off"] = [short for short, _ in output.fit.differs]
    return seen


def _note(row: dict[str, Any], companion: TrialCompanion, time_s: float) -> None:
    output = companion.output
    row["acted"] |= output.plan is not None or output.override is not None
    key = {FitVerdict.DOES_NOT_FIT: "contradicted_s", FitVerdict.FITS: "fits_s"}.get(output.fit.verdict)
    if output.obstacle is not None and output.obstacle.reason == Reason.CONTRADICTION:
        key = "contradicted_s"  # by the autopilot's own parameters
    if key is not None and row[key] is None:
        row[key] = round(time_s, 2)


def summary(rows: Iterable[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """For each kind: flights; declared a motor that works; file contradicted; found off in words; taken to fit."""
    table: dict[str, Counter[str]] = {}
    for row in rows:
        counts = table.setdefault(row["kind"], Counter())
        failed = row["case"].split()[-1] if row["kind"] == "failure" else ""
        counts["flights"] += 1
        counts["wrongly_declared"] += any(str(motor) != failed for _, motor in row["declared"])
        counts["contradicted"] += row["contradicted_s"] is not None
        counts["said_off"] += bool(row["off"]) or row["contradicted_s"] is not None
        counts["fits"] += row["fits_s"] is not None
        counts["survived"] += row["survived"]
    return {kind: dict(counts) for kind, counts in table.items()}


def exception(row: dict[str, Any]) -> str:
    """What is not as it should be; empty: nothing is."""
    contradicted, told = row["contradicted_s"] is not None, bool(row["off"]) or row["contradicted_s"] is not None
    failed = row["case"].split()[-1] if row["kind"] == "failure" else ""
    if any(str(motor) != failed for _, motor in row["declared"]):
        return f"declared {row['declared']}"
    if row["kind"] in NOT_CONTRADICTED:
        return "contradicted" if contradicted else ""
    if row["acted"]:
        return "acted upon"
    if row["kind"] in NUMBERS:
        return "" if told else "off, and said by its numbers alone"
    return "" if contradicted else "not found"


def run(airframe: str, count: int, seed: int, workers: int | None = None, personality: str = "plain") -> dict[str, Any]:
    """``count`` drawn cases; the document that ``nff survey --wrong-file`` prints."""
    cases = draw(count, airframe, np.random.default_rng(seed))
    shares = [cases[k : k + _FLEET] for k in range(0, count, _FLEET)]
    jobs = [(airframe, share, seed + _FLEET * k, personality) for k, share in enumerate(shares)]
    processes = min(workers or os.cpu_count() or 1, len(jobs))
    if processes == 1:
        parts = [_share(*job) for job in jobs]
    else:
        with pool_of(processes) as pool:
            parts = pool.starmap(_share, jobs, chunksize=1)
    rows = [row for part in parts for row in part]
    exceptions = [{**row, "why": exception(row)} for row in rows if exception(row)]
    return {
        "airframe": airframe,
        "personality": personality,
        "seed": seed,
        "flights": rows,
        "exceptions": exceptions,
        "summary": summary(rows),
    }


def _share(airframe: str, cases: list[Case], seed: int, personality: str) -> list[Any]:
    return fly(airframe, cases, seed, personality=personality)
