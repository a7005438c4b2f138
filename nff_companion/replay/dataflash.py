"""ArduPilot logs (.bin).

Motor outputs are logged ten times a second: they are interpolated, which a log permits and a live link does not. A
log made for training should have LOG_BITMASK bit 0 (fast attitude), which also brings the inertial samples closer.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError

# SERVOn_FUNCTION of motors 1 to 12 (SRV_Channel.h); EV ids (AP_Logger LogEvent).
_MOTOR_FUNCTIONS = (33, 34, 35, 36, 37, 38, 39, 40, 82, 83, 84, 85)
_ARMED, _DISARMED = 10, 11
_SERVOS = 14
_TABLES = {
    "IMU": ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"),
    "RCOU": tuple(f"C{k + 1}" for k in range(_SERVOS)),
    "XKQ": ("Q1", "Q2", "Q3", "Q4"),
    "XKF1": ("PN", "PE", "PD", "VN", "VE", "VD"),
    "EV": ("Id",),
}


def _read(path: Path) -> tuple[dict[str, NDArray[np.float64]], dict[str, float]]:
    """Tables with the time in s in their first column, of the first sensor and the first filter; parameters."""
    from pymavlink import DFReader

    rows: dict[str, list[list[float]]] = {name: [] for name in _TABLES}
    parameters: dict[str, float] = {}
    try:
        log = DFReader.DFReader_binary(str(path))
        while (message := log.recv_match(type=[*_TABLES, "PARM"])) is not None:
            kind = message.get_type()
            if kind == "PARM":
                parameters[message.Name] = float(message.Value)
            elif getattr(message, "I", 0) == 0 and getattr(message, "C", 0) == 0:
                rows[kind].append([1e-6 * message.TimeUS, *(float(getattr(message, f)) for f in _TABLES[kind])])
    except Exception as error:  # the reader raises whatever it trips over
        raise LogError(f"{path} is not a readable ArduPilot log: {error}") from error
    return {name: np.array(values) for name, values in rows.items() if values}, parameters


def _channels(parameters: dict[str, float], motors: int, path: Path) -> list[int]:
    """Servo channel (from 0) of each motor."""
    by_function = {int(parameters.get(f"SERVO{k + 1}_FUNCTION", 0)): k for k in range(_SERVOS)}
    missing = [k + 1 for k in range(motors) if _MOTOR_FUNCTIONS[k] not in by_function]
    if missing:
        raise LogError(f"{path}: no servo output drives motor {missing[0]}; is it a log of this airframe?")
    return [by_function[_MOTOR_FUNCTIONS[k]] for k in range(motors)]


def _at(table: NDArray[np.float64] | None, time_s: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Columns of ``table``, interpolated."""
    if table is None:
        return None
    return np.stack([np.interp(time_s, table[:, 0], column) for column in table[:, 1:].T], axis=1)


def samples(path: Path, vehicle: Vehicle) -> Iterator[tuple[float, Sample]]:
    """(time in s, sample) for each record of the first IMU. Raises LogError."""
    tables, parameters = _read(path)
    for name in ("IMU", "RCOU"):
        if name not in tables:
            raise LogError(f"{path} has no {name} records: set LOG_BITMASK to log them")
    imu = tables["IMU"]
    time_s = imu[:, 0]
    pwm: Any = _at(tables["RCOU"], time_s)
    output = vehicle.output_of_pwm(pwm[:, _channels(parameters, vehicle.motors, path)])
    attitude, state = tables.get("XKQ"), _at(tables.get("XKF1"), time_s)
    quaternion = None
    if attitude is not None:  # not interpolated: q and -q are the same attitude
        quaternion = attitude[np.maximum(np.searchsorted(attitude[:, 0], time_s, side="right") - 1, 0), 1:]
    events = tables.get("EV", np.zeros((0, 2)))
    switches = events[np.isin(events[:, 1], (_ARMED, _DISARMED))]
    newest = np.searchsorted(switches[:, 0], time_s, side="right") - 1
    # A log begins at arming unless it is told to log disarmed.
    armed = np.where(newest >= 0, switches[newest, 1] == _ARMED, True) if len(switches) else np.ones(len(time_s), bool)
    for k in range(len(time_s)):
        yield (
            float(time_s[k]),
            Sample(
                time_s=float(time_s[k]),
                gyro_rad_s=imu[k, 1:4],
                specific_force_m_s2=imu[k, 4:7],
                output=output[k],
                armed=bool(armed[k]),
                quaternion=None if quaternion is None else quaternion[k],
                position_m=None if state is None else state[k, :3],
                velocity_m_s=None if state is None else state[k, 3:],
            ),
        )
