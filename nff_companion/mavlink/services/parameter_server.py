"""Parameters of the companion by MAVLink's parameter protocol: a ground station sets mode and thresholds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import name_of
from nff_companion.pipeline import Mode, Pipeline

_REAL = dialect.MAV_PARAM_TYPE_REAL32


@dataclass(frozen=True)
class _Parameter:
    low: float
    high: float
    get: Callable[[], float]
    set: Callable[[float], bool]  # False: refused now


class ParameterServer:
    """Values are those in use; a refused change is answered with the value that stays."""

    def __init__(
        self, pipeline: Pipeline, component: int, set_mode: Callable[[Mode], None], lift: Callable[[int], None]
    ) -> None:
        self._pipeline, self._component = pipeline, component
        self._set_mode, self._lift_motor = set_mode, lift
        self._system = 1
        self._table = {
            "NFF_MODE": _Parameter(0, 2, lambda: float(pipeline.mode), self._mode),
            "NFF_LIFT": _Parameter(0, pipeline.vehicle.motors, lambda: 0.0, self._lift),
            "NFF_IMPROVEMENT": self._threshold("improvement_min", 8.0, 200.0),
            "NFF_MARGIN": self._threshold("margin_min", 2.0, 100.0),
            "NFF_EXPLAINED": self._threshold("explained_min", 0.5, 0.99),
            "NFF_LOSS_SUDDEN": self._threshold("loss_sudden", 0.3, 0.95),
            "NFF_LOSS_SLOW": self._threshold("loss_gradual", 0.3, 0.95),
            "NFF_FAILED_MAX": self._threshold("failed_max", 1, pipeline.vehicle.motors // 2, whole=True),
        }
        self.refused = 0

    def adopt(self, system: int) -> None:
        """Answer for this system."""
        self._system = system

    def _mode(self, value: float) -> bool:
        self._set_mode(Mode(int(value)))
        return True

    def _lift(self, value: float) -> bool:
        if value >= 1:
            self._lift_motor(int(value))
        return True

    def _threshold(self, name: str, low: float, high: float, *, whole: bool = False) -> _Parameter:
        def get() -> float:
            return float(getattr(self._pipeline.options.estimator.decision, name))

        def change(value: float) -> bool:
            options = self._pipeline.options.estimator
            decision = msgspec.structs.replace(options.decision, **{name: int(value) if whole else value})
            return self._pipeline.retune(msgspec.structs.replace(options, decision=decision))

        return _Parameter(low, high, get, change)

    def value(self, name: str) -> Message:
        """PARAM_VALUE of one parameter."""
        names = list(self._table)
        return dialect.MAVLink_param_value_message(
            name.encode(), self._table[name].get(), _REAL, len(names), names.index(name)
        )

    def answer(self, message: Message) -> list[Message]:
        """Answer to a PARAM_* message; nothing when it is not for us."""
        component = getattr(message, "target_component", -1)
        if getattr(message, "target_system", -1) not in (0, self._system):
            return []
        kind = message.get_type()
        if kind == "PARAM_REQUEST_LIST" and component in (0, self._component):
            return [self.value(name) for name in self._table]
        if component != self._component:
            return []
        if kind == "PARAM_REQUEST_READ":
            names = list(self._table)
            index = message.param_index
            name = names[index] if 0 <= index < len(names) else name_of(message)
            return [self.value(name)] if name in self._table else []
        if kind == "PARAM_SET" and name_of(message) in self._table:
            return [self._change(name_of(message), float(message.param_value))]
        return []

    def _change(self, name: str, value: float) -> Message:
        parameter = self._table[name]
        if not math.isfinite(value) or not parameter.low <= value <= parameter.high or not parameter.set(value):
            self.refused += 1
        return self.value(name)
