"""Parameters of the emulated autopilot as ArduPilot has them: numbers by name, all of one type on the wire."""

from __future__ import annotations

import math
from typing import Protocol

from nff_companion.mavlink.codec import Message, dialect
from sitl.airframe import PlantParameters


class Parameters(Protocol):
    """What is asked of any autopilot's."""

    @property
    def names(self) -> list[str]:
        """Of all, in the order of their indices."""

    def take(self, name: str, value: float, kind: int) -> bool:
        """A PARAM_SET, its ``value`` and MAV_PARAM_TYPE as they came; whether it was taken."""

    def message(self, name: str) -> Message | None:
        """PARAM_VALUE, None when there is no such parameter."""

    def unknown(self, name: str) -> list[Message]:
        """What is said to who sets a parameter that is not there."""


class FloatParameters:
    """``values`` by name may be shared with who flies by them."""

    def __init__(self, values: dict[str, float]) -> None:
        self.values = values

    @property
    def names(self) -> list[str]:
        """Of all, in the order of their indices."""
        return list(self.values)

    def take(self, name: str, value: float, kind: int) -> bool:
        """Whether ``name`` took ``value``: it is there, and the value is a number."""
        if name not in self.values or not math.isfinite(value):
            return False
        self.values[name] = float(value)
        return True

    def message(self, name: str) -> Message | None:
        """PARAM_VALUE, None when there is no such parameter."""
        if name not in self.values:
            return None
        index, kind = self.names.index(name), dialect.MAV_PARAM_TYPE_REAL32
        return dialect.MAVLink_param_value_message(name.encode(), self.values[name], kind, len(self.values), index)

    def unknown(self, name: str) -> list[Message]:
        """Nothing."""
        return []


def stock(nominal: PlantParameters, system: int) -> dict[str, float]:
    """As an ArduPilot with a scripted frame has them."""
    return {
        "SYSID_THISMAV": float(system),
        "FRAME_CLASS": 17.0,
        "FRAME_TYPE": 1.0,
        "MOT_THST_EXPO": float(nominal.thrust_expo[0]),
        "MOT_SPIN_MIN": float(nominal.spin_min[0]),
        "MOT_SPIN_MAX": nominal.spin_max,
        "INS_GYRO_FILTER": float(nominal.gyro_filter_hz[0]),
        "WPNAV_SPEED": 500.0,
        "SIM_SPEEDUP": 1.0,
    }
