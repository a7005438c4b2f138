"""Parameters of the autopilot over the time of a log."""

from __future__ import annotations

import math
from bisect import bisect_right


class Parameters:
    """Values by name and time. What was written in flight is not what the vehicle took off with."""

    def __init__(self) -> None:
        self._times: dict[str, list[float]] = {}
        self._values: dict[str, list[float]] = {}

    def __len__(self) -> int:
        return len(self._times)

    def put(self, time_s: float, name: str, value: float) -> None:
        """One value as it was logged, in the order of the log; what is no number was spoilt, and does not count."""
        if not math.isfinite(value):
            return
        self._times.setdefault(name, []).append(time_s)
        self._values.setdefault(name, []).append(value)

    def at(self, time_s: float) -> dict[str, float]:
        """What held at a time; of one that was logged only later the first value (a log begins before its parameters
        are written)."""
        return {
            name: self._values[name][max(bisect_right(times, time_s) - 1, 0)] for name, times in self._times.items()
        }
