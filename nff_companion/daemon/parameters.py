"""What a ground station may set: the mode, a declaration lifted, and the thresholds that core/tuning serves."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from nff_companion.core.tuning import DEFAULT, check
from nff_companion.core.tuning.parameters import SERVED, Served
from nff_companion.errors import ConfigError
from nff_companion.mavlink.services.parameter_server import Parameter
from nff_companion.pipeline import Mode, Pipeline


def parameters(pipeline: Pipeline, set_mode: Callable[[Mode], None], lift: Callable[[int], None]) -> list[Parameter]:
    """In the order of their indices."""

    def change_mode(value: float) -> bool:
        set_mode(Mode(int(value)))
        return True

    def lift_motor(value: float) -> bool:
        if value >= 1:
            lift(int(value))
        return True

    motors = pipeline.vehicle.motors
    return [
        Parameter("NFF_MODE", 0, 2, lambda: float(pipeline.mode), change_mode, whole=True),
        Parameter("NFF_LIFT", 0, motors, lambda: 0.0, lift_motor, whole=True),
        *(_threshold(pipeline, served) for served in SERVED),
    ]


def _threshold(pipeline: Pipeline, served: Served) -> Parameter:
    field = served.field
    name, whole = field.path[-1], field.kind is int

    def get() -> float:
        return float(getattr(pipeline.options.estimator.decision, name))

    def change(value: float) -> bool:
        options = pipeline.options.estimator
        decision = msgspec.structs.replace(options.decision, **{name: int(value) if whole else value})
        try:
            check(DEFAULT.having("decision", **msgspec.structs.asdict(decision)))
        except ConfigError:
            return False  # in range for itself, but at odds with another threshold
        return pipeline.retune(msgspec.structs.replace(options, decision=decision))

    # More than half of the motors cannot be done without on any airframe.
    high = min(field.high, pipeline.vehicle.motors // 2) if name == "failed_max" else field.high
    return Parameter(served.name, field.low, high, get, change, whole)
