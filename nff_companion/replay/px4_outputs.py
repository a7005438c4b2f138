"""Where a ULog keeps the motors' outputs: topic, instance, channels and unit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.px4 import outputs
from nff_companion.autopilots.px4.remedy import disagreement, geometry_of
from nff_companion.core.vehicle import LogTable, Vehicle
from nff_companion.errors import NotJudged

Topic = Mapping[str, NDArray[np.float64]]  # columns by field
Topics = Mapping[tuple[str, int], Topic]  # by name and instance
_MOTORS, _OUTPUTS = "actuator_motors", "actuator_outputs"
_FIRST_MOTOR = 101  # output function of motor 1
_FUNCTION = re.compile(r"(\w+)_FUNC(\d+)")
_PULSES_US = (700.0, 2300.0)
_DSHOT_MAX, _CAN_MAX = 1999.0, 8191.0
_ONE = 1.01
_NOT_OURS = "SIM"  # outputs of simulators are speeds
_TIMERS, _DIGITAL = 8, -1.0  # PWM_MAIN_TIMn below it: DShot; -1: OneShot
_DOUBTFUL = 0.7  # logarithm of twice the weight, or half of it
_DRIVEN_SHARE = 0.5  # of the time that it is armed


@dataclass(frozen=True)
class Commands:
    """Motor commands: ``values`` (K, m) at ``time_s`` (K,), as ``unit`` says; ``name`` of the topic."""

    time_s: NDArray[np.float64]
    values: NDArray[np.float64]
    unit: str  # N: thrusts; output: 0..1 of the range from idle to full; pwm: microseconds
    name: str


def time_of(table: Topic) -> NDArray[np.float64]:
    """(K,) s; the first stamps of some logs underflow: they are signed."""
    return np.asarray(1e-6 * np.asarray(table["timestamp"]).astype(np.int64), np.float64)


def columns(table: Topic, pattern: str, channels: list[int], topic: str) -> NDArray[np.float64]:
    """(K, c). Raises NotJudged."""
    names = [pattern.format(channel) for channel in channels]
    missing = [name for name in names if name not in table]
    if missing:
        raise NotJudged(f"{topic} lacks {missing[0]}: set [log] in the airframe file to where the commands are")
    return np.stack([np.asarray(table[name], float) for name in names], axis=1)


def find(topics: Topics, values: Mapping[str, float], vehicle: Vehicle, armed: NDArray[np.float64] | None) -> Commands:
    """By ``[log]`` of the airframe file, else by what the log says itself. ``values``: parameters at take-off;
    ``armed`` (K, 2): time, whether it is armed from then on; None: not in the log. Raises NotJudged."""
    count = values.get("CA_ROTOR_COUNT")
    if count is not None and int(count) != vehicle.motors:
        raise NotJudged(f"CA_ROTOR_COUNT is {count:.0f}, the airframe has {vehicle.motors} motors")
    if vehicle.log is not None:
        return _told(topics, vehicle.log, vehicle.motors, armed)
    _check_rotors(values, vehicle)
    found = [*_of_motors(topics, values, vehicle.motors, armed), *_of_outputs(topics, values, vehicle, armed)]
    if not found:
        raise NotJudged(_absence(topics, vehicle.motors) + _perhaps(topics, vehicle.motors, armed))
    # The one that comes most often; actuator_motors where they come alike.
    return max(found, key=lambda commands: round(_rate(commands), 0))


def driven_motors(topics: Topics, armed: NDArray[np.float64] | None) -> tuple[int, str]:
    """How many channels are driven from the first on, most in any topic of outputs, and in which; 0: none."""
    found = [(0, "")]
    for (name, _), table in sorted(topics.items(), key=lambda kv: kv[0]):
        field = {_MOTORS: "control[{}]", _OUTPUTS: "output[{}]"}.get(name)
        count = 0
        while field is not None and field.format(count) in table:
            values = np.nan_to_num(columns(table, field, [count], name))
            if not _driven(Commands(time_of(table), values, "", name), armed):
                break
            count += 1
        found.append((count, name))
    return max(found)


def _rate(commands: Commands) -> float:
    return (len(commands.time_s) - 1) / max(float(np.ptp(commands.time_s)), 1e-9)


def _told(topics: Topics, mapping: LogTable, motors: int, armed: NDArray[np.float64] | None) -> Commands:
    tables = [(key, table) for key, table in sorted(topics.items(), key=lambda kv: kv[0]) if key[0] == mapping.topic]
    if not tables:
        raise NotJudged(f"the log lacks topic {mapping.topic}: set [log] in the airframe file, or log it")
    found = []
    for (name, _), table in tables:
        commands = columns(table, mapping.field, list(range(motors)), name)
        if mapping.unit != "N":
            commands = np.nan_to_num(commands)
        found.append(Commands(time_of(table), commands, mapping.unit, name))
    driven = [commands for commands in found if mapping.unit == "N" or _driven(commands, armed)]
    if not driven:
        raise NotJudged(_absence(topics, motors))
    return driven[0]


def _absence(topics: Topics, motors: int) -> str:
    there = sorted({name for name, _ in topics} & {_MOTORS, _OUTPUTS})
    if not there:
        return f"the log lacks topics {_MOTORS} and {_OUTPUTS}: log one, or set [log] in the airframe file"
    return f"motor outputs never driven: no instance of {' or '.join(there)} drives {motors} motors while it is armed"


def _perhaps(topics: Topics, motors: int, armed: NDArray[np.float64] | None) -> str:
    """Where the commands of a controller of the user's own may be: as many columns, driven, and never negative."""
    for (name, instance), table in sorted(topics.items(), key=lambda kv: kv[0]):
        for column in table:
            field, counted, rest = column.partition("[0]")
            if (
                not counted
                or rest
                or instance
                or f"{field}[{motors}]" in table
                or f"{field}[{motors - 1}]" not in table
            ):
                continue
            values = np.nan_to_num(columns(table, f"{field}[{{}}]", list(range(motors)), name))
            if (values >= 0.0).all() and _driven(Commands(time_of(table), values, "", name), armed):
                return f"; if {name} has them, give --outputs '{name}:{field}[{{}}]:N' (N, output or pwm)"
    return ""


def _check_rotors(values: Mapping[str, float], vehicle: Vehicle) -> None:
    """The live link's checks of geometry and thrust curve. Raises NotJudged."""
    try:
        wrong = disagreement(geometry_of(dict(values), vehicle.motors), vehicle)
    except KeyError:
        wrong = ""  # not in the log
    curve = {name: value for name, value in values.items() if name == "THR_MDL_FAC"}
    wrong = wrong or outputs.contradiction(curve, vehicle)
    if wrong:
        raise NotJudged(wrong)


def _while_armed(commands: Commands, armed: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Rows of the commands while it is armed; where that is not known, all in which anything is driven."""
    if armed is None or not len(armed):
        return commands.values[(commands.values > 0.0).any(axis=1)]
    index = np.searchsorted(armed[:, 0], commands.time_s, side="right") - 1
    return commands.values[(index >= 0) & (armed[np.maximum(index, 0), 1] > 0.0)]


def _driven(commands: Commands, armed: NDArray[np.float64] | None) -> bool:
    rows = _while_armed(commands, armed)
    if len(rows) < 2:
        return False
    return bool(((rows > 0.0).mean(axis=0) > _DRIVEN_SHARE).all() and (np.ptp(rows, axis=0) > 0.0).all())


def _of_motors(
    topics: Topics, values: Mapping[str, float], motors: int, armed: NDArray[np.float64] | None
) -> list[Commands]:
    """``actuator_motors``: 0..1 before the thrust curve; NaN: the motor stands."""
    table = topics.get((_MOTORS, 0))
    if table is None or f"control[{motors - 1}]" not in table:
        return []
    control = np.clip(np.nan_to_num(columns(table, "control[{}]", list(range(motors)), _MOTORS)), 0.0, 1.0)
    curve = values.get("THR_MDL_FAC", 0.0)
    if curve > 0.0:  # FunctionMotors.hpp: control = f y^2 + (1 - f) y
        control = (np.sqrt((1.0 - curve) ** 2 + 4.0 * curve * control) - (1.0 - curve)) / (2.0 * curve)
    found = Commands(time_of(table), control, "output", _MOTORS)
    return [found] if _driven(found, armed) else []


def _of_outputs(
    topics: Topics, values: Mapping[str, float], vehicle: Vehicle, armed: NDArray[np.float64] | None
) -> list[Commands]:
    """Every instance of ``actuator_outputs`` that drives all motors. Raises NotJudged."""
    groups = _groups(values, vehicle.motors) or {"": list(range(vehicle.motors))}
    found: list[Commands] = []
    for (name, _), table in sorted(topics.items(), key=lambda kv: kv[0]):
        if name != _OUTPUTS:
            continue
        for prefix, channels in groups.items():
            if prefix.startswith(_NOT_OURS) or any(f"output[{channel}]" not in table for channel in channels):
                continue
            raw = np.nan_to_num(columns(table, "output[{}]", channels, _OUTPUTS))
            commands = Commands(time_of(table), raw, "", name)
            if _driven(commands, armed):
                found.append(_in_unit(commands, _while_armed(commands, armed), prefix, channels, values, vehicle))
                break
    return found


def assigned_motors(values: Mapping[str, float]) -> int:
    """How many motors, from the first on, the output functions of one driver name, most of any; 0: none."""
    named: dict[str, set[int]] = {}
    for name, value in values.items():
        match = _FUNCTION.fullmatch(name)
        if match is not None and not match[1].startswith(_NOT_OURS):
            named.setdefault(match[1], set()).add(int(value) - _FIRST_MOTOR)
    return max((next(k for k in range(len(motors) + 1) if k not in motors) for motors in named.values()), default=0)


def _groups(values: Mapping[str, float], motors: int) -> dict[str, list[int]]:
    """Channels (from 0) of the motors by the prefix of a driver's parameters; only drivers that have them all."""
    places: dict[str, dict[int, int]] = {}
    for name, value in values.items():
        match = _FUNCTION.fullmatch(name)
        motor = int(value) - _FIRST_MOTOR
        if match is not None and 0 <= motor < motors:
            places.setdefault(match[1], {})[motor] = int(match[2]) - 1
    return {prefix: [at[k] for k in range(motors)] for prefix, at in places.items() if len(at) == motors}


def _in_unit(
    commands: Commands,
    armed: NDArray[np.float64],
    prefix: str,
    channels: list[int],
    values: Mapping[str, float],
    vehicle: Vehicle,
) -> Commands:
    """As ``output`` or ``pwm``; ``armed`` (L, m) are the rows while it is armed. Raises NotJudged."""
    low, high = float(np.percentile(armed[armed > 0.0], 1)), float(armed.max())
    if high <= _ONE:
        return Commands(commands.time_s, np.clip(commands.values, 0.0, 1.0), "output", commands.name)
    ranges = _ranges(prefix, channels, values, vehicle)
    if not _PULSES_US[0] <= low <= high <= _PULSES_US[1]:
        ranges.pop("pwm", None)
    if high > _DSHOT_MAX:
        ranges.pop("dshot", None)
    if high > _CAN_MAX or not ranges:
        raise NotJudged(f"{commands.name} goes up to {high:.0f}: in which unit? Set [log] in the airframe file")

    def shares(unit: str) -> NDArray[np.float64]:
        least, full = ranges[unit]
        return np.asarray(np.clip((commands.values - least) / (full - least), 0.0, 1.0))

    def hovers(unit: str) -> float:
        """How far from weight the vehicle's thrust would be, were this the unit."""
        least, full = ranges[unit]
        thrust = vehicle.thrust_fraction((armed - least) / (full - least)).mean(axis=1)
        return abs(float(np.log(max(float(np.percentile(thrust, 70)), 1e-6) / vehicle.hover)))

    units = list(ranges)
    unit = units[0] if len(units) == 1 or hovers(units[0]) < _DOUBTFUL else min(units, key=hovers)
    if unit != "pwm":
        return Commands(commands.time_s, shares(unit), "output", commands.name)
    # The live link's check, of the channels where the motors are; -1: the common range of before 1.13.
    told = {
        f"PWM_MAIN_{what}{motor + 1}": values.get(f"{prefix}_{what}{channel + 1}", -1.0)
        for what in ("MIN", "MAX")
        for motor, channel in enumerate(channels)
    }
    wrong = outputs.contradiction({name: value for name, value in told.items() if value > 0.0}, vehicle)
    if wrong:
        raise NotJudged(wrong.replace("PWM_MAIN", prefix))
    return Commands(commands.time_s, commands.values, "pwm", commands.name)


def _ranges(
    prefix: str, channels: list[int], values: Mapping[str, float], vehicle: Vehicle
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """(output of standstill, full output) of each motor, by units that the driver may have; the likeliest first."""
    ones = np.ones(len(channels))
    least = [values.get(f"{prefix}_MIN{channel + 1}", 0.0) for channel in channels]
    most = [values.get(f"{prefix}_MAX{channel + 1}", _CAN_MAX) for channel in channels]
    all_units = {
        "pwm": (ones * vehicle.command.pwm_min, ones * vehicle.command.pwm_max),
        "dshot": (ones * _DSHOT_MAX * values.get("DSHOT_MIN", 0.0), ones * _DSHOT_MAX),
        "can": (np.array(least), np.array(most)),
    }
    if not prefix:
        return all_units
    digital = any(values.get(f"{prefix}_TIM{k}", 0.0) < _DIGITAL for k in range(_TIMERS))
    unit = "pwm" if prefix.startswith("PWM") and not digital else "dshot" if prefix.startswith("PWM") else "can"
    return {unit: all_units[unit]}
