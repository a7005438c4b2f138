"""Forward flight without a failure: legs of random speed, direction, climb and turn; for training and for tests."""

from __future__ import annotations

import math

import numpy as np

from sitl.fleet import Fleet

SPEEDS_M_S = (4.5, 7.5, 10.0, 12.0)
HEIGHT_M = 40.0
_LEG_S = (3.0, 9.0)
_CLIMB_M_S = 1.5
_CLIMB_SHARE = 0.3  # of the legs
_TURN_RAD_S = math.radians(30.0)
_TURN_SHARE = 0.3


class Script:
    """Sets the goals of all vehicles over time. ``speeds_m_s``: of which each leg flies one, drawn from the seed."""

    def __init__(self, fleet: Fleet, seeds: list[int], speeds_m_s: tuple[float, ...], from_s: float = 3.0) -> None:
        self._position = fleet.autopilot.position
        self._draw = [np.random.default_rng([int(seed), 7]) for seed in seeds]
        self._speeds = speeds_m_s
        self._until_s = np.full(len(seeds), from_s)
        self._position.goal_velocity[:] = 0.0

    def step(self, time_s: float) -> None:
        """Goals for ``time_s`` since the start."""
        for vehicle in np.flatnonzero(time_s >= self._until_s):
            draw = self._draw[vehicle]
            speed = float(draw.choice(self._speeds))
            heading = draw.uniform(0.0, 2.0 * math.pi)
            climb = 0.0
            if draw.random() < _CLIMB_SHARE:
                # Back towards the height begun at, so that no flight ends on the ground.
                climb = math.copysign(_CLIMB_M_S, -HEIGHT_M - self._position.path[vehicle, 2])
            turn = float(draw.choice([-1.0, 1.0])) * _TURN_RAD_S if draw.random() < _TURN_SHARE else 0.0
            self._position.goal_velocity[vehicle] = speed * math.cos(heading), speed * math.sin(heading), climb
            self._position.goal_yaw_rate[vehicle] = turn
            self._until_s[vehicle] = time_s + draw.uniform(*_LEG_S)
