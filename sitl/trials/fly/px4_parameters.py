"""A vehicle's parameters as PX4 in SITL takes them from its environment at boot.

PX4 sets them before it runs the airframe's start script (ROMFS init.d-posix/rcS). ``param set`` to a parameter's
default leaves nothing behind (parameters.cpp), and ``param set-default`` of the start script then wins: a value that
equals the default must never be relied upon.
"""

from __future__ import annotations

import math
import re

from nff_companion.core.vehicle import Vehicle

_PREFIX = "PX4_PARAM_"
_ROTOR_DEFAULTS = {"PX": 0.0, "PY": 0.0, "PZ": 0.0, "AX": 0.0, "AY": 0.0, "AZ": -1.0, "CT": 6.5, "KM": 0.05}
# Of the sources of v1.16. Start script 10016_none_iris sets rotors, their number and their outputs, and no other.
_DEFAULTS: dict[str, float] = {
    "CA_ROTOR_COUNT": 0,
    "MAV_TYPE": 0,
    "THR_MDL_FAC": 0.0,
    "MPC_THR_HOVER": 0.5,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_TKO_SPEED": 1.5,
    "COM_RC_IN_MODE": 3,
    "NAV_RCL_ACT": 2,
    "COM_DISARM_LAND": 2.0,
    "CBRK_SUPPLY_CHK": 0,
    "COM_ARM_SDCARD": 1,
    "COM_ARM_HFLT_CHK": 1,
}
_APART = 1e-4  # m of a place, m of a drag: nothing to the vehicle, and not the default
_KINDS = {4: 2, 6: 13, 8: 14}  # MAV_TYPE by motors
_OTHER_KIND = 13  # PX4 knows no kinds with more rotors


def default_of(name: str) -> float:
    """PX4's default of a parameter that we set. Raises KeyError for another."""
    if (match := re.fullmatch(r"CA_ROTOR\d+_(\w\w)", name)) is not None:
        return _ROTOR_DEFAULTS[match.group(1)]
    return 0 if re.fullmatch(r"PWM_MAIN_FUNC\d+", name) else _DEFAULTS[name]


def _apart(value: float, suffix: str) -> float:
    """``value`` of a rotor, moved by a negligible 0.1 mm where it would give way to the start script's."""
    default = _ROTOR_DEFAULTS[suffix]
    return value if abs(value - default) >= _APART else default + math.copysign(_APART, value - default)


def parameters(vehicle: Vehicle, height_m: float) -> dict[str, str]:
    """Environment of a PX4 that is this vehicle and takes off to ``height_m``."""
    values: dict[str, float] = {
        "CA_ROTOR_COUNT": vehicle.motors,
        "MAV_TYPE": _KINDS.get(vehicle.motors, _OTHER_KIND),
        "THR_MDL_FAC": vehicle.command.thrust_expo,
        "MPC_THR_HOVER": round(vehicle.hover, 3),
        "MIS_TAKEOFF_ALT": height_m,
        "MPC_TKO_SPEED": 3.0,
        "COM_RC_IN_MODE": 4,
        "NAV_RCL_ACT": 0,
        "COM_DISARM_LAND": 5.0,
        "CBRK_SUPPLY_CHK": 894281,
        "COM_ARM_SDCARD": 0,
        "COM_ARM_HFLT_CHK": 0,
    }
    # No start script touches these: one that has its default needs no word, and keeps it.
    values = {name: value for name, value in values.items() if value != default_of(name)}
    for i in range(vehicle.motors):
        rotor = {
            "PX": round(float(vehicle.position_m[i, 0]), 4),
            "PY": round(float(vehicle.position_m[i, 1]), 4),
            "KM": vehicle.motor.torque_per_thrust_m * float(vehicle.spin[i]),
        }
        values |= {f"CA_ROTOR{i}_{suffix}": _apart(value, suffix) for suffix, value in rotor.items()}
        values[f"PWM_MAIN_FUNC{i + 1}"] = 101 + i
    return {f"{_PREFIX}{name}": str(value) for name, value in values.items()}
