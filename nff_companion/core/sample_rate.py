"""At which rate samples really come, by their own times."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from nff_companion.core.tuning import DEFAULT, SampleRateTuning


class SampleRate:
    """Median of the last intervals."""

    def __init__(self, tuning: SampleRateTuning = DEFAULT.sample_rate) -> None:
        self._least = tuning.intervals_least
        self._times: deque[float] = deque(maxlen=tuning.intervals + 1)
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
        if len(self._times) <= self._least:
            return None
        if self._rate_hz is None or self._since >= self._least:
            times = list(self._times)
            gaps = sorted(after - before for before, after in pairwise(times))
            self._rate_hz, self._since = 1.0 / gaps[len(gaps) // 2], 0
        return self._rate_hz


class Agreement:
    """The rate that was agreed with the autopilot, and the one that comes."""

    def __init__(self, agreed_hz: float, tuning: SampleRateTuning = DEFAULT.sample_rate) -> None:
        self.agreed_hz, self._tuning = agreed_hz, tuning
        self._measured = SampleRate(tuning)
        self._new = True  # nothing was measured since it was agreed

    def add(self, time_s: float) -> None:
        """One sample."""
        self._measured.add(time_s)

    def restart(self) -> None:
        """Nothing measured."""
        self._measured.restart()
        self._new = False

    def build_for(self, built_hz: float) -> float:
        """Rate that an estimator built for ``built_hz`` should be built for, between flights."""
        measured = self._measured.hz
        if measured is None and self._new:
            return self.agreed_hz
        if measured is None or abs(measured / self.agreed_hz - 1.0) > self._tuning.off_share:
            return built_hz
        return measured if abs(measured / built_hz - 1.0) > self._tuning.same_share else built_hz

    def off_hz(self, built_hz: float) -> float | None:
        """The rate measured, where it is not the one that the estimator was built for."""
        measured = self._measured.hz
        return None if measured is None or abs(measured / built_hz - 1.0) <= self._tuning.off_share else measured
