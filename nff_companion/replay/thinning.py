"""Samples of a log at the rate that finding a failed motor needs: several in a row become their mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.replay.flight import Row
from nff_companion.replay.table import Table

Array = NDArray[np.float64]

RATE_HZ = 100.0  # as much as is known of a motor within the tenth of a second in which it is named
_GAP = 2.5  # intervals without a sample: what is on either side is not averaged
_AVERAGED = ("gyro_rad_s", "specific_force_m_s2", "output", "thrust")
_KEPT_MIN = 0.9  # of the samples: what comes in pairs or bursts is left as it is


def thinned(rows: Sequence[Row], rate_hz: float = RATE_HZ) -> Sequence[Row]:
    """Means of so many samples in a row that about ``rate_hz`` are left; ``rows`` themselves where they are no more
    than that. Gyro, accelerometer and outputs are averaged alike, so that what filters show stays comparable; of all
    else the last counts. Samples on either side of a gap, armed and disarmed ones are not mixed."""
    if len(rows) < 2:
        return rows
    if isinstance(rows, Table):
        time_s, armed = rows.time_s, rows.armed
    else:
        time_s = np.array([sample.time_s for _, sample in rows])
        armed = np.array([sample.armed for _, sample in rows])
    first, many = _groups(time_s, armed, rate_hz)
    if many < 2 or many * len(first) < _KEPT_MIN * len(rows):
        return rows
    times = _mean(time_s, first, many)
    if isinstance(rows, Table):
        last = rows.taken(first + many - 1)
        averaged = {name: getattr(rows, name) for name in _AVERAGED}
        means: dict[str, Any] = {k: None if v is None else _mean(v, first, many) for k, v in averaged.items()}
        return replace(last, time_s=times, **means)
    samples = [sample for _, sample in rows]
    found = {name: _means(samples, attrgetter(name), first, many) for name in _AVERAGED}
    out: list[Row] = []
    for index, begin in enumerate(first):
        stamp, sample = rows[begin + many - 1]
        means = {name: mean[index] for name, mean in found.items() if mean is not None}
        out.append((stamp, replace(sample, time_s=float(times[index]), **means)))
    return out


def _groups(time_s: Array, armed: NDArray[np.bool_], rate_hz: float) -> tuple[NDArray[np.int64], int]:
    """Where each of the means begins (K,), and of how many samples it is; 1: they are seldom enough."""
    steps = np.diff(time_s)
    steps_forward = steps[steps > 0.0]
    step_s = float(np.median(steps_forward)) if len(steps_forward) else np.inf
    many = round(1.0 / (step_s * rate_hz))
    if many < 2:
        return np.arange(len(time_s)), 1
    breaks = np.flatnonzero((steps <= 0.0) | (steps > _GAP * step_s) | (armed[1:] != armed[:-1])) + 1
    parts = zip([0, *breaks], [*breaks, len(time_s)], strict=True)
    return np.concatenate([np.arange(a, b - many + 1, many) for a, b in parts]).astype(int), many


def _means(samples: list[Sample], column: Callable[[Sample], Any], first: NDArray[np.int64], many: int) -> Array | None:
    """(K, c); None where not all samples have the same of it."""
    values = [column(sample) for sample in samples]
    if any(value is None for value in values) or len({len(value) for value in values}) != 1:
        return None
    return _mean(np.concatenate(values).reshape(len(values), -1), first, many)


def _mean(table: Array, first: NDArray[np.int64], many: int) -> Array:
    out: Array = np.mean([table[first + k] for k in range(many)], axis=0)
    return out
