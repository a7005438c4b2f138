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

from nff_companion.core.rotors import ARM_M, Coordinate, Lag, Rotors, RotorTable, rotors_of
from nff_companion.core.toml_file import Name, Text
from nff_companion.core.tuning.span import span

GRAVITY_M_S2 = 9.80665
MOTORS_MIN, MOTORS_MAX = 4, 12  # four axes need as many; a matrix of 12 rows and 4 columns fills one message
# Ranges, here and below, are what no multirotor on Earth leaves, from 27 g indoors to some tons with people aboard:
# a number out of one of them has the wrong unit, or the decimal point in the wrong place.
_MASS_PER_ARM_SQUARED = (1.0, 1000.0)  # kg/m^2, of the farthest rotor's arm: real ones have 10 to 150
_GYRATION_PER_ARM = (0.03, 3.0)  # 0.25 to 0.9
_DRAG_PER_ARM = (1e-3, 0.5)  # torque over thrust over arm: 0.02 to 0.15
_INERTIA_SUM_MIN = 0.9  # of two principal moments, over the third: 1 for every body, less by errors of measurement
_HOVER = (0.05, 0.95)  # fraction of all thrust that carries the vehicle, exclusive
_PWM_SPAN_MIN_US = 100.0
_SPIN_SPAN_MIN = 0.1
_SAME_PLACE_M = 0.01

Inertia = Annotated[float, span(1e-7, 3e5, "kg m^2", "about a principal axis")]
Filter = Annotated[float, span(0.0, 1000.0, "Hz", "cut-off of a second-order low-pass; 0: none, else at least 1")]


class AirframeTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[airframe]``."""

    name: Name
    source: Annotated[str, msgspec.Meta(max_length=2000)]
    mass_kg: Annotated[float, span(0.02, 3000.0, "kg", "of the whole vehicle as it flies")]
    inertia_kg_m2: tuple[Inertia, Inertia, Inertia]
    centre_of_mass_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)  # from where the rotors' places count
    network: Text = ""  # basis network: a shipped name or a file beside this one; empty: none was trained
    confirmed: Text = ""  # how it is known to be the flying vehicle's, as "calibrated 2026-11-02"; empty: it is not


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
    """``[telemetry]``: low-pass filters of the autopilot on what it sends (second order; 0: none), and how much later
    than their time stamp says the motor outputs show in the motion.
    """

    gyro_filter_hz: Filter
    accelerometer_filter_hz: Filter
    output_delay_s: Annotated[
        float, span(0.0, 0.1, "s", "from the time stamp of an output until the motor hears it")
    ] = 0.0


class LogTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[log]``: where a ULog keeps the motor commands, when not in ``actuator_outputs``.

    ``field`` has ``{}`` for the motor's index from 0; ``unit`` N: thrust; output: 0..1; pwm: microseconds.
    """

    topic: Name
    field: Name
    unit: Literal["N", "output", "pwm"] = "pwm"


class AirframeFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    airframe: AirframeTable
    motor: MotorTable
    command: CommandTable
    telemetry: TelemetryTable
    rotor: list[RotorTable]
    aerodynamics: dict[str, Any] = {}  # the plant's own
    log: LogTable | None = None


def rotors(data: AirframeFile) -> Rotors:
    """The rotors of a file, places from the centre of mass. Raises ValueError when a place is not complete."""
    motor = data.motor
    return rotors_of(
        data.rotor,
        data.airframe.centre_of_mass_m,
        max_thrust_n=motor.max_thrust_n,
        torque_per_thrust_m=motor.torque_per_thrust_m,
        time_constants_s=(motor.time_constant_up_s, motor.time_constant_down_s),
    )


def lift_share(data: AirframeFile) -> float:
    """What all rotors carry at full output, over ``motor.max_thrust_n``: their number, when they are alike and upright.

    NaN when one of them has no direction.
    """
    per_acceleration = data.airframe.mass_kg / data.motor.max_thrust_n
    return sum(
        rotor.thrust * rotor.upward if rotor.acceleration is None else rotor.acceleration[0] * per_acceleration
        for rotor in data.rotor
    )


def with_thrust_to_weight(data: AirframeFile, ratio: float) -> AirframeFile:
    """The same with the thrust that all rotors together have ``ratio`` times the weight."""
    motor, share = data.motor, max(lift_share(data), 0.1)
    thrust = ratio * data.airframe.mass_kg * GRAVITY_M_S2 / share
    more = thrust / motor.max_thrust_n
    rotor = [
        r
        if r.acceleration is None
        else msgspec.structs.replace(r, acceleration=tuple(more * gain for gain in r.acceleration))
        for r in data.rotor
    ]
    motor = msgspec.structs.replace(motor, max_thrust_n=thrust)
    return msgspec.structs.replace(data, motor=motor, rotor=rotor)


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
    yield from _faults_of_directions(data)
    hover = airframe.mass_kg * GRAVITY_M_S2 / (lift_share(data) * data.motor.max_thrust_n)
    if not _HOVER[0] < hover < _HOVER[1]:
        given = f"motor.max_thrust_n = {data.motor.max_thrust_n:.4g}"
        if data.rotor[0].acceleration is not None:
            given = "rotor.acceleration"
        yield (
            f"{given}: {len(data.rotor)} rotors hover airframe.mass_kg ="
            f" {airframe.mass_kg} at {hover:.3g} of their thrust; between {_HOVER[0]} and {_HOVER[1]} is allowed"
        )
    yield from _faults_of_rotors(data, hover)


def _faults_of_directions(data: AirframeFile) -> Iterator[str]:
    for number, rotor in enumerate(data.rotor, start=1):
        fault = rotor.fault()
        if fault is not None:
            yield f"rotor[{number}].{fault}"
    given = [rotor.acceleration is not None for rotor in data.rotor]
    if any(given) and not all(given):
        yield f"rotor[{given.index(False) + 1}].acceleration is missing: give it of all rotors, or of none"


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
    for number, rotor in enumerate(data.rotor, start=1):
        try:
            rotor.position_m()
        except ValueError as error:
            yield f"rotor[{number}]: {error}"
            return
    made = rotors(data)
    places: list[tuple[float, float]] = [(x, y) for x, y, _ in made.place_m.tolist()]
    for number, place in enumerate(places, start=1):
        arm = math.hypot(*place)
        if not ARM_M[0] <= arm <= ARM_M[1] * (1.0 + 1e-9):
            yield f"rotor[{number}]: {arm:.3g} m from the centre of mass; allowed from {ARM_M[0]} to {ARM_M[1]:g} m"
    yield from _faults_of_size(data, max(math.hypot(*place) for place in places))
    spins = [rotor.spin for rotor in data.rotor]
    if len(set(spins)) < 2 and made.acceleration is None and not made.tilted:
        yield f"rotor.spin = {spins[0]!r} of all: yaw needs rotors of both, 'cw' and 'ccw'"
    for (i, one), (k, other) in combinations(enumerate(places), 2):
        if math.dist(one, other) < _SAME_PLACE_M and spins[i] == spins[k]:
            yield f"rotor[{k + 1}]: at the place of rotor[{i + 1}] with the same spin: only coaxial rotors may"
    matrix = made.effectiveness_si(data.airframe.mass_kg, np.array(data.airframe.inertia_kg_m2))
    matrix = matrix / np.abs(matrix).sum(axis=1, keepdims=True).clip(1e-12)
    if np.linalg.matrix_rank(matrix, tol=1e-6) < len(matrix):
        yield "rotor: thrust, roll, pitch and yaw cannot be set one by one with these places, axes and spins"
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
