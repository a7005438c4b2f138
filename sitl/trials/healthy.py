"""The healthy flight: everything that a pilot does and that must not look like a failure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.fleet import Fleet

DURATION_S = 150.0
_STEP_M = 3.0
_SQUARE_SPEED_M_S = 5.0
_CLIMB_M = 6.0
_YAW_RATE_RAD_S = math.radians(45.0)
_GUST_AT_S, _GUST_S, _GUST_M_S = 112.0, 3.0, 5.0
_PAYLOAD_AT_S, _PAYLOAD_SHARE = 128.0, 0.1


def gusts(seeds: list[int]) -> NDArray[np.float64]:
    """One gust for each vehicle, from a direction of its seed's own."""
    rows = []
    for vehicle, seed in enumerate(seeds):
        angle = 2.4 * (seed - 1)
        push = (_GUST_M_S * math.cos(angle), _GUST_M_S * math.sin(angle), 1.0)
        rows.append((vehicle, _GUST_AT_S, _GUST_S, *push))
    return np.array(rows)


class Script:
    """Sets the goals of all vehicles over time: steps, a square at 5 m/s, climbs and descents, yaw turns, a gust,
    a dropped payload."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._start = fleet.autopilot.position.goal.copy()
        self._dropped = False

    def step(self, time_s: float) -> None:
        """Goals for ``time_s`` since the start."""
        position = self._fleet.autopilot.position
        offset = np.zeros(3)
        yaw_rate = 0.0
        velocity = np.full(3, np.nan)
        if 5.0 <= time_s < 37.0:
            offset = np.array(
                [(0, 0, 0), (_STEP_M, 0, 0), (_STEP_M, _STEP_M, 0), (0, 0, 0)][int((time_s - 5.0) // 8.0)], float
            )
        elif 37.0 <= time_s < 69.0:
            leg = int((time_s - 37.0) // 4.0) % 4
            direction = [(1, 0), (0, 1), (-1, 0), (0, -1)][leg]
            velocity = np.array([_SQUARE_SPEED_M_S * direction[0], _SQUARE_SPEED_M_S * direction[1], 0.0])
        elif 73.0 <= time_s < 95.0:
            offset[2] = -_CLIMB_M if time_s < 84.0 else 0.0
        elif 95.0 <= time_s < 110.0:
            yaw_rate = _YAW_RATE_RAD_S if time_s < 102.0 else -_YAW_RATE_RAD_S
        if time_s >= _PAYLOAD_AT_S and not self._dropped:
            self._dropped = True
            self._fleet.plant.mass_kg = self._fleet.plant.mass_kg * (1.0 - _PAYLOAD_SHARE)
        position.goal = self._start + offset
        position.goal_velocity = np.tile(velocity, (self._fleet.vehicles, 1))
        position.goal_yaw_rate = np.full(self._fleet.vehicles, yaw_rate)
