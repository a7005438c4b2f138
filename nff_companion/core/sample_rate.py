"""At which rate samples really come, by their own times."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

TOLERANCE = 0.10  # samples that come at another rate than was agreed by more than this are refused
_SAME = 0.01  # less is jitter
_COUNT = 100  # intervals: the median of so many is steady under jitter, and under losses of a third
_LEAST = 20


class SampleRate:
    """Median of the last intervals."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_COUNT + 1)
        self._since = 0
        self._rate_hz: float | None = None

    def add(self, time_s: float) -> None:
        """One sample; a time that does not go on starts the measurement anew."""
        if self._times and not 0.0 < time_s - self._times[-1] < 1.0:
            if time_s == self._times[-1]:
                return
            self.restart()
        self._times.append(time_s)
        self._since += 1

    def restart(self) -> None:
        """Nothing measured."""
        self._times.clear()
        self._since, self._rate_hz = 0, None

    @property
    def hz(self) -> float | None:
        """The rate; None until enough has been heard. Measured anew every few samples."""
        if len(self._times) <= _LEAST:
            return None
        if self._rate_hz is None or self._since >= _LEAST:
            times = list(self._times)
            gaps = sorted(after - before for before, after in pairwise(times))
            self._rate_hz, self._since = 1.0 / gaps[len(gaps) // 2], 0
        return self._rate_hz


class Agreement:
    """The rate that was agreed with the autopilot, and the one that comes."""

    def __init__(self, agreed_hz: float) -> None:
        self.agreed_hz = agreed_hz
        self._measured = SampleRate()

    def add(self, time_s: float) -> None:
        """One sample."""
        self._measured.add(time_s)

    def restart(self) -> None:
        """Nothing measured."""
        self._measured.restart()

    def build_for(self, built_hz: float) -> float:
        """Rate that an estimator built for ``built_hz`` should be built for, between flights."""
        measured = self._measured.hz
        if measured is None or abs(measured / self.agreed_hz - 1.0) > TOLERANCE:
            return built_hz
        return measured if abs(measured / built_hz - 1.0) > _SAME else built_hz

    def off_hz(self, built_hz: float) -> float | None:
        """The rate measured, where it is not the one that the estimator was built for."""
        measured = self._measured.hz
        return None if measured is None or abs(measured / built_hz - 1.0) <= TOLERANCE else measured
