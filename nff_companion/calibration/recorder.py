"""The newest flight samples that a calibration may use, in arrays of a fixed size. Pure.

Single precision is finer than any sensor; what comes is kept as it comes, because the calibration makes even samples of
it itself (calibration/record.py). Nothing is computed here: the daemon keeps every sample of a flight, in its loop.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample

_GYRO, _FORCE, _QUATERNION, _VELOCITY, _HEAD = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13), 13
_NO_QUATERNION, _NO_VELOCITY = np.full(4, np.nan), np.full(3, np.nan)
_STAMP_BYTES, _NUMBER_BYTES = 8, 4


class FlightRecorder:
    """A ring of ``rows`` samples of a vehicle with so many motors; memory is taken as it fills."""

    def __init__(self, motors: int, rows: int) -> None:
        self.motors, self.rows = motors, rows
        self._time_s = np.zeros(rows)
        self._values = np.zeros((rows, _HEAD + motors), np.float32)
        self.flights = 0  # that ended with something in the ring
        self._begin = self._end = 0  # samples since the start: the oldest that is left, and one past the newest
        self._mark = 0  # where the flight began
        self._spoilt = False

    @property
    def samples(self) -> int:
        """In the ring."""
        return self._end - self._begin

    @property
    def bytes_max(self) -> int:
        """That it may take."""
        return self.rows * (_STAMP_BYTES + _NUMBER_BYTES * (_HEAD + self.motors))

    def add(self, sample: Sample) -> None:
        """One sample of a vehicle that is whole, in flight."""
        if self._spoilt:
            return
        place = self._end % self.rows
        if self._end > self._mark and sample.time_s <= self._time_s[place - 1]:
            return  # the same again
        self._time_s[place] = sample.time_s
        quaternion, velocity = _NO_QUATERNION, _NO_VELOCITY
        if sample.moves_plausibly and sample.quaternion is not None and sample.velocity_m_s is not None:
            quaternion, velocity = sample.quaternion, sample.velocity_m_s
        self._values[place] = np.concatenate(
            (sample.gyro_rad_s, sample.specific_force_m_s2, quaternion, velocity, sample.output)
        )
        self._end += 1
        if self._end - self._begin > self.rows:
            self._begin += 1

    def spoil(self) -> None:
        """A motor has failed: nothing of this flight counts, up to its end."""
        self._spoilt = True
        self._end = max(self._mark, self._begin)
        self._mark = self._end

    def landed(self) -> None:
        """Disarmed: the flight has ended."""
        if self._end > self._mark:
            self.flights += 1
        self._mark, self._spoilt = self._end, False

    def forget(self) -> None:
        """Another vehicle."""
        self._begin = self._mark = self._end
        self._spoilt = False

    def taken(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Copies of times (N,) and values (N, 13 + m), the oldest first."""
        places = np.arange(self._begin, self._end) % self.rows
        return self._time_s[places], self._values[places]


def samples(time_s: NDArray[np.float64], values: NDArray[np.float32]) -> list[Sample]:
    """What ``taken`` gave, as samples again."""
    numbers = values.astype(np.float64)
    out = []
    for stamp, row, known in zip(time_s.tolist(), numbers, np.isfinite(numbers), strict=True):
        out.append(
            Sample(
                time_s=stamp,
                gyro_rad_s=row[_GYRO],
                specific_force_m_s2=row[_FORCE],
                output=row[_HEAD:],
                armed=True,
                quaternion=row[_QUATERNION] if known[_QUATERNION].all() else None,
                velocity_m_s=row[_VELOCITY] if known[_VELOCITY].all() else None,
            )
        )
    return out
