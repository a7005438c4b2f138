"""Samples of a log at the rate that finding a failed motor needs: several in a row become their mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.replay.flight import Row

RATE_HZ = 100.0  # as much as is known of a motor within the tenth of a second in which it is named
_GAP = 2.5  # intervals without a sample: what is on either side is not averaged
_KEPT_MIN = 0.9  # of the samples: what comes in pairs or bursts is left as it is


def thinned(rows: list[Row], rate_hz: float = RATE_HZ) -> list[Row]:
    """Means of so many samples in a row that about ``rate_hz`` are left; ``rows`` themselves where they are no more
    than that. Gyro, accelerometer and outputs are averaged alike, so that what filters show stays comparable; of all
    else the last counts. Samples on either side of a gap, armed and disarmed ones are not mixed."""
    if len(rows) < 2:
        return rows
    time_s = np.array([sample.time_s for _, sample in rows])
    steps = np.diff(time_s)
    steps_forward = steps[steps > 0.0]
    if len(steps_forward) == 0:
        return rows
    step_s = float(np.median(steps_forward))
    many = round(1.0 / (step_s * rate_hz))
    if many < 2:
        return rows
    armed = np.array([sample.armed for _, sample in rows])
    breaks = np.flatnonzero((steps <= 0.0) | (steps > _GAP * step_s) | (armed[1:] != armed[:-1])) + 1
    first = np.concatenate(
        [np.arange(a, b - many + 1, many) for a, b in zip([0, *breaks], [*breaks, len(rows)], strict=True)]
    ).astype(int)
    if many * len(first) < _KEPT_MIN * len(rows):
        return rows
    columns: list[Callable[[Sample], Any]] = [
        lambda sample: sample.gyro_rad_s,
        lambda sample: sample.specific_force_m_s2,
        lambda sample: sample.output,
        lambda sample: sample.thrust,
    ]
    samples = [sample for _, sample in rows]
    means = [_means(samples, column, first, many) for column in columns]
    times = _mean(time_s, first, many)
    out: list[Row] = []
    for index, begin in enumerate(first):
        stamp, last = rows[begin + many - 1]
        out.append((stamp, _sample(last, float(times[index]), [None if m is None else m[index] for m in means])))
    return out


def _means(
    samples: list[Sample], column: Callable[[Sample], Any], first: NDArray[np.int64], many: int
) -> NDArray[np.float64] | None:
    values = [column(sample) for sample in samples]
    if any(value is None for value in values):
        return None
    try:
        table = np.concatenate(values).reshape(len(values), -1)
    except ValueError:
        return None
    if table.shape[1] != len(values[0]) or any(len(value) != table.shape[1] for value in values):
        return None
    return _mean(table, first, many)


def _mean(table: NDArray[np.float64], first: NDArray[np.int64], many: int) -> NDArray[np.float64]:
    out: NDArray[np.float64] = np.mean([table[first + k] for k in range(many)], axis=0)
    return out


def _sample(last: Sample, time_s: float, means: list[NDArray[np.float64] | None]) -> Sample:
    gyro, force, output, thrust = means
    return Sample(
        time_s=time_s,
        gyro_rad_s=last.gyro_rad_s if gyro is None else gyro,
        specific_force_m_s2=last.specific_force_m_s2 if force is None else force,
        output=last.output if output is None else output,
        armed=last.armed,
        quaternion=last.quaternion,
        position_m=last.position_m,
        velocity_m_s=last.velocity_m_s,
        landed=last.landed,
        thrust=last.thrust if thrust is None else thrust,
        rotor_speed_rad_s=last.rotor_speed_rad_s,
        rotor_speed_time_s=last.rotor_speed_time_s,
    )
