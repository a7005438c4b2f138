"""Where scripts reach into the loops: mixer factors and overrides of single servo channels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


class ScriptedPort:
    """One vehicle. Factors are ArduPilot's: columns throttle, roll, pitch, yaw."""

    def __init__(self, motors: int, loop_s: float) -> None:
        self.motors, self._loop_s = motors, loop_s
        self.factors: NDArray[np.float64] | None = None
        self._pwm = np.full(motors, np.nan)
        self._until_s = np.full(motors, -np.inf)

    def override(self, motor: int, pwm: int, timeout_ms: int, now_s: float) -> None:
        """Hold the channel of ``motor`` (index); the time-out is rounded up to whole loops, as the firmware does."""
        loops = math.ceil(1e-3 * timeout_ms / self._loop_s - 1e-9)
        self._pwm[motor], self._until_s[motor] = pwm, now_s + loops * self._loop_s

    def pwm_at(self, now_s: float) -> NDArray[np.float64]:
        """(m,) pulse widths in force, NaN where the mixer drives."""
        return np.where(now_s < self._until_s - 1e-9, self._pwm, np.nan)
