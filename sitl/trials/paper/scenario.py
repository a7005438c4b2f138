"""The flights: the paper's airframe on a rectangle at 7.5 m/s, an inner or an outer motor lost on the way.

Every controller flies the same vehicles (10 % errors of mass, inertia, thrust), wind, noise, failure and moment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.decision import Event
from nff_companion.core.parts import Parts
from nff_companion.core.tuning import Tuning
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials.research.laws import LAWS, shaped, unshaped
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight
from sitl.uncertainty import LEVELS

AIRFRAME = "paper-octo"
CONTROLLERS = tuple(LAWS)
GROUPS = {"outer": (1, 3, 6, 8), "inner": (2, 4, 5, 7)}  # motors by their lateral arm
SPEED_M_S = 7.5
_SIDES_S = (10.0, 8.0)  # flight time of the rectangle's sides, with their corners
_CORNER_S = 4.5  # of each: the velocity turns as a raised cosine
_START_S = 4.0
_FAULT_S = (10.0, 28.0)  # anywhere on two sides and two corners
WINDOW_S = 5.0  # of the attitude error, as in figure 6
AFTER_S = 10.0  # of the position error
BEFORE_S = 1.0
HEIGHT_M = 30.0


@dataclass(frozen=True, kw_only=True)
class PaperOptions:
    """What to fly."""

    seeds: int = 20
    rate_hz: float = 200.0
    link_delay_s: float = 0.010
    model_error: float = 0.10
    wind_m_s: float = 2.0
    turbulence_share: float = 0.25
    network: str = "airframe"
    level: str = "calibrated"  # how far off the airframe file is, beside mass, inertia and thrust
    variant: str = "full"
    controllers: tuple[str, ...] = CONTROLLERS


_UNDECLARED = Tuning().having("decision", improvement_min=1e9, loss_gradual=2.0)


@dataclass(frozen=True)
class Variant:
    """An ablation: what it makes of the parts of a law, other tuning, another network."""

    parts: Callable[[Parts], Parts] = lambda parts: parts
    tuning: Tuning = field(default_factory=Tuning)
    network: str = "airframe"


def variants() -> dict[str, Variant]:
    """Ablations, of every law that has the part at all."""
    return {
        "full": Variant(),
        "no-phi": Variant(network="none"),
        **{
            f"composite-{weight:g}": Variant(tuning=Tuning().having("adaptation", composite=weight))
            for weight in (0.1, 1.0, 5.0)
        },
        "lateral-for-all": Variant(lambda parts: replace(parts, feed_lateral=True)),
        "lateral-for-none": Variant(lambda parts: replace(parts, feed_lateral=False)),
        "published": Variant(lambda parts: replace(parts, target=shaped), _UNDECLARED),
        "published-no-sparsity": Variant(
            lambda parts: replace(parts, target=shaped), _UNDECLARED.having("sparse", gamma=0.0)
        ),
        "published-no-shaping": Variant(lambda parts: replace(parts, target=unshaped), _UNDECLARED),
    }


@dataclass(frozen=True, slots=True)
class Case:
    """One flight."""

    controller: str
    group: str
    seed: int

    @property
    def motor(self) -> int:
        """That is lost; from 1."""
        return GROUPS[self.group][(self.seed - 1) % 4]

    @property
    def fault_s(self) -> float:
        """When; the same for every controller."""
        return float(np.random.default_rng([self.seed, 11]).uniform(*_FAULT_S))


@dataclass(slots=True)
class Trace:
    """What one vehicle did. Times from the failure; rows at the companion's rate while it was up."""

    case: Case
    time_s: NDArray[np.float64]  # (L,)
    attitude_error_deg: NDArray[np.float64]  # (L, 3) roll, pitch, yaw, signed
    position_error_m: NDArray[np.float64]  # (L,)
    effectiveness: NDArray[np.float64]  # (L, m)
    named: list[int]
    delay_s: float | None
    crashed: bool


def fly(options: PaperOptions, cases: list[Case]) -> list[Trace]:
    """All cases side by side."""
    count = len(cases)
    seeds = [case.seed for case in cases]
    fleet = Fleet(
        plant_airframe.load(vehicle_model.path_of(AIRFRAME), vehicles=count),
        FleetOptions(
            seeds=seeds,
            model_error=options.model_error,
            uncertainty=LEVELS[options.level](),
            wind_m_s=options.wind_m_s,
            turbulence_m_s=options.turbulence_share * options.wind_m_s,
            height_m=HEIGHT_M,
        ),
        [Fault(vehicle=k, motor=case.motor, start_s=case.fault_s) for k, case in enumerate(cases)],
    )
    flight = VirtualFlight(
        fleet,
        {k: trial_options(options, case.controller) for k, case in enumerate(cases)},
        airframe=AIRFRAME,
        thrust_to_weight=None,
        rate_hz=options.rate_hz,
        link_delay_s=options.link_delay_s,
    )
    recorders = [_Recorder(case) for case in cases]
    fault_s = np.array([case.fault_s for case in cases])
    every = round(AUTOPILOT_RATE_HZ / options.rate_hz)
    told = np.zeros(count, bool)
    until = float(fault_s.max()) + AFTER_S
    while fleet.time_s < until:
        _lead(fleet)
        flight.step()
        for k, case in enumerate(cases):
            companion = flight.companions[k]
            if case.controller == "omniscient" and not told[k] and fleet.time_s >= fault_s[k]:
                told[k] = True
                companion.order(Orders(adopt=(case.motor,)))
            if fleet.cycle % every == 0 and not fleet.state.crashed[k]:
                recorders[k].add(fleet, k, companion)
    return [recorder.trace(flight.companions[k].events, every) for k, recorder in enumerate(recorders)]


def trial_options(options: PaperOptions, controller: str) -> TrialOptions:
    """One contender, in the variant chosen."""
    variant = variants()[options.variant]
    return TrialOptions(
        mode=Mode.OVERRIDE,
        tuning=variant.tuning,
        network=options.network if options.network != "airframe" else variant.network,
        parts=variant.parts(LAWS[controller]),
    )


def _lead(fleet: Fleet) -> None:
    """The rectangle: north, east, south, west, the nose kept north."""
    sides = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
    lengths = np.array([*_SIDES_S, *_SIDES_S])
    at = fleet.time_s - _START_S
    if at < 0.0:
        velocity = np.zeros(2)
    else:
        into = at % float(lengths.sum())
        side = int(np.searchsorted(np.cumsum(lengths), into, side="right"))
        since = into - float(lengths[:side].sum())
        share = 0.5 - 0.5 * np.cos(np.pi * min(since / _CORNER_S, 1.0))
        before = sides[side - 1] if at >= lengths[0] else np.zeros(2)
        velocity = SPEED_M_S * ((1.0 - share) * before + share * sides[side])
    fleet.autopilot.position.goal_velocity[:, :2] = velocity
    fleet.autopilot.position.goal_velocity[:, 2] = 0.0


class _Recorder:
    """Rows of one flight from a second before the failure."""

    def __init__(self, case: Case) -> None:
        self._case, self._fault_s = case, case.fault_s
        self._rows: list[tuple[float, NDArray[np.float64], float, NDArray[np.float64]]] = []

    def add(self, fleet: Fleet, index: int, companion: TrialCompanion) -> None:
        """After each step of the companion."""
        time_s = fleet.time_s - self._fault_s
        if not -BEFORE_S <= time_s <= AFTER_S:
            return
        desired = companion.attitude_desired
        error = np.full(3, np.nan)
        if desired is not None:
            # Truth against what the controller asked for.
            body = rotation.to_matrix(fleet.state.quaternion[index])
            error = _rotation_vector(body.T @ desired)
        away = float(np.linalg.norm(fleet.state.position_m[index] - fleet.autopilot.position.path[index]))
        self._rows.append((time_s, np.degrees(error), away, companion.output.effectiveness))

    def trace(self, all_events: list[tuple[float, Event]], every: int) -> Trace:
        """The flight up to AFTER_S; a row comes each ``every`` cycles of the autopilot while the vehicle is up."""
        events = [(t, e) for t, e in all_events if e.declared and t <= self._fault_s + AFTER_S]
        times = [t for t, e in events if e.motor == self._case.motor]
        time_s = np.array([row[0] for row in self._rows])
        return Trace(
            case=self._case,
            time_s=time_s,
            attitude_error_deg=np.array([row[1] for row in self._rows]).reshape(-1, 3),
            position_error_m=np.array([row[2] for row in self._rows]),
            effectiveness=np.array([row[3] for row in self._rows]),
            named=sorted({e.motor for _, e in events}),
            delay_s=times[0] - self._fault_s if times else None,
            crashed=len(time_s) == 0 or float(time_s[-1]) < AFTER_S - 2 * every / AUTOPILOT_RATE_HZ,
        )


def _rotation_vector(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a rotation matrix (3, 3), rad."""
    part = 0.5 * np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    sine = float(np.linalg.norm(part))
    angle = np.arctan2(sine, 0.5 * (np.trace(matrix) - 1.0))
    return part * (angle / sine if sine > 1e-9 else 1.0)
