"""Wind: a mean, Dryden turbulence (MIL-F-8785C, low altitude forms) and discrete gusts of 1 - cosine shape."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import kernel, part, prepare
from sitl.noise import NormalBlocks
from sitl.rotation import Vector, put

_REFERENCE_SPEED_M_S = 4.0
_LENGTH_HORIZONTAL_M = 60.0
_LENGTH_VERTICAL_M = 12.0
_ROOT_3 = math.sqrt(3)
_ROOT_2 = math.sqrt(2)

WIND = np.dtype(
    [
        ("mean_m_s", "f8", (3,)),
        ("sigma_m_s", "f8"),
        ("along", "f8", (3,)),  # unit vectors with the mean wind and, level, across it
        ("across", "f8", (3,)),
        ("decay", "f8", (3,)),  # of the turbulence's states in a step
        ("drive", "f8", (3,)),
        ("first", "f8", (3,)),  # those states
        ("second", "f8", (3,)),
        ("gusts_from", "i8"),  # rows of the vehicle's gusts
        ("gusts_to", "i8"),
    ]
)


class Air(NamedTuple):
    """What ``blow`` reads and writes."""

    winds: NDArray[np.void]  # (N,) of WIND
    gusts: NDArray[np.float64]  # (G, 6), those of one vehicle together
    noise: NDArray[np.float64]  # (N, block, 3)
    steady: bool


@part
def blow(n: int, air: Air, draw: int, time_s: float) -> Vector:
    """Wind at vehicle ``n`` after one more step, NED, m/s; ``draw``: place of the step's noise."""
    wind = air.winds[n]
    mean = wind.mean_m_s
    north, east, down = mean[0], mean[1], mean[2]
    if air.steady:
        return north, east, down
    first, second, decay = wind.first, wind.second, wind.decay
    for k in range(3):
        first[k] = decay[k] * first[k] + wind.drive[k] * air.noise[n, draw, k]
        # The lateral and vertical Dryden forms have a zero after two poles: the first state plus its difference to
        # a second lag gives that spectrum's (1 + sqrt(3) T s) / (1 + T s)^2.
        second[k] = decay[k] * second[k] + (1 - decay[k]) * first[k]
    u = first[0]
    v = (first[1] + (_ROOT_3 - 1) * (first[1] - second[1])) / _ROOT_2
    w = (first[2] + (_ROOT_3 - 1) * (first[2] - second[2])) / _ROOT_2
    along, across, sigma = wind.along, wind.across, wind.sigma_m_s
    north += sigma * (u * along[0] + v * across[0])
    east += sigma * (u * along[1] + v * across[1])
    down += sigma * (u * along[2] + v * across[2]) + sigma * 0.5 * w
    for row in range(wind.gusts_from, wind.gusts_to):
        phase = (time_s - air.gusts[row, 1]) / air.gusts[row, 2]
        if 0.0 <= phase <= 1.0:
            share = 0.5 * (1 - math.cos(2 * math.pi * phase))
            north += share * air.gusts[row, 3]
            east += share * air.gusts[row, 4]
            down += share * air.gusts[row, 5]
    return north, east, down


@kernel
def _blow_all(air: Air, draw: int, time_s: float, out: NDArray[np.float64]) -> None:
    for n in range(len(out)):
        put(out, n, blow(n, air, draw, time_s))


class Wind:
    """Wind velocity in NED for each vehicle.

    ``mean_m_s`` (N, 3), ``sigma_m_s`` (N,) standard deviation of the turbulence; gusts: rows of
    (vehicle index, start [s], duration [s], north, east, down [m/s]).
    """

    def __init__(
        self,
        mean_m_s: NDArray[np.float64],
        sigma_m_s: NDArray[np.float64],
        dt_s: float,
        generators: list[np.random.Generator],
        gusts: NDArray[np.float64] | None = None,
    ) -> None:
        mean, sigma = np.asarray(mean_m_s, float), np.asarray(sigma_m_s, float)
        norm = np.linalg.norm(mean, axis=1)
        speed = np.maximum(norm, _REFERENCE_SPEED_M_S)
        horizontal, vertical = speed / _LENGTH_HORIZONTAL_M, speed / _LENGTH_VERTICAL_M
        self._winds = winds = np.zeros(len(speed), WIND)
        winds["mean_m_s"], winds["sigma_m_s"] = mean, sigma
        winds["decay"] = np.exp(-dt_s * np.stack([horizontal, horizontal, vertical], axis=1))
        winds["drive"] = np.sqrt(1 - winds["decay"] ** 2)
        self._noise = NormalBlocks(generators, 3)
        # Start in the stationary distribution: no vehicle begins in still air.
        winds["first"] = self._noise.next()
        direction = np.tile([1.0, 0.0, 0.0], (len(speed), 1))
        moving = norm > 1e-6
        direction[moving] = mean[moving] / norm[moving, None]
        winds["along"] = direction
        winds["across"] = np.stack([-direction[:, 1], direction[:, 0], np.zeros(len(speed))], axis=1)
        rows = np.zeros((0, 6)) if gusts is None else np.asarray(gusts, float).reshape(-1, 6)
        self._gusts = rows[np.argsort(rows[:, 0].astype(int), kind="stable")]
        vehicle = self._gusts[:, 0].astype(int)
        winds["gusts_from"] = np.searchsorted(vehicle, np.arange(len(speed)), "left")
        winds["gusts_to"] = np.searchsorted(vehicle, np.arange(len(speed)), "right")
        self._steady = not sigma.any() and not len(rows)

    def take(self, steps: int) -> tuple[Air, int]:
        """For ``blow`` over that many steps: what it needs, and the place of the first one's noise."""
        draw = 0 if self._steady else self._noise.take(steps)
        return Air(self._winds, self._gusts, self._noise.buffer, self._steady), draw

    def prepare(self) -> None:
        """Compile, or load, what ``step`` runs."""
        prepare(_blow_all, self.take(0)[0], 0, 0.0, np.empty((len(self._winds), 3)))

    def step(self, time_s: float) -> NDArray[np.float64]:
        """Advance by one plant step; returns wind (N, 3) in m/s, NED."""
        out = np.empty((len(self._winds), 3))
        air, draw = self.take(1)
        _blow_all(air, draw, time_s, out)
        return out
