"""The first ten seconds of flights from the ground: how soon is it known whether the airframe file fits?

Armed, spun up, lifted to three metres and held there, in still air and in wind; with ``turn`` the pilot turns a little
and back, as one does who wants to know. Cases, files and fleets are those of wrong_file.py; times count from lift-off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sitl.fleet import Fleet
from sitl.trials import wrong_file
from sitl.trials.virtual import VirtualFlight
from sitl.trials.wrong_file import Case

SECONDS = 10.0  # after lift-off
_ARMED_S, _LIFTING_S = 0.5, 1.5
_HEIGHT_M = 3.0
_TURN_S, _TURN_RAD_S = (4.5, 5.5, 6.5), math.radians(45.0)  # to one side, and back


class TakeOff:
    """Arms, takes off and hovers; lift-off of each vehicle is noted."""

    def __init__(self, fleet: Fleet, *, turn: bool) -> None:
        self._fleet, self._turn = fleet, turn
        self._armed = self._lifting = False
        self.lifted_s = np.full(fleet.vehicles, np.nan)

    def step(self, time_s: float) -> None:
        """What the pilot does at ``time_s`` since the start."""
        fleet = self._fleet
        if not self._armed and time_s >= _ARMED_S:
            self._armed = True
            for vehicle in range(fleet.vehicles):
                fleet.autopilot.arm(vehicle)
        if not self._lifting and time_s >= _LIFTING_S:
            self._lifting = True
            for vehicle in range(fleet.vehicles):
                fleet.autopilot.take_off(vehicle, _HEIGHT_M, fleet.sensors.measured)
        if self._lifting:
            lifted = np.isnan(self.lifted_s) & ~fleet.state.on_ground
            self.lifted_s[lifted] = time_s
        if self._turn:
            begin, back, end = (_LIFTING_S + at for at in _TURN_S)
            turn = (begin <= time_s < back) - (back <= time_s < end)
            fleet.autopilot.position.goal_yaw_rate = np.full(fleet.vehicles, turn * _TURN_RAD_S)


def fly(airframe: str, cases: Sequence[Case], seed: int, *, turn: bool, rate_hz: float = 200.0) -> list[dict[str, Any]]:
    """One row a case, as of wrong_file.py, with times from lift-off."""
    script: TakeOff | None = None

    def begin(flight: VirtualFlight) -> TakeOff:
        nonlocal script
        script = TakeOff(flight.fleet, turn=turn)
        return script

    rows: list[dict[str, Any]] = []
    for group in _alike(cases):
        found = wrong_file.fly(
            airframe,
            [case for _, case in group],
            seed + group[0][0],
            rate_hz=rate_hz,
            seconds=_LIFTING_S + SECONDS + 1.0,
            begin=begin,
            height_m=0.0,
        )
        assert script is not None
        flown = [row for row in found if row["verdict"] != "refused"]
        for row, lifted_s in zip(flown, script.lifted_s.tolist(), strict=True):
            row["lifted_s"] = round(lifted_s, 2)
            for key in ("contradicted_s", "fits_s"):
                row[key] = None if row[key] is None else round(row[key] - lifted_s, 2)
        rows += found
    return rows


def _alike(cases: Sequence[Case]) -> list[list[tuple[int, Case]]]:
    """Cases that fly in one fleet, with their places."""
    placed = list(enumerate(cases))
    groups = [[each for each in placed if (each[1].kind == "estimated") == guessed] for guessed in (False, True)]
    return [group for group in groups if group]


def summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each kind: flights; how many have which verdict within SECONDS of lift-off, median and last of its time."""
    out = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        line: dict[str, Any] = {"kind": kind, "flights": len(mine)}
        for key, name in (("contradicted_s", "contradicted"), ("fits_s", "fits")):
            times = [row[key] for row in mine if row[key] is not None and row[key] <= SECONDS]
            line[name] = len(times)
            line[f"{name}_median_s"] = round(float(np.median(times)), 1) if times else None
            line[f"{name}_last_s"] = round(max(times), 1) if times else None
        out.append(line)
    return out


def run(airframe: str, count: int, seed: int) -> dict[str, Any]:
    """``count`` flights of each of: right, estimated, swapped, spins, half, twice; hovering, and with a turn."""
    rng = np.random.default_rng(seed)
    kinds = ("right", "estimated", "swap", "spins", "half", "twice")
    cases = [case for case in wrong_file.draw(count * len(wrong_file.KINDS), airframe, rng) if case.kind in kinds]
    flown = {name: fly(airframe, cases, seed, turn=name == "turn") for name in ("hover", "turn")}
    return {
        "airframe": airframe,
        "seed": seed,
        "flights": flown,
        "summary": {name: summary(rows) for name, rows in flown.items()},
    }
