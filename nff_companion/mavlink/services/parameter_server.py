"""Parameters of the companion by MAVLink's parameter protocol: a ground station sets mode and thresholds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import name_of

_REAL = dialect.MAV_PARAM_TYPE_REAL32


@dataclass(frozen=True)
class Parameter:
    """One of them; ``set`` returns False when it refuses now."""

    name: str
    low: float
    high: float
    get: Callable[[], float]
    set: Callable[[float], bool]
    whole: bool = False


class ParameterServer:
    """Values are those in use; a refused change is answered with the value that stays."""

    def __init__(self, parameters: list[Parameter], component: int) -> None:
        self._table = {parameter.name: parameter for parameter in parameters}
        self._component = component
        self._system = 1
        self.refused = 0

    def adopt(self, system: int) -> None:
        """Answer for this system."""
        self._system = system

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
        p = self._table[name]
        whole = int(value) if p.whole and math.isfinite(value) else value
        if not math.isfinite(value) or not p.low <= value <= p.high or not p.set(whole):
            self.refused += 1
        return self.value(name)
