"""What a campaign flies: its file, and each flight drawn from it, the same whoever flies it and beside whatever."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from nff_companion.core import toml_file
from nff_companion.core import vehicle as vehicles
from nff_companion.core.toml_file import Name
from nff_companion.core.tuning.span import span
from nff_companion.errors import ConfigError

Manoeuvre = Literal["hover", "climb", "descent", "turn", "forward", "steps", "take-off"]
FaultKind = Literal["none", "total", "partial", "ramp", "intermittent", "stuck", "high", "slow", "reversed", "blade"]
Event = Literal[
    "none", "gust", "drop", "hook", "shift", "sag", "slam", "imu", "jump", "reset", "frozen stream", "slow stream"
]
Level = Literal["exact", "calibrated", "geometry", "estimated"]
MANOEUVRES: tuple[Manoeuvre, ...] = ("hover", "climb", "descent", "turn", "forward")
_LEFT = {"reversed": (0.2, 0.6), "blade": (0.3, 0.8)}  # of the thrust, by what such faults are
FROM_GROUND: Manoeuvre = "take-off"
_EARLY_S = 2.3, 5.0  # of what happens in a take-off: from 0.1 to 3 m, and after
_SLOWER = math.log(3.0), math.log(10.0)  # times the lag
Share = Annotated[float, span(0.0, 1.0, "", "")]
Seconds = Annotated[float, span(0.0, 3600.0, "s", "")]
Speed = Annotated[float, span(0.0, 20.0, "m/s", "")]


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A campaign's file. Airframes, manoeuvres, faults and events come in turn, all with all, or with ``apart`` each
    fault and each event by itself; what has two numbers is drawn between them."""

    name: Name
    flights: Annotated[int, span(1, 100_000_000, "", "with all of them the table is complete")]
    seed: Annotated[int, span(0, 2**31, "", "another one draws other flights")] = 1
    airframes: tuple[Name, ...] = ("octo-x",)
    level: Level = "calibrated"  # how far off the airframe file is, beside mass, inertia and thrust
    model_error: Annotated[float, span(0.0, 0.4, "", "of mass, inertia, thrust")] = 0.1
    manoeuvres: tuple[Manoeuvre, ...] = MANOEUVRES
    faults: tuple[FaultKind, ...] = ("total",)
    motors: Annotated[int, span(1, 3, "", "that fail at once")] = 1
    left: tuple[Share, Share] = (0.1, 0.9)  # of the thrust, in partial losses and at the end of ramps
    duration_s: tuple[Seconds, Seconds] = (0.2, 5.0)  # of ramps, and of the periods of what comes and goes
    events: tuple[Event, ...] = ("none",)  # what is no fault
    apart: bool = False  # a fault or an event, never both in one flight
    at_s: tuple[Seconds, Seconds] = (5.0, 10.0)  # of fault or event
    fly_on_s: Annotated[float, span(0.5, 600.0, "s", "after it")] = 8.0
    act_after_s: tuple[Seconds, Seconds] = (0.0, 0.0)  # the fault: until then it observes; 0: it acts from the start
    wind_m_s: tuple[Speed, Speed] = (4.0, 4.0)
    turbulence_share: Annotated[float, span(0.0, 0.5, "", "of the wind")] = 0.25
    rate_hz: Annotated[float, span(50.0, 400.0, "Hz", "telemetry")] = 200.0
    link_delay_s: Annotated[float, span(0.0, 0.1, "s", "each way")] = 0.01
    personality: Literal["plain", "ardupilot", "px4"] = "plain"
    network: Name = "airframe"
    detector: Literal["sparse", "published", "imm", "rls", "thrust-loss", "current"] = "sparse"  # or a peer
    rotor_speeds: bool = False  # the ESCs report them
    batch: Annotated[int, span(1, 1000, "flights", "that are flown together")] = 20


@dataclass(frozen=True, kw_only=True)
class Case:
    """One flight. ``motors`` count from 1."""

    flight: int  # from 0
    airframe: str
    manoeuvre: Manoeuvre
    fault: FaultKind
    motors: tuple[int, ...]
    left: float
    duration_s: float
    slower: float
    event: Event
    at_s: float
    until_s: float
    wind_m_s: float
    seed: int
    act_after_s: float = 0.0

    def row(self) -> dict[str, Any]:
        """For a table."""
        return asdict(self) | {"motors": list(self.motors)}


def read(path: Path) -> Scenario:
    """Raises ConfigError."""
    raw = toml_file.parsed(path, "campaign")
    scenario = toml_file.converted({"name": path.stem} | raw, Scenario, path, "campaign")
    for key in ("airframes", "manoeuvres", "faults", "events"):
        if not getattr(scenario, key):
            raise ConfigError(f"campaign {path}: {key} is empty: name one or more")
    for key in ("left", "duration_s", "at_s", "act_after_s", "wind_m_s"):
        low, high = getattr(scenario, key)
        if low > high:
            raise ConfigError(f"campaign {path}: {key} = [{low}, {high}]: the first must not be above the second")
    for name in scenario.airframes:
        if vehicles.load(name).motors < scenario.motors:
            raise ConfigError(f"campaign {path}: airframe {name} has fewer than motors = {scenario.motors}")
    return scenario


def batches(scenario: Scenario) -> list[tuple[int, ...]]:
    """Flights (from 0) that are flown together: of one airframe, all from the ground or none."""
    kinds, places = len(scenario.airframes), len(scenario.manoeuvres)
    out = []
    for kind in range(kinds):
        mine = range(kind, scenario.flights, kinds)
        for ground in (False, True):
            alike = [k for k in mine if (scenario.manoeuvres[k // kinds % places] == FROM_GROUND) == ground]
            out += [tuple(alike[k : k + scenario.batch]) for k in range(0, len(alike), scenario.batch)]
    return sorted(out)


def drawn(scenario: Scenario, flight: int) -> Case:
    """The ``flight``-th (from 0)."""
    draw = np.random.default_rng([scenario.seed, flight])
    turn, airframe = divmod(flight, len(scenario.airframes))
    turn, manoeuvre = divmod(turn, len(scenario.manoeuvres))
    kind, event = _happens(scenario, turn)
    motors = vehicles.load(scenario.airframes[airframe]).motors
    order = draw.permutation(motors)  # drawn also where nothing fails: what follows is the same
    at_s = draw.uniform(*(_EARLY_S if scenario.manoeuvres[manoeuvre] == FROM_GROUND else scenario.at_s))
    left = draw.uniform(*scenario.left) if kind in ("partial", "ramp") else 0.0
    shortest, longest = (math.log(max(duration_s, 1e-3)) for duration_s in scenario.duration_s)
    duration_s, wind_m_s = math.exp(draw.uniform(shortest, longest)), draw.uniform(*scenario.wind_m_s)
    seed = int(draw.integers(2**31))
    if kind in _LEFT:
        left = draw.uniform(*_LEFT[kind])
    act_after_s = scenario.act_after_s[1]
    if act_after_s > 0.0:  # by a draw of its own: all else is as where it acts from the start
        soonest, latest = (math.log(max(after_s, 1e-2)) for after_s in scenario.act_after_s)
        act_after_s = math.exp(np.random.default_rng([scenario.seed, flight, 1]).uniform(soonest, latest))
    return Case(
        flight=flight,
        airframe=scenario.airframes[airframe],
        manoeuvre=scenario.manoeuvres[manoeuvre],
        fault=kind,
        motors=() if kind == "none" else tuple(sorted(1 + int(motor) for motor in order[: scenario.motors])),
        left=left,
        duration_s=duration_s,
        slower=math.exp(draw.uniform(*_SLOWER)) if kind == "slow" else 1.0,
        event=event,
        at_s=at_s,
        until_s=at_s + scenario.fly_on_s,
        wind_m_s=wind_m_s,
        seed=seed,
        act_after_s=act_after_s,
    )


def _happens(scenario: Scenario, turn: int) -> tuple[FaultKind, Event]:
    """Of the ``turn``-th round of airframes and manoeuvres."""
    if not scenario.apart:
        turn, fault = divmod(turn, len(scenario.faults))
        return scenario.faults[fault], scenario.events[turn % len(scenario.events)]
    turn %= len(scenario.faults) + len(scenario.events)
    if turn < len(scenario.faults):
        return scenario.faults[turn], "none"
    return "none", scenario.events[turn - len(scenario.faults)]
