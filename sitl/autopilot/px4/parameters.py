"""PX4's parameters: typed, with the bytes of an integer in the float of the wire, and the stock values of v1.16."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

from nff_companion.mavlink.codec import Message, dialect
from sitl.airframe import GRAVITY_M_S2, PlantParameters

REAL, WHOLE = int(dialect.MAV_PARAM_TYPE_REAL32), int(dialect.MAV_PARAM_TYPE_INT32)
FIRST_MOTOR = 101  # PWM_MAIN_FUNCn of motor 1
_THRUST, _MOMENT = 6.5, 0.05  # CA_ROTORn_CT and _KM that nobody has set
_DISARMED_US = 900
_KINDS = {4: dialect.MAV_TYPE_QUADROTOR, 6: dialect.MAV_TYPE_HEXAROTOR, 8: dialect.MAV_TYPE_OCTOROTOR}  # by motors
_OTHER_KIND = dialect.MAV_TYPE_HEXAROTOR  # PX4 knows no kinds with more rotors
_INTEGER = struct.Struct("<i")
_FLOAT = struct.Struct("<f")
_MOST = 2**31


def stock(nominal: PlantParameters, hover: float, system: int) -> dict[str, float | int]:
    """As an owner has set them for this airframe; integers are int. ``hover``: thrust fraction of MPC_THR_HOVER."""
    values: dict[str, float | int] = {
        "SYS_AUTOSTART": 0,
        "SYS_FAILURE_EN": 0,
        "MAV_SYS_ID": system,
        "MAV_TYPE": int(_KINDS.get(nominal.motors, _OTHER_KIND)),
        "CA_AIRFRAME": 0,
        "CA_METHOD": 2,
        "CA_FAILURE_MODE": 0,
        "CA_R_REV": 0,
        "CA_ROTOR_COUNT": nominal.motors,
        "FD_ACT_EN": 1,
        "MC_AIRMODE": 0,
        "THR_MDL_FAC": float(nominal.thrust_expo[0]),
        "MPC_THR_HOVER": round(hover, 3),
        "IMU_INTEG_RATE": 200,
        "IMU_GYRO_CUTOFF": 40.0,
        "IMU_DGYRO_CUTOFF": 30.0,
        "IMU_ACCEL_CUTOFF": 30.0,
    }
    for i, (x, y) in enumerate(nominal.frame_m.round(4).tolist()):
        rotor: dict[str, float | int] = {"PX": x, "PY": y, "PZ": 0.0, "AX": 0.0, "AY": 0.0, "AZ": -1.0}
        rotor |= {"CT": _THRUST, "KM": _MOMENT * float(nominal.spin[i]), "TILT": 0}
        values |= {f"CA_ROTOR{i}_{suffix}": value for suffix, value in rotor.items()}
    for output in range(1, nominal.motors + 1):
        values[f"PWM_MAIN_FUNC{output}"] = FIRST_MOTOR - 1 + output
        values[f"PWM_MAIN_DIS{output}"] = _DISARMED_US
        values[f"PWM_MAIN_MIN{output}"] = round(nominal.pwm_min)
        values[f"PWM_MAIN_MAX{output}"] = round(nominal.pwm_max)
    return values | {f"PWM_MAIN_TIM{group}": 400 for group in range(4)}


def hover_of(nominal: PlantParameters) -> float:
    """Weight over the thrust of all motors, as an owner would have set it."""
    return float(nominal.mass_kg[0] * GRAVITY_M_S2 / nominal.lift_n[0])


def as_whole(value: float) -> int:
    """The integer in the bytes of a float of the wire."""
    return int(_INTEGER.unpack(_FLOAT.pack(value))[0])


class ParameterTable:
    """``changes`` counts what was set. Values are kept as PX4 keeps them, in 32 bits."""

    def __init__(self, values: Mapping[str, float | int]) -> None:
        self._kinds = {name: WHOLE if isinstance(value, int) else REAL for name, value in values.items()}
        self._values = {name: _stored(value, self._kinds[name]) for name, value in values.items()}
        self.names = sorted(values)
        self.changes = 0

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def whole(self, name: str) -> int:
        """Value of an integer."""
        return int(self._values[name])

    def set(self, name: str, value: float) -> None:
        """Raises KeyError for an unknown name."""
        self._values[name] = _stored(value, self._kinds[name])
        self.changes += 1

    def take(self, name: str, value: float, kind: int) -> bool:
        """A PARAM_SET, its ``value`` as it came; whether it was taken: known, of the right type, and a number.

        Stock firmware does not look for NaN; here none gets to the loops that fly.
        """
        if name not in self._values or kind != self._kinds[name]:
            return False
        meant = as_whole(value) if kind == WHOLE else value
        if not math.isfinite(meant):
            return False
        self.set(name, meant)
        return True

    def message(self, name: str) -> Message | None:
        """PARAM_VALUE, None when there is no such parameter."""
        if name not in self._values:
            return None
        kind, value = self._kinds[name], self._values[name]
        sent = _FLOAT.unpack(_INTEGER.pack(int(value)))[0] if kind == WHOLE else value
        index = self.names.index(name)
        return dialect.MAVLink_param_value_message(name.encode(), sent, kind, len(self.names), index)

    def unknown(self, name: str) -> list[Message]:
        """What is said to who sets a parameter that is not there: a text. PARAM_ERROR is of later versions."""
        return [dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_INFO, f"[pm] unknown param: {name}".encode())]


def _stored(value: float, kind: int) -> float:
    if kind == REAL:
        return float(_FLOAT.unpack(_FLOAT.pack(value))[0])
    return float(max(-_MOST, min(_MOST - 1, round(value))))
