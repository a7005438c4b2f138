"""The airframe as the companion knows it: rotors, mass, inertia, and the effectiveness matrix B0.

FRD body frame, SI units. Motors are rows of ``[[rotor]]`` in the TOML file, numbered from 1 at every interface and
from index 0 in arrays. Axes of the wrench, in this order: thrust (up), roll, pitch, yaw (6.1).
"""

from __future__ import annotations

import math
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from nff_companion.errors import ConfigError

GRAVITY_M_S2 = 9.80665
AXES = ("thrust", "roll", "pitch", "yaw")
MOTORS_MAX = 12  # a matrix of 12 rows and 4 columns fills one message
THRUST, ROLL, PITCH, YAW = range(4)

Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]


class AirframeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[airframe]``."""

    name: str
    source: str
    mass_kg: Positive
    inertia_kg_m2: tuple[Positive, Positive, Positive]
    network: str = ""  # basis network: a shipped name or a file beside this one; empty: a constant basis


class MotorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[motor]``, the same for all rotors. Inertia and speed of the rotor are the plant's alone."""

    max_thrust_n: Positive
    time_constant_up_s: NotNegative
    time_constant_down_s: NotNegative
    torque_per_thrust_m: NotNegative
    rotor_inertia_kg_m2: NotNegative = 0.0
    max_speed_rad_s: Positive = 1000.0


class CommandTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[command]``: from motor output to thrust."""

    thrust_expo: Fraction
    spin_min: Fraction
    spin_max: Fraction
    pwm_min: float
    pwm_max: float


class TelemetryTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[telemetry]``: low-pass filters of the autopilot on what it sends (second order; 0: none)."""

    gyro_filter_hz: NotNegative
    accelerometer_filter_hz: NotNegative


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[log]``: where a ULog keeps the motor commands, when not in ``actuator_outputs``.

    ``field`` has ``{}`` for the motor's index from 0; ``unit`` N: thrust; output: 0..1; pwm: microseconds.
    """

    topic: str
    field: str
    unit: Literal["N", "output", "pwm"] = "pwm"


class RotorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[rotor]]``: either angle (clockwise from the nose) and arm, or x forward and y right."""

    spin: Literal["cw", "ccw"]
    angle_deg: float | None = None
    arm_m: Positive | None = None
    x_m: float | None = None
    y_m: float | None = None

    def position_m(self) -> tuple[float, float]:
        """(x, y). Raises ConfigError when neither form is complete."""
        if self.angle_deg is not None and self.arm_m is not None:
            angle = math.radians(self.angle_deg)
            return self.arm_m * math.cos(angle), self.arm_m * math.sin(angle)
        if self.x_m is not None and self.y_m is not None:
            return self.x_m, self.y_m
        raise ConfigError("a [[rotor]] needs angle_deg and arm_m, or x_m and y_m")


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    airframe: AirframeTable
    motor: MotorTable
    command: CommandTable
    telemetry: TelemetryTable
    rotor: list[RotorTable]
    aerodynamics: dict[str, object] = {}
    log: LogTable | None = None


class Vehicle:
    """Immutable model of one airframe. n axes, m motors."""

    def __init__(self, data: _File) -> None:
        self.name = data.airframe.name
        self.network = data.airframe.network
        self.mass_kg = data.airframe.mass_kg
        self.inertia_kg_m2 = np.array(data.airframe.inertia_kg_m2)
        self.motor, self.command, self.telemetry, self.log = data.motor, data.command, data.telemetry, data.log
        self.position_m = np.array([r.position_m() for r in data.rotor])  # (m, 2)
        self.spin = np.array([1.0 if r.spin == "ccw" else -1.0 for r in data.rotor])  # (m,) sign of the yaw torque
        if not self.command.spin_max > self.command.spin_min:
            raise ConfigError(f"{self.name}: command.spin_max must be above command.spin_min")
        for array in (self.inertia_kg_m2, self.position_m, self.spin):
            array.flags.writeable = False

    @property
    def motors(self) -> int:
        """m."""
        return len(self.spin)

    @property
    def axes(self) -> int:
        """n."""
        return len(AXES)

    @cached_property
    def effectiveness_si(self) -> np.ndarray:
        """B0 (n, m): N and N m for thrust fraction 1 of each motor. A rotor at (x, y) pushing up by F gives roll
        torque -y F and pitch torque x F in FRD."""
        x, y = self.position_m.T
        rows = np.stack([np.ones_like(x), -y, x, self.motor.torque_per_thrust_m * self.spin])
        return rows * self.motor.max_thrust_n

    @cached_property
    def acceleration_effectiveness(self) -> np.ndarray:
        """B0 over mass and inertia (n, m): upward specific force m/s^2 and angular accelerations rad/s^2."""
        scale = np.concatenate([[self.mass_kg], self.inertia_kg_m2])
        return self.effectiveness_si / scale[:, None]

    @cached_property
    def thrust_norm(self) -> float:
        """Length of the thrust row of ``acceleration_effectiveness``, m/s^2."""
        return float(np.linalg.norm(self.acceleration_effectiveness[THRUST]))

    @cached_property
    def row_scale(self) -> np.ndarray:
        """(n,) sum of the positive entries of each row of B0 in SI: what 1 means in normalised units."""
        return np.maximum(self.effectiveness_si, 0.0).sum(axis=1)

    @cached_property
    def effectiveness(self) -> np.ndarray:
        """B0 (n, m) with each row over the sum of its positive entries: the normalised units of all allocation."""
        return self.effectiveness_si / self.row_scale[:, None]

    @cached_property
    def normalised_per_acceleration(self) -> np.ndarray:
        """(n,) what 1 m/s^2 or rad/s^2 is in normalised units."""
        return np.concatenate([[self.mass_kg], self.inertia_kg_m2]) / self.row_scale

    @property
    def hover(self) -> float:
        """h: weight over the thrust of all motors."""
        return self.mass_kg * GRAVITY_M_S2 / (self.motors * self.motor.max_thrust_n)

    def thrust_fraction(self, output: np.ndarray) -> np.ndarray:
        """Thrust fraction u of motor outputs in 0..1 (command to thrust curve)."""
        c = self.command
        ratio = np.minimum(np.maximum((output - c.spin_min) / (c.spin_max - c.spin_min), 0.0), 1.0)
        return ratio * ((1.0 - c.thrust_expo) + c.thrust_expo * ratio)

    def output_for(self, thrust_fraction: np.ndarray) -> np.ndarray:
        """Motor output 0..1 for a thrust fraction, the inverse of ``thrust_fraction`` above idle."""
        c, u = self.command, np.minimum(np.maximum(thrust_fraction, 0.0), 1.0)
        e = c.thrust_expo
        ratio = u if e == 0.0 else (np.sqrt((1.0 - e) ** 2 + 4.0 * e * u) - (1.0 - e)) / (2.0 * e)
        return c.spin_min + (c.spin_max - c.spin_min) * ratio

    def output_of_pwm(self, pwm_us: np.ndarray) -> np.ndarray:
        """Motor output 0..1 of a pulse width."""
        c = self.command
        return np.clip((pwm_us - c.pwm_min) / (c.pwm_max - c.pwm_min), 0.0, 1.0)

    def with_telemetry(self, telemetry: TelemetryTable) -> Vehicle:
        """The same airframe behind other filters."""
        other = object.__new__(Vehicle)
        other.__dict__.update(self.__dict__)
        other.telemetry = telemetry
        return other

    def renumbered(self, quarter_turns: int) -> Vehicle:
        """The same airframe with its nose turned by quarter turns and its motors numbered on by as many places.

        For checks that nothing depends on where the nose is or which motor is the first.
        """
        other = object.__new__(Vehicle)
        other.__dict__.update({k: v for k, v in self.__dict__.items() if not isinstance(v, np.ndarray)})
        c, s = round(math.cos(quarter_turns * math.pi / 2)), round(math.sin(quarter_turns * math.pi / 2))
        other.position_m = np.roll(self.position_m @ np.array([[c, s], [-s, c]]), quarter_turns, axis=0)
        other.spin = np.roll(self.spin, quarter_turns)
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
        raise ConfigError(f"airframe {name!r} is unknown: give a path to a .toml file or one of {', '.join(names())}")
    return Path(str(resources.files("nff_companion") / "airframes" / f"{name}.toml"))


def load(name: str, *, thrust_to_weight: float | None = None) -> Vehicle:
    """Airframe by shipped name or path; ``thrust_to_weight`` replaces its maximum thrust. Raises ConfigError."""
    path = path_of(name)
    try:
        data = msgspec.toml.decode(path.read_bytes(), type=_File)
    except OSError as error:
        raise ConfigError(f"airframe file {path} cannot be read: {error.strerror}") from error
    except (msgspec.ValidationError, msgspec.DecodeError) as error:
        raise ConfigError(f"airframe file {path}: {error}") from error
    if not 3 <= len(data.rotor) <= MOTORS_MAX:
        raise ConfigError(
            f"airframe file {path} has {len(data.rotor)} rotors; between 3 and {MOTORS_MAX} can be handled"
        )
    if thrust_to_weight is not None:
        thrust = thrust_to_weight * data.airframe.mass_kg * GRAVITY_M_S2 / len(data.rotor)
        data = msgspec.structs.replace(data, motor=msgspec.structs.replace(data.motor, max_thrust_n=thrust))
    if data.airframe.network.endswith(".npz"):  # beside the airframe file, unless absolute
        network = str(path.parent / data.airframe.network)
        data = msgspec.structs.replace(data, airframe=msgspec.structs.replace(data.airframe, network=network))
    return Vehicle(data)
