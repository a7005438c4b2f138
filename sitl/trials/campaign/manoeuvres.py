"""What the vehicles of a campaign fly: each its own manoeuvre, drawn from its seed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl.fleet import Fleet
from sitl.trials.campaign.scenario import FROM_GROUND, Case, Manoeuvre
from sitl.trials.first_seconds import TakeOff
from sitl.trials.forward import SPEEDS_M_S

HEIGHT_M = 45.0
_BEGIN_S = 1.5
_MANOEUVRE_STREAM = 11  # of a seed's generators
_TURN_RAD_S = math.radians(30.0), math.radians(90.0)
_VERTICAL_M_S = 0.5, 1.5
_STEP_M, _STEP_S = 3.0, 4.0


class Leg(NamedTuple):
    """From ``from_s`` on: this velocity (NED, m/s; NaN: hold the place) and yaw rate, the place moved by ``step_m``."""

    from_s: float
    velocity_m_s: tuple[float, float, float]
    yaw_rate_rad_s: float
    step_m: tuple[float, float]


_HOLD = (math.nan, math.nan, math.nan)


def legs(manoeuvre: Manoeuvre, seed: int, until_s: float) -> list[Leg]:
    """Of one vehicle."""
    draw = np.random.default_rng([seed, _MANOEUVRE_STREAM])
    if manoeuvre in ("hover", FROM_GROUND):
        return []
    if manoeuvre in ("climb", "descent"):
        speed = draw.uniform(*_VERTICAL_M_S) * (-1.0 if manoeuvre == "climb" else 1.0)
        return [Leg(_BEGIN_S, (math.nan, math.nan, speed), 0.0, (0.0, 0.0))]
    if manoeuvre == "turn":
        rate = draw.uniform(*_TURN_RAD_S) * draw.choice([-1.0, 1.0])
        return [Leg(_BEGIN_S, _HOLD, rate, (0.0, 0.0))]
    out, time_s = list[Leg](), _BEGIN_S
    while time_s < until_s:
        heading = draw.uniform(0.0, 2.0 * math.pi)
        if manoeuvre == "steps":
            step = _STEP_M * math.cos(heading), _STEP_M * math.sin(heading)
            out.append(Leg(time_s, _HOLD, 0.0, step))
            time_s += _STEP_S
        else:
            speed = float(draw.choice(SPEEDS_M_S))
            yaw = draw.choice([0.0, 0.0, -1.0, 1.0]) * _TURN_RAD_S[0]
            velocity = speed * math.cos(heading), speed * math.sin(heading), 0.0
            out.append(Leg(time_s, velocity, yaw, (0.0, 0.0)))
            time_s += draw.uniform(3.0, 9.0)
    return out


class Pilots:
    """Sets the goals of all vehicles over time; ``cases`` one a vehicle."""

    def __init__(self, fleet: Fleet, cases: list[Case]) -> None:
        self._position = fleet.autopilot.position
        self._start = self._position.goal.copy()
        self._legs = [legs(case.manoeuvre, case.seed, case.until_s) for case in cases]
        self._next_s = self._due()
        # All of a fleet start from the ground, or none.
        self._take_off = TakeOff(fleet, turn=False) if cases[0].manoeuvre == FROM_GROUND else None

    def _due(self) -> NDArray[np.float64]:
        return np.array([own[0].from_s if own else math.inf for own in self._legs])

    def step(self, time_s: float) -> None:
        """Goals for ``time_s`` since the start."""
        if self._take_off is not None:
            self._take_off.step(time_s)
        if time_s < self._next_s.min(initial=math.inf):
            return
        position = self._position
        for vehicle in np.flatnonzero(time_s >= self._next_s):
            leg = self._legs[vehicle].pop(0)
            position.goal[vehicle, :2] = self._start[vehicle, :2] + leg.step_m
            position.goal_velocity[vehicle] = leg.velocity_m_s
            position.goal_yaw_rate[vehicle] = leg.yaw_rate_rad_s
        self._next_s = self._due()
