"""PX4 logs (.ulg)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration.record import NO_BATTERY
from nff_companion.core.airframe_file import MOTORS_MIN
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError, NotJudged
from nff_companion.replay import px4_outputs
from nff_companion.replay.flight import (
    OUTPUT_GAP_MAX_S,
    Frame,
    LogFlight,
    Reading,
    interpolated,
    newest,
    rate_of_outputs,
)
from nff_companion.replay.parameters import Parameters
from nff_companion.replay.px4_outputs import Commands, Topic, Topics, columns, time_of
from nff_companion.replay.table import Table

_IMU = "sensor_combined"
_ESCS = 8
_RPM = 2.0 * np.pi / 60.0
_FIRST_MOTOR = 101
_MOTORS = {2: 4, 13: 6, 14: 8}  # by MAV_TYPE


def flights(path: Path) -> list[LogFlight]:
    """The one flight of the log. Raises LogError."""
    from pyulog import ULog

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            log = ULog(io.BytesIO(path.read_bytes()))
    except Exception as error:  # pyulog raises whatever its parser trips over
        raise LogError(f"{path} is not a readable ULog: {error}") from error
    topics: dict[tuple[str, int], Topic] = {
        (item.name, item.multi_id): item.data for item in log.data_list if len(item.data["timestamp"])
    }
    parameters = Parameters()
    for name, value in log.initial_parameters.items():
        parameters.put(-np.inf, name, float(value))
    for stamp, name, value in log.changed_parameters:
        parameters.put(1e-6 * stamp, name, float(value))
    armed = _switches(topics)
    first = [float(time_of(table)[0]) for table in (topics.get((_IMU, 0)),) if table is not None]
    first_s = first[0] if first else 0.0
    on = np.zeros((0, 2)) if armed is None else armed[armed[:, 1] > 0.0]
    take_off_s = float(on[0, 0]) if len(on) else first_s
    values = parameters.at(take_off_s)
    dropouts = len(log.dropouts)
    notes = [f"{dropouts} dropout{'s' if dropouts > 1 else ''} of the logger"] if dropouts else []
    if getattr(log, "file_corruption", False) or printed.getvalue().strip():
        notes.append("parts of the file are corrupt and were passed over")
    return [
        LogFlight(
            path=path,
            autopilot="px4",
            system=None,
            parameters=parameters,
            frame=_frame(values, topics, armed),
            first_s=first_s,
            take_off_s=take_off_s,
            read=lambda vehicle: _rows(topics, values, armed, vehicle),
            notes=notes,
        )
    ]


def _frame(values: Mapping[str, float], topics: Topics, armed: NDArray[np.float64] | None) -> Frame | None:
    """What the parameters say; how many motors it has, where they do not, by the outputs. None: nothing is known."""
    count, start = values.get("CA_ROTOR_COUNT"), values.get("SYS_AUTOSTART")
    if count:
        return Frame(f"{count:.0f} rotors (CA_ROTOR_COUNT)", int(count))
    motors = _motors(values, topics, armed)
    if start:
        return Frame(f"SYS_AUTOSTART {start:.0f}", None if motors is None else motors.motors)
    return motors


def _motors(values: Mapping[str, float], topics: Topics, armed: NDArray[np.float64] | None) -> Frame | None:
    """By output functions, by MAV_TYPE, or as many as are driven; None: that is not in the log."""
    assigned, kind = px4_outputs.assigned_motors(values), values.get("MAV_TYPE")
    if assigned >= MOTORS_MIN:
        return Frame(f"{assigned} motors by output functions", assigned)
    told = _MOTORS.get(-1 if kind is None else int(kind))
    if told is not None:
        return Frame(f"{told} motors by MAV_TYPE {kind:.0f}", told)
    count, name = px4_outputs.driven_motors(topics, armed)
    return Frame(f"{count} outputs are driven ({name})", count) if count >= MOTORS_MIN else None


def _switches(topics: Topics) -> NDArray[np.float64] | None:
    """(K, 2) time, whether it is armed from then on."""
    table = topics.get(("actuator_armed", 0))
    if table is None:
        return None
    return np.stack([time_of(table), np.asarray(table["armed"], float)], axis=1)


def _rows(
    topics: Topics, values: Mapping[str, float], switches: NDArray[np.float64] | None, vehicle: Vehicle
) -> Reading:
    """A row of ``sensor_combined``. Raises NotJudged."""
    imu = topics.get((_IMU, 0))
    if imu is None:
        raise NotJudged(f"the log lacks topic {_IMU}: log it")
    commands = px4_outputs.find(topics, values, vehicle, switches)
    outputs_hz = rate_of_outputs(commands.time_s, commands.name)
    time_s = time_of(imu)
    gyro = columns(imu, "gyro_rad[{}]", [0, 1, 2], _IMU)
    force = columns(imu, "accelerometer_m_s2[{}]", [0, 1, 2], _IMU)
    index = newest(commands.time_s, time_s)
    begun = index >= 0
    time_s, gyro, force, index = time_s[begun], gyro[begun], force[begun], index[begun]
    output, thrust = _asked(commands, index, time_s, vehicle)
    armed = _armed(commands, switches, index, time_s)
    positions = _positions(topics, time_s)
    attitudes = _attitudes(topics, time_s)
    speed, read_s = _speeds(topics.get(("esc_status", 0)), vehicle.motors, time_s)
    rows = Table(
        stamp_s=time_s,
        time_s=time_s,
        gyro_rad_s=gyro,
        specific_force_m_s2=force,
        output=output,
        armed=armed,
        quaternion=attitudes,
        position_m=None if positions is None else positions[:, :3],
        velocity_m_s=None if positions is None else positions[:, 3:],
        thrust=thrust,
        rotor_speed_rad_s=speed,
        rotor_speed_time_s=read_s,
    )
    return Reading(rows, commands.name, outputs_hz, _battery(topics.get(("battery_status", 0))))


def _battery(table: Topic | None) -> NDArray[np.float64]:
    """(B, 2) s, V as measured."""
    if table is None or "voltage_v" not in table:
        return NO_BATTERY
    return np.column_stack([time_of(table), np.asarray(table["voltage_v"], float)])


def _asked(
    commands: Commands, index: NDArray[np.int64], time_s: NDArray[np.float64], vehicle: Vehicle
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Outputs (N, m) 0..1 and, where the log has thrusts, their fractions (N, m); NaN where they are too old."""
    values = commands.values[index]
    values[time_s - commands.time_s[index] > OUTPUT_GAP_MAX_S] = np.nan
    if commands.unit == "N":
        return np.clip(values, 0.0, 1.0), np.clip(values / vehicle.motor.max_thrust_n, 0.0, 1.0)
    return (vehicle.output_of_pwm(values) if commands.unit == "pwm" else np.clip(values, 0.0, 1.0)), None


def _armed(
    commands: Commands, switches: NDArray[np.float64] | None, index: NDArray[np.int64], time_s: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Armed flag (N,); where the commands are those of a controller of the user's own, thrust is the flag."""
    if commands.unit == "N" or switches is None:
        return np.asarray((commands.values[index] > 0.0).any(axis=1))
    at = newest(switches[:, 0], time_s)
    return (switches[np.maximum(at, 0), 1] > 0.0) & (at >= 0)


def _positions(topics: Topics, time_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """(N, 6) position and velocity."""
    table = topics.get(("vehicle_local_position", 0))
    if table is None:
        return None
    state = np.stack([np.asarray(table[name], float) for name in ("x", "y", "z", "vx", "vy", "vz")], axis=1)
    return interpolated(time_of(table), state, time_s)


def _attitudes(topics: Topics, time_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Newest quaternion (N, 4) w, x, y, z; not interpolated: q and -q are the same attitude."""
    table = topics.get(("vehicle_attitude", 0))
    if table is None or "q[0]" not in table:
        return None
    values = np.stack([np.asarray(table[f"q[{k}]"], float) for k in range(4)], axis=1)
    return values[np.maximum(newest(time_of(table), time_s), 0)]


def _speeds(table: Any, motors: int, time_s: NDArray[np.float64]) -> tuple[Any, Any]:
    """Rotor speeds (N, m) in rad/s and when they were read, NaN: not known; None where no ESC speaks."""
    if table is None or "esc[0].esc_rpm" not in table:
        return None, None
    at = time_of(table)
    index = newest(at, time_s)
    have = index >= 0
    speed = np.full((len(time_s), motors), np.nan)
    read_s = np.full_like(speed, np.nan)
    for k in range(_ESCS):
        if f"esc[{k}].esc_rpm" not in table:
            continue
        motor = _motor_of(table, k)
        if not 0 <= motor < motors:
            continue
        rpm = np.abs(np.asarray(table[f"esc[{k}].esc_rpm"], float)) * _RPM
        stamps = np.asarray(table.get(f"esc[{k}].timestamp", table["timestamp"])).astype(np.int64) * 1e-6
        stamps = np.where(stamps > 0.0, stamps, at)
        speed[have, motor], read_s[have, motor] = rpm[index[have]], stamps[index[have]]
    return (speed, read_s) if np.isfinite(speed).any() else (None, None)


def _motor_of(table: Any, number: int) -> int:
    """Motor (from 0) of an ESC: by its output function where it says one, else by its number."""
    function = table.get(f"esc[{number}].actuator_function")
    said = 0 if function is None else int(np.median(function))
    return said - _FIRST_MOTOR if said >= _FIRST_MOTOR else number
