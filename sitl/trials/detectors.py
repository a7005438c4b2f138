"""Which estimator a trial flies with: ours, or the IMM peer."""

from __future__ import annotations

from collections.abc import Callable

from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError
from nff_companion.pipeline import Pipeline, PipelineOptions

DETECTORS = ("sparse", "imm")


def pipeline_factory(name: str) -> Callable[[Vehicle, float, PipelineOptions], Pipeline]:
    """Maker of pipelines with the detector ``name``. Raises ConfigError, MissingExtra."""
    if name == "sparse":
        return Pipeline
    if name == "imm":
        from sitl.trials.imm import imm_pipeline

        return imm_pipeline
    raise ConfigError(f"detector {name!r} is unknown: choose one of {', '.join(DETECTORS)}")
