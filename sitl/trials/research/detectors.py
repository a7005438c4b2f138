"""Which estimator a trial flies with: ours, or the IMM peer."""

from __future__ import annotations

from dataclasses import replace

from nff_companion.core.parts import FLOWN, Parts
from nff_companion.errors import ConfigError

DETECTORS = ("sparse", "imm")


def parts_of(detector: str, joint: float = 0.0) -> Parts:
    """What flies, with the detector named. Raises ConfigError, MissingExtra."""
    if detector == "sparse":
        return replace(FLOWN, joint=joint)
    if detector == "imm":
        from sitl.trials.research.imm import ImmEstimator

        return replace(FLOWN, name="imm", estimator=ImmEstimator)
    raise ConfigError(f"detector {detector!r} is unknown: choose one of {', '.join(DETECTORS)}")
