"""Flights of a campaign in virtual time, each with the companion and, beside it, the same vehicle without."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nff_companion.companion_state import Orders, Output
from nff_companion.condition import Mode
from nff_companion.core import vehicle as vehicles
from nff_companion.verdict import numbers
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials.campaign.events import Events, gusts
from sitl.trials.campaign.manoeuvres import HEIGHT_M, Pilots
from sitl.trials.campaign.scenario import FROM_GROUND, Case, Scenario, drawn
from sitl.trials.personality import prepared
from sitl.trials.research.detectors import detector_of
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight, temporary_card
from sitl.uncertainty import LEVELS

_FLAPS_S = 5.0
_PARTS = ("partial", "ramp", "intermittent", "blade")  # faults of which a part lost is the truth
LOADS = ("drop", "hook", "shift")  # of the events: a load moves
NOT_IN_FULL = ("partial", "ramp", "intermittent", "stuck", "slow", "blade")  # of the kinds of fault


def fly(scenario: Scenario, flights: tuple[int, ...]) -> list[dict[str, Any]]:
    """One row a flight; all of ``flights`` are of one airframe, and start from the ground or in the air. A row does not
    depend on what it was flown beside."""
    cases = [drawn(scenario, flight) for flight in flights]
    (airframe,) = {case.airframe for case in cases}
    both = cases * 2
    options = FleetOptions(
        seeds=[case.seed for case in both],
        model_error=scenario.model_error,
        uncertainty=LEVELS[scenario.level](),
        wind_m_s=[case.wind_m_s for case in both],
        turbulence_m_s=[scenario.turbulence_share * case.wind_m_s for case in both],
        height_m=0.0 if cases[0].manoeuvre == FROM_GROUND else HEIGHT_M,
        gusts=gusts(both),
    )
    plants = plant_airframe.load(vehicles.path_of(airframe), vehicles=len(both))
    detector = detector_of(scenario.detector, rotor_speeds=scenario.rotor_speeds)
    mode = Mode.OBSERVE if cases[0].act_after_s > 0.0 else Mode.ALLOCATE
    trial = TrialOptions(mode=mode, network=scenario.network, parts=detector.parts, tuning=detector.tuning)
    with temporary_card() as card:
        autopilot = prepared(scenario.personality, vehicles.load(airframe), TrialOptions().allocation, card)
        flight = VirtualFlight(
            Fleet(plants, options, faults(both)),
            dict.fromkeys(range(len(cases)), trial),
            airframe=airframe,
            rate_hz=scenario.rate_hz,
            link_delay_s=scenario.link_delay_s,
            workshop=autopilot.workshop,
            px4=autopilot.px4,
            rotor_speeds=scenario.rotor_speeds,
        )
        record = _flown(flight, both)
    rows = []
    for k, case in enumerate(cases):
        seen = _seen(case, flight.companions[k], record, k)
        rows.append(case.row() | {"level": scenario.level} | seen | record.row(k, len(cases) + k))
    return rows


def faults(cases: list[Case]) -> list[Fault]:
    """Of a fleet of these."""
    return [
        Fault(
            vehicle=vehicle,
            motor=motor,
            start_s=case.at_s,
            kind=case.fault,
            effectiveness=case.left,
            duration_s=case.duration_s,
            slower=case.slower,
        )
        for vehicle, case in enumerate(cases)
        for motor in case.motors
    ]


class Record:
    """What each vehicle did, up to the end of its own flight."""

    def __init__(self, cases: list[Case]) -> None:
        n = len(cases)
        self._from_s, self._until_s = (np.array([getattr(case, key) for case in cases]) for key in ("at_s", "until_s"))
        self._tilt_rad, self._off_m, self._low_m = np.zeros(n), np.zeros(n), np.zeros(n)
        self.crashed = np.zeros(n, bool)
        self.partly: list[dict[int, float]] = [{} for _ in range(n)]  # motors allocated around, and since when
        self.either: list[tuple[float, tuple[int, ...]]] = [(math.inf, ())] * n  # one of two motors, from when on
        self.among: list[tuple[float, tuple[tuple[int, ...], ...]]] = [(math.inf, ())] * n  # the last sets, and since

        self.more: list[dict[int, float]] = [{} for _ in range(n)]  # motors that pull more than asked, and since when
        self.unresponsive: list[dict[int, float]] = [{} for _ in range(n)]  # that do not answer, and since when
        self.weak: list[dict[tuple[int, ...], float]] = [{} for _ in range(n)]  # that have lost a part, and since when
        self.weak_left = [1.0] * n
        self.worn: list[dict[tuple[int, ...], float]] = [{} for _ in range(n)]  # that give less than before, since when
        self.worn_left = [1.0] * n
        self.worn_sure: list[set[tuple[int, ...]]] = [set() for _ in range(n)]  # of these, where it was no load
        self.flaps = [0] * n  # changes of what is done about a motor, within a few seconds of its last one
        self._about: list[frozenset[int]] = [frozenset()] * n
        self._changed_s: list[dict[int, float]] = [{} for _ in range(n)]

    def note(self, flight: VirtualFlight) -> None:
        """After a cycle."""
        fleet = flight.fleet
        flies = fleet.time_s <= self._until_s
        self.crashed |= fleet.state.crashed & flies
        up = flies & ~self.crashed & (fleet.time_s > self._from_s)
        off = fleet.state.position_m - fleet.autopilot.position.path
        for value, now in (
            (self._tilt_rad, rotation.tilt_of(fleet.state.quaternion)),
            (self._off_m, np.linalg.norm(off, axis=1)),
            (self._low_m, off[:, 2]),
        ):
            np.maximum(value, np.where(up, now, 0.0), out=value)
        for k, companion in enumerate(flight.companions):
            if flies[k]:
                self._note_changes(k, companion.output, fleet.time_s)
            either = companion.output.either
            if either and not self.either[k][1] and flies[k]:
                self.either[k] = fleet.time_s, either
            if flies[k]:
                for motor in companion.output.more:
                    self.more[k].setdefault(motor, fleet.time_s)
                for motor in companion.output.unresponsive:
                    self.unresponsive[k].setdefault(motor, fleet.time_s)
                if companion.output.worn:
                    self.worn[k].setdefault(companion.output.worn, fleet.time_s)
                    self.worn_left[k] = companion.output.worn_left
                    self.worn_sure[k] |= {companion.output.worn} if companion.output.worn_sure else set()
                if companion.output.weak:
                    self.weak[k].setdefault(companion.output.weak, fleet.time_s)
                    self.weak_left[k] = companion.output.weak_left
            among = companion.output.among
            if among and flies[k]:
                self.among[k] = min(self.among[k][0], fleet.time_s), among
            if either:
                continue
            if flies[k] and True in companion.output.degraded.tolist():
                for motor in numbers(companion.output.degraded):
                    self.partly[k].setdefault(motor, fleet.time_s)

    def _note_changes(self, k: int, output: Output, time_s: float) -> None:
        about = frozenset((*numbers(output.failed), *numbers(output.degraded), *output.either))
        for motor in about ^ self._about[k]:
            self.flaps[k] += time_s - self._changed_s[k].get(motor, -math.inf) < _FLAPS_S
            self._changed_s[k][motor] = time_s
        self._about[k] = about

    def row(self, with_it: int, alone: int) -> dict[str, Any]:
        """Of a vehicle with the companion and the same without."""
        out: dict[str, Any] = {}
        for prefix, k in (("", with_it), ("alone_", alone)):
            out[f"{prefix}survived"] = not bool(self.crashed[k])
            out[f"{prefix}tilt_deg"] = round(math.degrees(self._tilt_rad[k]), 2)
            out[f"{prefix}off_m"] = round(float(self._off_m[k]), 3)
            out[f"{prefix}low_m"] = round(float(self._low_m[k]), 3)
        return out


def _flown(flight: VirtualFlight, cases: list[Case]) -> Record:
    fleet, record = flight.fleet, Record(cases)
    waiting = [k for k in range(len(flight.companions)) if cases[k].act_after_s > 0.0]
    pilots, events = Pilots(fleet, cases), Events(flight, cases)
    for _ in range(math.ceil(max(case.until_s for case in cases) * AUTOPILOT_RATE_HZ)):
        pilots.step(fleet.time_s)
        events.step(fleet.time_s)
        for k in [k for k in waiting if fleet.time_s >= cases[k].at_s + cases[k].act_after_s]:
            flight.companions[k].order(Orders(mode=Mode.ALLOCATE))
            waiting.remove(k)
        flight.step()
        record.note(flight)
    return record


def _seen(case: Case, companion: TrialCompanion, record: Record, k: int) -> dict[str, Any]:
    """What the companion of vehicle ``k`` said of it. ``delay_s``: from the failure until all motors that fail are
    named: by themselves, as one of two above each other (``either``), as pulling more than asked (``more``), as not
    answering (``unresponsive``), or, where they are not lost in full, as ``weak`` (of two above each other: one of
    them; ``weak_left``: the effectiveness said last), ``worn`` (the same, ``worn_left``) or allocated around
    (``partly``, the first one at ``partly_s``);
    ``among``: the sets of motors that could not be told apart, as said last, and ``among_s``, when the first was;
    ``wrong``: motors named that work; ``said_wrong``: those said not to answer, or to be weak; ``changes``:
    declarations and lifts; ``flaps``: changes of what is done about a motor within 5 s of its last one."""
    partly, (either_s, one_of), among, more = record.partly[k], record.either[k], record.among[k], record.more[k]
    events = [(time_s, event) for time_s, event in companion.events if time_s <= case.until_s]
    declared = [(time_s, event.motor) for time_s, event in events if event.declared]
    right = {motor: time_s for time_s, motor in reversed(declared) if motor in case.motors and time_s >= case.at_s}
    wrong = sorted({motor for time_s, motor in declared if motor not in case.motors or time_s < case.at_s})
    if set(one_of) & set(case.motors) and either_s >= case.at_s:
        for motor in set(one_of) & set(case.motors):
            right[motor] = min(right.get(motor, math.inf), either_s)
    elif one_of:
        wrong = sorted({*wrong, *one_of})
    for motor, time_s in more.items():
        if motor in case.motors and time_s >= case.at_s:
            right[motor] = min(right.get(motor, math.inf), time_s)
        elif not set(more) & set(case.motors):
            wrong = sorted({*wrong, motor})
    works: set[int] = set()  # said, and nothing is done about it
    silent = [((motor,), time_s, ("stuck", "slow")) for motor, time_s in record.unresponsive[k].items()]
    moved = case.event in LOADS  # "or a load moved": true
    worn = [(it, at_s) for it, at_s in record.worn[k].items() if it in record.worn_sure[k] or not moved]
    less = [*record.weak[k].items(), *worn]
    for motors, time_s, kinds in (*silent, *((*it, _PARTS) for it in less)):
        its = set(motors) & set(case.motors)
        if not its or time_s < case.at_s:
            works |= set(motors)
        elif case.fault in kinds:
            right |= {motor: min(right.get(motor, math.inf), time_s) for motor in its}
    for motor, time_s in partly.items():
        if motor in case.motors and time_s >= case.at_s and case.fault in NOT_IN_FULL:
            right[motor] = min(right.get(motor, math.inf), time_s)
    whole = set(case.motors) <= set(right)
    return {
        "named": sorted(right),
        "either": list(one_of),
        "more": sorted(more),
        "unresponsive": sorted(record.unresponsive[k]),
        "weak": sorted({motor for motors in record.weak[k] for motor in motors}),
        "worn": sorted({motor for motors in record.worn[k] for motor in motors}),
        "worn_sure": sorted({motor for motors in record.worn_sure[k] for motor in motors}),
        "worn_left": record.worn_left[k] if record.worn[k] else None,
        "said_wrong": sorted(works),
        "weak_left": record.weak_left[k] if record.weak[k] else None,
        "among": [list(motors) for motors in among[1]],
        "among_s": None if not among[1] else round(among[0] - case.at_s, 4),
        "delay_s": round(max(right.values()) - case.at_s, 4) if case.motors and whole else None,
        "wrong": wrong,
        "wrong_s": next((round(time_s, 3) for time_s, motor in declared if motor in wrong), None),
        "changes": len(events),
        "flaps": record.flaps[k],
        "partly": sorted(partly),
        "partly_s": None if not partly else round(min(partly.values()) - case.at_s, 4),
        "says": companion.session.moment().verdict.text,
    }
