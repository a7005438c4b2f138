"""What happens to a vehicle and is no fault of a motor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.fleet import Fleet
from sitl.trials.campaign.scenario import Case

_EVENT_STREAM = 12  # of a seed's generators
_GUST_S, _GUST_M_S = (0.5, 3.0), (3.0, 8.0)
_PAYLOAD = 0.05, 0.2  # of the mass
_SHIFT = 0.05  # of the longest arm, that the centre of mass moves
_SAG = 0.03, 0.12  # of the voltage


def gusts(cases: list[Case]) -> NDArray[np.float64] | None:
    """Rows as ``sitl.wind`` takes them."""
    rows = []
    for vehicle, case in enumerate(cases):
        if case.event == "gust":
            draw = _draw(case)
            heading, speed = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(*_GUST_M_S)
            push = speed * math.cos(heading), speed * math.sin(heading), draw.uniform(-0.3, 0.3) * speed
            rows.append((vehicle, case.at_s, draw.uniform(*_GUST_S), *push))
    return np.array(rows) if rows else None


def _draw(case: Case) -> np.random.Generator:
    return np.random.default_rng([case.seed, _EVENT_STREAM])


class Events:
    """All but the gusts, each at its time."""

    def __init__(self, fleet: Fleet, cases: list[Case]) -> None:
        self._fleet = fleet
        self._waiting = sorted(
            (case.at_s, vehicle) for vehicle, case in enumerate(cases) if case.event not in ("none", "gust")
        )
        self._cases = cases

    def step(self, time_s: float) -> None:
        """What is due."""
        while self._waiting and time_s >= self._waiting[0][0]:
            _, vehicle = self._waiting.pop(0)
            self._happen(vehicle, self._cases[vehicle])

    def _happen(self, vehicle: int, case: Case) -> None:
        draw, plant, state = _draw(case), self._fleet.plant, self._fleet.state
        if case.event in ("drop", "hook"):
            share = draw.uniform(*_PAYLOAD) * (-1.0 if case.event == "drop" else 1.0)
            mass = plant.mass_kg.copy()
            mass[vehicle] *= 1.0 + share
            plant.mass_kg = mass
        elif case.event == "shift":
            angle, far = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(0.3, 1.0) * _SHIFT
            plant.shift_mass(vehicle, far * math.cos(angle), far * math.sin(angle))
        elif case.event == "sag":
            battery = state.battery.copy()
            battery[vehicle] -= draw.uniform(*_SAG)
            state.battery = battery
