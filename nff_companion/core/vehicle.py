"""The airframe as the companion knows it: rotors, mass, inertia, and the effectiveness matrix B0.

FRD body frame, SI units. Motors are rows of ``[[rotor]]`` in the TOML file, numbered from 1 at every interface and
from index 0 in arrays. Axes of the wrench, in this order: thrust (up), roll, pitch, yaw (6.1).
"""

from __future__ import annotations

import hashlib
import math
from functools import cached_property
from importlib import resources
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core import toml_file
from nff_companion.core.airframe_file import (
    GRAVITY_M_S2,
    MOTORS_MAX,
    AirframeFile,
    LogTable,
    TelemetryTable,
    fault_of,
    rotors,
    with_thrust_to_weight,
)
from nff_companion.core.tuning.span import shown
from nff_companion.errors import ConfigError

__all__ = [
    "AXES",
    "GRAVITY_M_S2",
    "MOTORS_MAX",
    "PITCH",
    "ROLL",
    "THRUST",
    "THRUST_TO_WEIGHT",
    "YAW",
    "LogTable",
    "TelemetryTable",
    "Vehicle",
    "load",
    "names",
    "path_of",
]

THRUST_TO_WEIGHT = (1.06, 19.9)  # of vehicles that fly: hover between 0.05 and 0.95 of all thrust
AXES = ("thrust", "roll", "pitch", "yaw")
THRUST, ROLL, PITCH, YAW = range(4)


class Vehicle:
    """Immutable model of one airframe. n axes, m motors."""

    def __init__(self, data: AirframeFile) -> None:
        self.name = data.airframe.name
        self.network, self.confirmed = data.airframe.network, data.airframe.confirmed
        self.mass_kg = data.airframe.mass_kg
        self.inertia_kg_m2 = np.array(data.airframe.inertia_kg_m2)
        self.motor, self.command, self.telemetry, self.log = data.motor, data.command, data.telemetry, data.log
        self.rotors = rotors(data)
        self.inertia_kg_m2.flags.writeable = False

    @property
    def position_m(self) -> NDArray[np.float64]:
        """(m, 2) x forward, y right of the centre of mass."""
        return self.rotors.place_m[:, :2]

    @property
    def hub_position_m(self) -> NDArray[np.float64]:
        """(m, 2) x forward, y right of the middle of the frame, where a firmware's mixer has its centre."""
        return self.rotors.hub_m[:, :2]

    @property
    def spin(self) -> NDArray[np.float64]:
        """(m,) sign of the torque on the airframe about +z: +1 of a rotor that turns ccw seen from above."""
        return self.rotors.spin

    @property
    def motors(self) -> int:
        """m."""
        return len(self.spin)

    @property
    def axes(self) -> int:
        """n."""
        return len(AXES)

    @cached_property
    def effectiveness_si(self) -> NDArray[np.float64]:
        """B0 (n, m): N and N m for thrust fraction 1 of each motor."""
        return self.rotors.effectiveness_si(self.mass_kg, self.inertia_kg_m2)

    @cached_property
    def acceleration_effectiveness(self) -> NDArray[np.float64]:
        """B0 over mass and inertia (n, m): upward specific force m/s^2 and angular accelerations rad/s^2."""
        scale = np.concatenate([[self.mass_kg], self.inertia_kg_m2])
        return self.effectiveness_si / scale[:, None]

    @cached_property
    def thrust_norm(self) -> float:
        """Length of the thrust row of ``acceleration_effectiveness``, m/s^2."""
        return float(np.linalg.norm(self.acceleration_effectiveness[THRUST]))

    @cached_property
    def row_scale(self) -> NDArray[np.float64]:
        """(n,) sum of the positive entries of each row of B0 in SI: what 1 means in normalised units."""
        return np.maximum(self.effectiveness_si, 0.0).sum(axis=1)

    @cached_property
    def effectiveness(self) -> NDArray[np.float64]:
        """B0 (n, m) with each row over the sum of its positive entries: the normalised units of all allocation."""
        return self.effectiveness_si / self.row_scale[:, None]

    @cached_property
    def normalised_per_acceleration(self) -> NDArray[np.float64]:
        """(n,) what 1 m/s^2 or rad/s^2 is in normalised units."""
        return np.concatenate([[self.mass_kg], self.inertia_kg_m2]) / self.row_scale

    @cached_property
    def full_thrust_n(self) -> float:
        """Upward force of all motors at full output."""
        one = self.motor.max_thrust_n
        return float((self.effectiveness_si[THRUST] / one).sum()) * one  # alike rotors: exactly so many times one

    @property
    def hover(self) -> float:
        """h: weight over the thrust of all motors."""
        return self.mass_kg * GRAVITY_M_S2 / self.full_thrust_n

    @cached_property
    def lag_s(self) -> tuple[float, float]:
        """Time constants up and down where one must do for all rotors: those of the middle one."""
        return float(np.median(self.rotors.time_constant_up_s)), float(np.median(self.rotors.time_constant_down_s))

    @property
    def fingerprint(self) -> str:
        """Of what makes the motion: B0 in accelerations, lags, command table. The same to a thousandth: the same."""
        matrix, c = self.acceleration_effectiveness, self.command
        numbers = [
            (matrix / np.abs(matrix).max(axis=1, keepdims=True)).ravel(),
            np.log(np.abs(matrix).max(axis=1)),
            10.0 * self.rotors.time_constant_up_s,
            10.0 * self.rotors.time_constant_down_s,
            np.array([c.thrust_expo, c.spin_min, c.spin_max, 1e-3 * c.pwm_min, 1e-3 * c.pwm_max]),
        ]
        rounded = np.round(np.concatenate(numbers), 3) + 0.0  # no minus nought
        return hashlib.sha256(rounded.astype("<f8").tobytes()).hexdigest()[:16]

    def thrust_fraction(self, output: NDArray[np.float64]) -> NDArray[np.float64]:
        """Thrust fraction u of motor outputs in 0..1 (command to thrust curve)."""
        c = self.command
        ratio = np.minimum(np.maximum((output - c.spin_min) / (c.spin_max - c.spin_min), 0.0), 1.0)
        return ratio * ((1.0 - c.thrust_expo) + c.thrust_expo * ratio)

    def output_for(self, thrust_fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Motor outputs (m,) 0..1 for thrust fractions (m,), the inverse of ``thrust_fraction`` above idle."""
        idle, e = self.command.spin_min, self.command.thrust_expo
        span = self.command.spin_max - idle
        limited = thrust_fraction.tolist()
        if not (min(limited) >= 0.0 and max(limited) <= 1.0):
            limited = [min(max(u, 0.0), 1.0) for u in limited]
        if e == 0.0:
            return np.array([idle + span * u for u in limited])
        # (1 - e) r + e r^2 = u; in plain numbers, which takes half the time of arrays for so few.
        linear = 1.0 - e
        square, four, half = linear * linear, 4.0 * e, span / (2.0 * e)
        return np.array([idle + half * (math.sqrt(square + four * u) - linear) for u in limited])

    def output_of_pwm(self, pwm_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Motor output 0..1 of a pulse width."""
        c = self.command
        return np.minimum(np.maximum((pwm_us - c.pwm_min) / (c.pwm_max - c.pwm_min), 0.0), 1.0)

    def with_telemetry(self, telemetry: TelemetryTable) -> Vehicle:
        """The same airframe behind other filters. The delay of the outputs stays: it is no filter's."""
        other = object.__new__(Vehicle)
        other.__dict__.update(self.__dict__)
        other.telemetry = msgspec.structs.replace(telemetry, output_delay_s=self.telemetry.output_delay_s)
        return other

    def renumbered(self, quarter_turns: int) -> Vehicle:
        """The same airframe with its nose turned by quarter turns and its motors numbered on by as many places.

        For checks that nothing depends on where the nose is or which motor is the first.
        """
        other = object.__new__(Vehicle)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if not isinstance(v, np.ndarray)})
        other.rotors = self.rotors.turned(quarter_turns)
        other.network = ""  # trained with the nose where it was
        inertia = self.inertia_kg_m2
        other.inertia_kg_m2 = inertia[[1, 0, 2]] if quarter_turns % 2 else inertia.copy()
        return other


def names() -> list[str]:
    """Airframes shipped with the package."""
    folder = resources.files("nff_companion") / "airframes"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def path_of(name: str) -> Path:
    """File of a shipped airframe, or ``name`` itself when it is a path to a TOML file. Raises ConfigError."""
    if name.endswith(".toml"):
        return Path(name)
    if name not in names():
        raise ConfigError(
            f"airframe {shown(name)} is unknown: give a path to a .toml file or one of {', '.join(names())}"
        )
    return Path(str(resources.files("nff_companion") / "airframes" / f"{name}.toml"))


def load(name: str, *, thrust_to_weight: float | None = None) -> Vehicle:
    """Airframe by shipped name or path; ``thrust_to_weight`` replaces its maximum thrust.

    Raises ConfigError naming file, key, value and what is allowed, for any file whatever.
    """
    path = path_of(name)
    data = toml_file.read(path, AirframeFile, "airframe file")
    if thrust_to_weight is not None:
        low, high = THRUST_TO_WEIGHT
        if not low <= thrust_to_weight <= high:
            raise ConfigError(f"thrust_to_weight = {shown(thrust_to_weight)}: from {low} to {high} is allowed")
        data = with_thrust_to_weight(data, thrust_to_weight)
    fault = fault_of(data)
    if fault is not None:
        raise ConfigError(f"airframe file {path}: {fault}")
    if data.airframe.network.endswith(".npz"):  # beside the airframe file, unless absolute
        network = str(path.parent / data.airframe.network)
        data = msgspec.structs.replace(data, airframe=msgspec.structs.replace(data.airframe, network=network))
    return Vehicle(data)
