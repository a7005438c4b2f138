"""The airframe file: its tables, and what makes a vehicle that can fly. SI units, FRD body frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations
from typing import Annotated, Any, Literal

import daqp
import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.toml_file import Name, Text
from nff_companion.core.tuning.span import span

GRAVITY_M_S2 = 9.80665
MOTORS_MIN, MOTORS_MAX = 4, 12  # four axes need as many; a matrix of 12 rows and 4 columns fills one message
# Ranges, here and below, are what no multirotor on Earth leaves, from 27 g indoors to some tons with people aboard:
# a number out of one of them has the wrong unit, or the decimal point in the wrong place.
_ARM_M = (0.02, 10.0)
_MASS_PER_ARM_SQUARED = (1.0, 1000.0)  # kg/m^2, of the farthest rotor's arm: real ones have 10 to 150
_GYRATION_PER_ARM = (0.03, 3.0)  # 0.25 to 0.9
_DRAG_PER_ARM = (1e-3, 0.5)  # torque over thrust over arm: 0.02 to 0.15
_INERTIA_SUM_MIN = 0.9  # of two principal moments, over the third: 1 for every body, less by errors of measurement
_HOVER = (0.05, 0.95)  # fraction of all thrust that carries the vehicle, exclusive
_PWM_SPAN_MIN_US = 100.0
_SPIN_SPAN_MIN = 0.1
_SAME_PLACE_M = 0.01

Inertia = Annotated[float, span(1e-7, 3e5, "kg m^2", "about a principal axis")]
Coordinate = Annotated[float, span(-10.0, 10.0, "m", "of the rotor's hub")]
Filter = Annotated[float, span(0.0, 1000.0, "Hz", "cut-off of a second-order low-pass; 0: none, else at least 1")]
Lag = Annotated[float, span(0.0, 1.0, "s", "time constant of thrust after command")]


class AirframeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[airframe]``."""

    name: Name
    source: Annotated[str, msgspec.Meta(max_length=2000)]
    mass_kg: Annotated[float, span(0.02, 3000.0, "kg", "of the whole vehicle as it flies")]
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    network: Text = ""  # basis network: a shipped name or a file beside this one; empty: a constant basis


class MotorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[motor]``, the same for all rotors. Inertia and speed of the rotor are the plant's alone."""

    max_thrust_n: Annotated[float, span(0.02, 20000.0, "N", "of one rotor at full output")]
    time_constant_up_s: Lag
    time_constant_down_s: Lag
    torque_per_thrust_m: Annotated[float, span(1e-4, 1.0, "m", "drag torque over thrust: what yaw is controlled with")]
    rotor_inertia_kg_m2: Annotated[float, span(0.0, 10.0, "kg m^2", "of one rotor")] = 0.0
    max_speed_rad_s: Annotated[float, span(10.0, 10000.0, "rad/s", "of one rotor at full output")] = 1000.0


class CommandTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[command]``: from motor output to thrust."""

    thrust_expo: Annotated[float, span(0.0, 1.0, "", "0: thrust is linear in the output, 1: quadratic")]
    spin_min: Annotated[float, span(0.0, 0.5, "", "of the full motor output, where thrust begins")]
    spin_max: Annotated[float, span(0.5, 1.0, "", "of the full motor output, where thrust is full")]
    pwm_min: Annotated[float, span(500.0, 1700.0, "us", "pulse width of no output")]
    pwm_max: Annotated[float, span(1300.0, 2500.0, "us", "pulse width of full output")]


class TelemetryTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[telemetry]``: low-pass filters of the autopilot on what it sends (second order; 0: none)."""

    gyro_filter_hz: Filter
    accelerometer_filter_hz: Filter


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[log]``: where a ULog keeps the motor commands, when not in ``actuator_outputs``.

    ``field`` has ``{}`` for the motor's index from 0; ``unit`` N: thrust; output: 0..1; pwm: microseconds.
    """

    topic: Name
    field: Name
    unit: Literal["N", "output", "pwm"] = "pwm"


class RotorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[rotor]]``: either angle (clockwise from the nose) and arm, or x forward and y right."""

    spin: Literal["cw", "ccw"]
    angle_deg: Annotated[float, span(-360.0, 360.0, "deg", "clockwise from the nose")] | None = None
    arm_m: Annotated[float, span(*_ARM_M, "m", "from the centre of mass to the hub")] | None = None
    x_m: Coordinate | None = None
    y_m: Coordinate | None = None

    def position_m(self) -> tuple[float, float]:
        """(x, y). Raises ValueError when neither form is complete."""
        if self.angle_deg is not None and self.arm_m is not None:
            angle = math.radians(self.angle_deg)
            return self.arm_m * math.cos(angle), self.arm_m * math.sin(angle)
        if self.x_m is not None and self.y_m is not None:
            return self.x_m, self.y_m
        raise ValueError("give angle_deg and arm_m, or x_m and y_m")


class AirframeFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    airframe: AirframeTable
    motor: MotorTable
    command: CommandTable
    telemetry: TelemetryTable
    rotor: list[RotorTable]
    aerodynamics: dict[str, Any] = {}  # the plant's own
    log: LogTable | None = None


def effectiveness_si(
    position_m: NDArray[np.float64], spin: NDArray[np.float64], motor: MotorTable
) -> NDArray[np.float64]:
    """B0 (n, m): N and N m for thrust fraction 1 of each motor at ``position_m`` (m, 2) with ``spin`` (m,), +1 ccw.

    A rotor at (x, y) pushing up by F gives roll torque -y F and pitch torque x F in FRD.
    """
    x, y = position_m.T
    return np.stack([np.ones_like(x), -y, x, motor.torque_per_thrust_m * spin]) * motor.max_thrust_n


def fault_of(data: AirframeFile) -> str | None:
    """Why no vehicle is like this, naming key, value and what is allowed; None when one may be."""
    return next(_faults(data), None)


def _faults(data: AirframeFile) -> Iterator[str]:
    """All of them, in an order in which each may rely on those before."""
    command, airframe = data.command, data.airframe
    if not MOTORS_MIN <= len(data.rotor) <= MOTORS_MAX:
        yield f"rotor: {len(data.rotor)} of them; between {MOTORS_MIN} and {MOTORS_MAX} can be handled"
    if command.spin_max - command.spin_min < _SPIN_SPAN_MIN:
        yield (
            f"command.spin_max = {command.spin_max}: must be at least {_SPIN_SPAN_MIN} above"
            f" command.spin_min = {command.spin_min}"
        )
    if command.pwm_max - command.pwm_min < _PWM_SPAN_MIN_US:
        yield (
            f"command.pwm_max = {command.pwm_max}: must be at least {_PWM_SPAN_MIN_US:g} us above"
            f" command.pwm_min = {command.pwm_min}"
        )
    for key in ("gyro_filter_hz", "accelerometer_filter_hz"):
        value = getattr(data.telemetry, key)
        if 0.0 < value < 1.0:
            yield f"telemetry.{key} = {value}: give 0 for no filter, or a number from 1 to 1000 Hz"
    if data.log is not None and (data.log.field.count("{}") != 1 or set("{}") & set(data.log.field.replace("{}", ""))):
        yield f"log.field = {data.log.field!r}: give a name with one {{}} where the motor's index belongs"
    hover = airframe.mass_kg * GRAVITY_M_S2 / (len(data.rotor) * data.motor.max_thrust_n)
    if not _HOVER[0] < hover < _HOVER[1]:
        yield (
            f"motor.max_thrust_n = {data.motor.max_thrust_n:.4g}: {len(data.rotor)} rotors hover airframe.mass_kg ="
            f" {airframe.mass_kg} at {hover:.3g} of their thrust; between {_HOVER[0]} and {_HOVER[1]} is allowed"
        )
    yield from _faults_of_rotors(data, hover)


def _faults_of_size(data: AirframeFile, arm: float) -> Iterator[str]:
    """Numbers that do not go with each other; ``arm`` in m, of the farthest rotor."""
    airframe, inertia = data.airframe, data.airframe.inertia_kg_m2
    arms = f"of the farthest rotor's arm, {arm:.3g} m"
    ratio, (low, high) = airframe.mass_kg / arm**2, _MASS_PER_ARM_SQUARED
    if not low <= ratio <= high:
        yield (
            f"airframe.mass_kg = {airframe.mass_kg}: {ratio:.3g} kg/m^2 over the square {arms};"
            f" {low:g} to {high:g} is allowed"
        )
    low, high = _GYRATION_PER_ARM
    for axis, value in zip(("roll", "pitch", "yaw"), inertia, strict=True):
        gyration = math.sqrt(value / airframe.mass_kg)
        if not low <= gyration / arm <= high:
            yield (
                f"airframe.inertia_kg_m2, {axis} = {value}: radius of gyration {gyration:.2g} m with airframe.mass_kg ="
                f" {airframe.mass_kg}; {low} to {high:g} {arms}, is allowed"
            )
        if sum(inertia) - value < _INERTIA_SUM_MIN * value:
            yield f"airframe.inertia_kg_m2, {axis} = {value}: more than the other two together, which no body has"
    ratio, (low, high) = data.motor.torque_per_thrust_m / arm, _DRAG_PER_ARM
    if not low <= ratio <= high:
        yield (
            f"motor.torque_per_thrust_m = {data.motor.torque_per_thrust_m}: {ratio:.2g} {arms};"
            f" {low} to {high} is allowed"
        )


def _faults_of_rotors(data: AirframeFile, hover: float) -> Iterator[str]:
    places: list[tuple[float, float]] = []
    for number, rotor in enumerate(data.rotor, start=1):
        try:
            places.append(rotor.position_m())
        except ValueError as error:
            yield f"rotor[{number}]: {error}"
            return
        arm = math.hypot(*places[-1])
        if not _ARM_M[0] <= arm <= _ARM_M[1] * (1.0 + 1e-9):
            yield f"rotor[{number}]: {arm:.3g} m from the centre of mass; allowed from {_ARM_M[0]} to {_ARM_M[1]:g} m"
    yield from _faults_of_size(data, max(math.hypot(*place) for place in places))
    spins = [rotor.spin for rotor in data.rotor]
    if len(set(spins)) < 2:
        yield f"rotor.spin = {spins[0]!r} of all: yaw needs rotors of both, 'cw' and 'ccw'"
    for (i, one), (k, other) in combinations(enumerate(places), 2):
        if math.dist(one, other) < _SAME_PLACE_M and spins[i] == spins[k]:
            yield f"rotor[{k + 1}]: at the place of rotor[{i + 1}] with the same spin: only coaxial rotors may"
    matrix = effectiveness_si(
        np.array(places), np.array([1.0 if spin == "ccw" else -1.0 for spin in spins]), data.motor
    )
    matrix = matrix / np.abs(matrix).sum(axis=1, keepdims=True).clip(1e-12)
    if np.linalg.matrix_rank(matrix, tol=1e-6) < len(matrix):
        yield "rotor: thrust, roll, pitch and yaw cannot be set one by one with these places and spins"
    elif not _trims(matrix, hover):
        yield (
            f"rotor: no thrusts within 0..1 hold the vehicle level at its hover thrust, {hover:.2f} of the full one;"
            " the centre of mass must lie well within the rotors, and their yaw torques cancel"
        )


def _trims(matrix: NDArray[np.float64], hover: float) -> bool:
    """Is there u in 0..1 with B u = (h, 0, 0, 0)? ``matrix`` (n, m) with rows over the sum of their magnitudes."""
    axes, motors = matrix.shape
    demand = np.concatenate([[hover], np.zeros(axes - 1)])
    upper, lower = np.concatenate([np.ones(motors), demand]), np.concatenate([np.zeros(motors), demand])
    sense = np.concatenate([np.zeros(motors, np.int32), np.full(axes, 5, np.int32)]).astype(np.int32)
    _, _, flag, _ = daqp.solve(np.eye(motors), np.full(motors, -hover), matrix.copy(), upper, lower, sense)
    return bool(flag == 1)
