"""Shipped airframes with their frames of the firmwares, and the same with what an airframe file may have wrong."""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.frames import catalogue
from nff_companion.frames.servo_functions import function_of

SHIPPED = {
    "arducopter-octa-x": "octo-x",
    "coax-x8": "coax-x8",
    "h250": "quad-x-clockwise",
    "hexa-x": "hexa-x",
    "octo-plus": "octo-plus",
    "octo-x": "octo-x",
    "px4-octo-x": "octo-x",
}
OWN = {"paper-octo"}  # two columns of four: no frame of either firmware
PAIRS = list(SHIPPED.items())


def altered(
    loaded: Vehicle, place: NDArray[np.float64] | None = None, spin: NDArray[np.float64] | None = None
) -> Vehicle:
    """``loaded`` with other places (m, 2) or spins (m,)."""
    other = copy.copy(loaded)
    for name in ("effectiveness_si", "acceleration_effectiveness", "effectiveness", "row_scale", "thrust_norm"):
        other.__dict__.pop(name, None)  # of the other places
    where = loaded.rotors.place_m if place is None else np.hstack([place, np.zeros((len(place), 1))])
    other.rotors = replace(loaded.rotors, place_m=where, hub_m=where, spin=loaded.spin if spin is None else spin)
    return other


def swapped(loaded: Vehicle, one: int, other: int) -> Vehicle:
    """Two motors (from 0) have each other's number."""
    order = np.arange(loaded.motors)
    order[[one, other]] = other, one
    return altered(loaded, loaded.position_m[order], loaded.spin[order])


def wrong_files(loaded: Vehicle) -> dict[str, Vehicle]:
    """What is wrong, and the file: all spins, and every two motors."""
    out = {"all spins": altered(loaded, spin=-loaded.spin)}
    for one, other in combinations(range(loaded.motors), 2):
        out[f"{one + 1} and {other + 1}"] = swapped(loaded, one, other)
    return out


def parameters_of(name: str, frame: tuple[int, int] | None = None) -> dict[str, float]:
    """All that is looked at of an ArduPilot that flies a shipped airframe, or ``frame``: FRAME_CLASS, FRAME_TYPE."""
    loaded = vehicle.load(name)
    frame_class, frame_type = frame or catalogue.by_name(SHIPPED[name]).ardupilot[0]
    command = loaded.command
    return {
        "FRAME_CLASS": frame_class,
        "FRAME_TYPE": frame_type,
        "MOT_THST_EXPO": command.thrust_expo,
        "MOT_SPIN_MIN": command.spin_min,
        "MOT_SPIN_MAX": command.spin_max,
        "MOT_PWM_MIN": command.pwm_min,
        "MOT_PWM_MAX": command.pwm_max,
        "SCR_ENABLE": 1.0,
        "FLIGHT_OPTIONS": 4.0,
        "INS_GYRO_FILTER": 20.0,
        "INS_ACCEL_FILTER": 20.0,
        **{f"SERVO{motor}_FUNCTION": float(function_of(motor)) for motor in range(1, loaded.motors + 1)},
    }
