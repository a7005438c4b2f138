"""Wind: a mean, Dryden turbulence (MIL-F-8785C, low altitude forms) and discrete gusts of 1 - cosine shape."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sitl.noise import NormalBlocks

_REFERENCE_SPEED_M_S = 4.0
_LENGTH_HORIZONTAL_M = 60.0
_LENGTH_VERTICAL_M = 12.0


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
        self.mean = np.asarray(mean_m_s, float)
        self._sigma = np.asarray(sigma_m_s, float)[:, None]
        speed = np.maximum(np.linalg.norm(self.mean, axis=1), _REFERENCE_SPEED_M_S)
        horizontal, vertical = speed / _LENGTH_HORIZONTAL_M, speed / _LENGTH_VERTICAL_M
        self._decay = np.exp(-dt_s * np.stack([horizontal, horizontal, vertical], axis=1))
        self._drive = np.sqrt(1 - self._decay**2)
        self._noise = NormalBlocks(generators, 3)
        count = len(speed)
        # Start in the stationary distribution: no vehicle begins in still air.
        self._first = self._noise.next().copy()
        self._second = np.zeros((count, 3))
        self._gusts = np.zeros((0, 6)) if gusts is None else np.asarray(gusts, float).reshape(-1, 6)
        self._steady = not self._sigma.any() and not len(self._gusts)
        direction = np.zeros((count, 3))
        norm = np.linalg.norm(self.mean, axis=1)
        direction[:, 0] = 1.0
        moving = norm > 1e-6
        direction[moving] = self.mean[moving] / norm[moving, None]
        self._along = direction
        self._across = np.stack([-direction[:, 1], direction[:, 0], np.zeros(count)], axis=1)

    def step(self, time_s: float) -> NDArray[np.float64]:
        """Advance by one plant step; returns wind (N, 3) in m/s, NED."""
        if self._steady:
            return self.mean.copy()
        self._first = self._decay * self._first + self._drive * self._noise.next()
        # The lateral and vertical Dryden forms have a zero after two poles: the first state plus its difference to
        # a second lag gives that spectrum's (1 + sqrt(3) T s) / (1 + T s)^2.
        self._second = self._decay * self._second + (1 - self._decay) * self._first
        shaped = (self._first + (math.sqrt(3) - 1) * (self._first - self._second)) / math.sqrt(2)
        u, v, w = self._first[:, :1], shaped[:, 1:2], shaped[:, 2:3]
        wind = self.mean + self._sigma * (u * self._along + v * self._across)
        wind[:, 2:3] += self._sigma * 0.5 * w
        for vehicle, start, duration, north, east, down in self._gusts:
            phase = (time_s - start) / duration
            if 0.0 <= phase <= 1.0:
                wind[int(vehicle)] += 0.5 * (1 - math.cos(2 * math.pi * phase)) * np.array([north, east, down])
        return wind
