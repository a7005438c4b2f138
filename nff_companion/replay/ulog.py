"""PX4 logs (.ulg)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import LogTable, Vehicle
from nff_companion.errors import LogError

_DEFAULT = LogTable(topic="actuator_outputs", field="output[{}]", unit="pwm")
_IMU = "sensor_combined"


def _open(path: Path, topics: list[str]) -> dict[str, dict[str, NDArray[Any]]]:
    from pyulog import ULog

    try:
        log = ULog(str(path), topics)
    except Exception as error:  # pyulog raises whatever its parser trips over
        raise LogError(f"{path} is not a readable ULog: {error}") from error
    tables: dict[str, dict[str, NDArray[Any]]] = {}
    for item in log.data_list:
        tables.setdefault(item.name, item.data)
    return tables


def _time(table: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    # The first stamps of some logs underflow: they are signed.
    return cast("NDArray[np.float64]", 1e-6 * table["timestamp"].astype(np.int64))


def _columns(table: dict[str, NDArray[Any]], pattern: str, count: int, path: Path) -> NDArray[np.float64]:
    names = [pattern.format(i) for i in range(count)]
    missing = [n for n in names if n not in table]
    if missing:
        raise LogError(f"{path} lacks {missing[0]}: set [log] in the airframe file to where the commands are")
    return np.stack([np.asarray(table[n], float) for n in names], axis=1)


def samples(path: Path, vehicle: Vehicle) -> Iterator[tuple[float, Sample]]:
    """(time in s, sample) a row of ``sensor_combined``. Raises LogError."""
    mapping = vehicle.log or _DEFAULT
    tables = _open(path, [_IMU, mapping.topic, "actuator_armed", "vehicle_attitude", "vehicle_local_position"])
    for topic in (_IMU, mapping.topic):
        if topic not in tables:
            raise LogError(f"{path} lacks topic {topic}: set [log] in the airframe file, or log it")
    imu = tables[_IMU]
    time_s = _time(imu)
    gyro = _columns(imu, "gyro_rad[{}]", 3, path)
    force = _columns(imu, "accelerometer_m_s2[{}]", 3, path)
    command = _columns(tables[mapping.topic], mapping.field, vehicle.motors, path)
    newest = _newest(_time(tables[mapping.topic]), time_s)
    armed = _armed(tables, time_s, mapping, command, newest)
    positions = _positions(tables, time_s, ("x", "y", "z"))
    velocities = _positions(tables, time_s, ("vx", "vy", "vz"))
    attitudes = _attitudes(tables, time_s)
    for k in range(len(time_s)):
        if newest[k] < 0:
            continue
        values = command[newest[k]]
        thrust = np.clip(values / vehicle.motor.max_thrust_n, 0.0, 1.0) if mapping.unit == "N" else None
        output = vehicle.output_of_pwm(values) if mapping.unit == "pwm" else np.clip(values, 0.0, 1.0)
        yield (
            float(time_s[k]),
            Sample(
                time_s=float(time_s[k]),
                gyro_rad_s=gyro[k],
                specific_force_m_s2=force[k],
                output=output,
                armed=bool(armed[k]),
                quaternion=None if attitudes is None else attitudes[k],
                position_m=None if positions is None else positions[k],
                velocity_m_s=None if velocities is None else velocities[k],
                thrust=thrust,
            ),
        )


def _newest(times: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index of the newest entry at each time, -1 before the first."""
    return np.searchsorted(times, at, side="right") - 1


def _armed(
    tables: dict[str, Any],
    time_s: NDArray[np.float64],
    mapping: LogTable,
    command: NDArray[np.float64],
    newest: NDArray[np.intp],
) -> NDArray[np.bool_]:
    """Armed flag; where the commands are those of a controller of the user's own, thrust is the flag."""
    if mapping.unit == "N" or "actuator_armed" not in tables:
        return cast("NDArray[np.bool_]", (command[np.maximum(newest, 0)] > 0.0).any(axis=1))
    flag: NDArray[np.bool_] = np.asarray(tables["actuator_armed"]["armed"], bool)
    index = _newest(_time(tables["actuator_armed"]), time_s)
    return flag[np.maximum(index, 0)] & (index >= 0)


def _positions(
    tables: dict[str, Any], time_s: NDArray[np.float64], axes: tuple[str, ...]
) -> NDArray[np.float64] | None:
    table = tables.get("vehicle_local_position")
    if table is None or len(table["timestamp"]) == 0:
        return None
    at = _time(table)
    return np.stack([np.interp(time_s, at, table[axis]) for axis in axes], axis=1)


def _attitudes(tables: dict[str, Any], time_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Newest quaternion (w, x, y, z) at each time."""
    table = tables.get("vehicle_attitude")
    if table is None or len(table["timestamp"]) == 0 or "q[0]" not in table:
        return None
    values = np.stack([np.asarray(table[f"q[{k}]"], float) for k in range(4)], axis=1)
    return values[np.maximum(_newest(_time(table), time_s), 0)]
