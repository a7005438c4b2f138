"""Which samples may be used: complete, finite, plausible, in time. Pure."""

from __future__ import annotations

import math

from nff_companion.condition import Reason, Statement
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import CompanionTuning


def refusal(sample: Sample, motors: int, tuning: CompanionTuning) -> Statement | None:
    """Why the sample of a vehicle with so many ``motors`` cannot be used; None when it can."""
    command = sample.thrust if sample.thrust is not None else sample.output
    if command.shape != (motors,):
        return Statement(Reason.MOTOR_COUNT, f"{command.size} motor outputs, the airframe {motors}")
    # A sum is finite only if all its terms are.
    if not math.isfinite(sum(command.tolist())):
        return Statement(Reason.OUTPUTS_MISSING)
    gyro, force = sample.gyro_rad_s.tolist(), sample.specific_force_m_s2.tolist()
    if not math.isfinite(sum(gyro) + sum(force)):
        return Statement(Reason.NOT_FINITE)
    if not 0.0 <= sample.time_s < tuning.time_max_s:
        return Statement(Reason.SAMPLE_TIME, str(sample.time_s))
    if max(map(abs, gyro)) > tuning.gyro_max_rad_s or max(map(abs, force)) > tuning.force_max_m_s2:
        return Statement(Reason.IMPLAUSIBLE)
    return None


def again(gap_s: float, dt_s: float, tuning: CompanionTuning) -> bool:
    """Whether a sample ``gap_s`` after the last one is a duplicate, or came late; ``dt_s`` is the sample time."""
    return -tuning.reordered_s < gap_s < tuning.repeated_share * dt_s


def follows(gap_s: float, dt_s: float, tuning: CompanionTuning) -> bool:
    """Whether it goes on from the last one: neither the same again, nor after a jump of time."""
    return tuning.repeated_share * dt_s <= gap_s <= tuning.gap_max_s
