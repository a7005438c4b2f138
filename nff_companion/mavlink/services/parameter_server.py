"""Parameters by MAVLink's parameter protocol: a ground station lists, reads and sets what it is given here."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from nff_companion.errors import ConfigError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import name_of

_REAL = dialect.MAV_PARAM_TYPE_REAL32
_NAME_MAX = 16


@dataclass(frozen=True)
class Parameter:
    """One value within ``low``..``high``; ``set`` answers whether it was taken; ``whole``: whole numbers alone.

    Raises ConfigError for a name that the wire does not carry.
    """

    name: str
    low: float
    high: float
    get: Callable[[], float]
    set: Callable[[float], bool]
    whole: bool = False

    def __post_init__(self) -> None:
        if not (1 <= len(self.name) <= _NAME_MAX and self.name.isascii() and self.name.isprintable()):
            raise ConfigError(f"parameter {self.name!r}: 1 to {_NAME_MAX} ASCII characters are allowed")

    def take(self, value: float) -> bool:
        """Set ``value`` as it came from the wire, where a bound like 0.99 is another number; False: refused."""
        if not math.isfinite(value) or not _as_sent(self.low) <= value <= _as_sent(self.high):
            return False
        if self.whole and value != round(value):
            return False
        exact = {_as_sent(bound): bound for bound in (self.low, self.high)}
        return self.set(exact.get(value, value))


class ParameterServer:
    """Values are those in use; a refused change is answered with the value that stays."""

    def __init__(self, parameters: list[Parameter], component: int) -> None:
        """``component``: our MAVLink component id. Raises ConfigError when two parameters have one name."""
        self._table = {parameter.name: parameter for parameter in parameters}
        if len(self._table) != len(parameters):
            raise ConfigError("two parameters have the same name: " + ", ".join(p.name for p in parameters))
        self._component, self._system = component, 1
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
        if not self._table[name].take(value):
            self.refused += 1
        return self.value(name)


def _as_sent(value: float) -> float:
    """The nearest number that the wire carries."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])
