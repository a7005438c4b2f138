"""Which samples may be used: complete, finite, plausible, in time. Pure."""

from __future__ import annotations

import math

from nff_companion.condition import Reason, Statement
from nff_companion.core.sample import Sample

# Beyond what any vehicle survives: such a sample is a fault of the sensor or of the link.
_GYRO_MAX_RAD_S, _FORCE_MAX_M_S2, _TIME_MAX_S = 60.0, 400.0, 1e8
_REORDERED_S = 0.1  # a sample this much older than the last one is a duplicate or came late: ignored
_DUPLICATE = 0.2  # of the sample time: what comes sooner after the last one is the same sample


def refusal(sample: Sample, motors: int) -> Statement | None:
    """Why the sample of a vehicle with so many ``motors`` cannot be used; None when it can."""
    command = sample.thrust if sample.thrust is not None else sample.output
    if command.shape != (motors,):
        return Statement(Reason.MOTOR_COUNT, f"{command.size} motor outputs, the airframe {motors}")
    # A sum is finite only if all its terms are.
    if not math.isfinite(float(command.sum())):
        return Statement(Reason.OUTPUTS_MISSING)
    if not math.isfinite(float(sample.gyro_rad_s.sum()) + float(sample.specific_force_m_s2.sum())):
        return Statement(Reason.NOT_FINITE)
    if not 0.0 <= sample.time_s < _TIME_MAX_S:
        return Statement(Reason.SAMPLE_TIME, str(sample.time_s))
    if abs(sample.gyro_rad_s).max() > _GYRO_MAX_RAD_S or abs(sample.specific_force_m_s2).max() > _FORCE_MAX_M_S2:
        return Statement(Reason.IMPLAUSIBLE)
    return None


def again(gap_s: float, dt_s: float) -> bool:
    """Whether a sample ``gap_s`` after the last one is a duplicate, or came late; ``dt_s`` is the sample time."""
    return -_REORDERED_S < gap_s < _DUPLICATE * dt_s


def follows(gap_s: float, dt_s: float, gap_max_s: float) -> bool:
    """Whether it goes on from the last one: neither the same again, nor after a jump of time."""
    return _DUPLICATE * dt_s <= gap_s <= gap_max_s
