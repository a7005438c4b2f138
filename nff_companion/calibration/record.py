"""Healthy flight as calibration takes it: even samples, in pieces without gaps. FRD body, SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample

_GAP_PERIODS = 3.5  # longer, and a new piece begins
PIECE_MIN_S = 3.0
_ENDS_S = 1.0  # of each piece left out: take-off, landing, what came after a gap
_FLYING = 0.6  # of the usual output
NO_BATTERY = np.zeros((0, 2))


@dataclass(frozen=True, slots=True)
class Piece:
    """N samples ``dt_s`` apart. Where the log has no velocity, it is zero."""

    dt_s: float
    gyro_rad_s: NDArray[np.float64]  # (N, 3)
    specific_force_m_s2: NDArray[np.float64]  # (N, 3)
    output: NDArray[np.float64]  # (N, m) 0..1
    velocity_m_s: NDArray[np.float64]  # (N, 3) along the body's axes
    battery: NDArray[np.float64]  # (B, 2) seconds since the first sample, V at its terminals; no rows: not in the log

    @property
    def samples(self) -> int:
        """N."""
        return len(self.gyro_rad_s)

    def first(self, seconds: float) -> Piece:
        """Its beginning."""
        n = max(round(seconds / self.dt_s), 1)
        return Piece(
            self.dt_s,
            self.gyro_rad_s[:n],
            self.specific_force_m_s2[:n],
            self.output[:n],
            self.velocity_m_s[:n],
            self.battery[self.battery[:, 0] < n * self.dt_s],
        )


@dataclass(frozen=True, slots=True)
class Record:
    """All pieces of one or several flights."""

    pieces: list[Piece]

    @property
    def duration_s(self) -> float:
        """Of all pieces."""
        return sum(piece.samples * piece.dt_s for piece in self.pieces)


def record(
    samples: Sequence[Sample], rate_hz: float | None = None, battery: NDArray[np.float64] = NO_BATTERY
) -> Record:
    """Pieces of the flying part, without take-off and landing, at the rate of the samples or at ``rate_hz``.

    ``battery`` (B, 2): s of the samples' clock, V.
    """
    known = [s for s in samples if s.armed and s.landed is not True and np.isfinite(s.output).all()]
    if len(known) < 2:
        return Record([])
    mean = np.array([float(s.output.mean()) for s in known])
    flying = mean > _FLYING * float(np.median(mean[mean > _FLYING * mean.max()]))
    flown = [s for s, flies in zip(known, flying, strict=True) if flies]
    time_s = np.array([s.time_s for s in flown])
    gaps = np.diff(time_s)
    if not (gaps > 0.0).any():
        return Record([])
    period = float(np.median(gaps[gaps > 0.0]))
    dt_s = 1.0 / rate_hz if rate_hz else period
    ends = [0, *(np.flatnonzero((gaps > _GAP_PERIODS * period) | (gaps <= 0.0)) + 1), len(flown)]
    pieces = []
    for first, last in pairwise(ends):
        begin, end = np.searchsorted(time_s[first:last], (time_s[first] + _ENDS_S, time_s[last - 1] - _ENDS_S)) + first
        if end - begin > 2 and time_s[end - 1] - time_s[begin] >= PIECE_MIN_S:
            pieces.append(_piece(flown[begin:end], time_s[begin:end], dt_s, battery))
    return Record(pieces)


def _piece(samples: Sequence[Sample], time_s: NDArray[np.float64], dt_s: float, battery: NDArray[np.float64]) -> Piece:
    at = np.arange(time_s[0], time_s[-1], dt_s)

    def even(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([np.interp(at, time_s, column) for column in values.T], axis=1)

    return Piece(
        dt_s=dt_s,
        gyro_rad_s=even(np.array([s.gyro_rad_s for s in samples])),
        specific_force_m_s2=even(np.array([s.specific_force_m_s2 for s in samples])),
        output=even(np.array([s.output for s in samples])),
        velocity_m_s=even(np.array([_velocity(s) for s in samples])),
        battery=battery[(battery[:, 0] >= time_s[0]) & (battery[:, 0] <= time_s[-1])] - (time_s[0], 0.0),
    )


def _velocity(sample: Sample) -> NDArray[np.float64]:
    """(3,) along the body's axes, m/s; zeros where it is not known."""
    if sample.quaternion is None or sample.velocity_m_s is None:
        return np.zeros(3)
    w, x, y, z = sample.quaternion.tolist()
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return rotation.T @ sample.velocity_m_s
