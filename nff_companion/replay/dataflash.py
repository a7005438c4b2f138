"""ArduPilot logs (.bin).

Motor outputs are logged ten times a second: they are interpolated, which a log permits and a live link does not. Where
the demands of the rate loops are logged (LOG_BITMASK bit 0, fast attitude), outputs follow from them (rate_outputs.py);
bit 18 (fast IMU) brings the inertial samples of every loop.
"""

from __future__ import annotations

import contextlib
import io
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration.record import NO_BATTERY
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError, NotJudged
from nff_companion.replay import ardupilot, rate_outputs
from nff_companion.replay.flight import (
    Frame,
    LogFlight,
    Reading,
    Row,
    far,
    interpolated,
    newest,
    rate_of_outputs,
)
from nff_companion.replay.parameters import Parameters

Table = NDArray[np.float64]  # (K, 1 + fields), the time in s first
_ARMED, _DISARMED = 10, 11  # EV ids (AP_Logger LogEvent)
_SERVOS = 14
_HEAD, _FMT, _FMT_SIZE = b"\xa3\x95", 0x80, 89
_PAGE = 528  # of logs that are written in blocks
_RPM = 2.0 * np.pi / 60.0
# Message: what it is kept as, its fields. EKF2 was in front of EKF3 before 4.1.
_STATE, _ATTITUDE = ("PN", "PE", "PD", "VN", "VE", "VD"), ("Q1", "Q2", "Q3", "Q4")
_TABLES: dict[str, tuple[str, tuple[str, ...]]] = {
    "IMU": ("IMU", ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")),
    "RCOU": ("RCOU", tuple(f"C{k + 1}" for k in range(_SERVOS))),
    "XKQ": ("XKQ", _ATTITUDE),
    "NKQ": ("NKQ", _ATTITUDE),
    "NKQ1": ("NKQ", _ATTITUDE),
    "XKQ1": ("XKQ", _ATTITUDE),
    "XKF1": ("XKF1", _STATE),
    "NKF1": ("NKF1", _STATE),
    "EV": ("EV", ("Id",)),
    "ARM": ("ARM", ("ArmState",)),
    "ESC": ("ESC", ("Instance", "RPM")),
    "RATE": ("RATE", ("ROut", "POut", "YOut", "AOut")),
    "MOTB": ("MOTB", ("LiftMax", "BatVolt")),
    "BAT": ("BAT", ("Volt",)),
    "CURR": ("BAT", ("Volt",)),
}
_NOT_NEEDED = ("RATE", "MOTB", "BAT", "CURR")  # a record that lacks a field is passed over
_OLD_CHANNEL = re.compile(r"C(\d+)")


@dataclass
class _Log:
    """``tables`` of the first sensor and the first filter."""

    tables: dict[str, Table] = field(default_factory=dict)
    parameters: Parameters = field(default_factory=Parameters)
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Said once, however often the log is read."""
        if text not in self.notes:
            self.notes.append(text)


def _read(path: Path) -> _Log:
    """Raises LogError."""
    from pymavlink import DFReader

    rows: dict[str, list[list[float]]] = {}
    log, printed = _Log(), io.StringIO()
    data = _bytes(path)
    whole, lost = _whole(data)
    if not whole:
        raise LogError(f"{path} holds no record; is it an ArduPilot log?")
    if lost:
        log.notes.append(f"{lost} bytes belong to no record and were passed over")
    try:
        with tempfile.NamedTemporaryFile(suffix=".bin") as clean:
            spoilt = len(whole) < len(data)
            if spoilt:
                # The reader complains of each byte, from compiled code too, and gives up at an unknown record.
                clean.write(whole)
                clean.flush()
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
                _take(DFReader.DFReader_binary(clean.name if spoilt else str(path)), log, rows)
    except Exception as error:  # the reader raises whatever it trips over
        raise LogError(f"{path} is not a readable ArduPilot log: {error}") from error
    log.tables = {name: np.array(values) for name, values in rows.items()}
    complaints = sum(1 for text in printed.getvalue().splitlines() if text.strip())
    if complaints:
        log.notes.append(f"{complaints} records could not be understood")
    if not log.tables and not len(log.parameters):
        raise LogError(f"{path} holds no record that is looked for; is it an ArduPilot log?")
    return log


def _take(reader: Any, log: _Log, rows: dict[str, list[list[float]]]) -> None:
    """All records that are looked for."""
    at_s = 0.0
    while (message := reader.recv_match(type=[*_TABLES, "PARM"])) is not None:
        kind, fields = message.get_type(), message.get_fieldnames()
        if "TimeUS" in fields:
            at_s = 1e-6 * message.TimeUS
        elif "TimeMS" in fields:  # before 2015
            at_s = 1e-3 * message.TimeMS
        if kind == "PARM":
            log.parameters.put(at_s, message.Name, float(message.Value))
        elif getattr(message, "I", 0) == 0 and getattr(message, "C", 0) == 0:
            name, wanted = _TABLES[kind]
            if kind in _NOT_NEEDED and not set(wanted) <= set(fields):
                continue
            if name == "BAT" and getattr(message, "Inst", getattr(message, "Instance", 0)) != 0:
                continue
            rows.setdefault(name, []).append([at_s, *(_value(message, field) for field in wanted)])


def _bytes(path: Path) -> bytes:
    """Raises LogError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error


def _whole(data: bytes) -> tuple[bytes, int]:
    """The records that follow one another by the lengths that the log declares, and how many bytes belong to none.
    What is left of the last page is not counted."""
    sizes, kept, at, begin, lost = {_FMT: _FMT_SIZE}, list[bytes](), 0, 0, 0
    while at + 3 <= len(data):
        size = sizes.get(data[at + 2], 0) if data.startswith(_HEAD, at) else 0
        end = at + size
        followed = data.startswith(_HEAD, end) or len(data) - end < _PAGE
        # A record that is cut off has the next one within it.
        if size < 3 or end > len(data) or not (followed or data.find(_HEAD, at + 3, end) < 0):
            if at > begin:
                kept.append(data[begin:at])
            at += 1
            begin, lost = at, lost + 1
            continue
        if data[at + 2] == _FMT:
            sizes[data[at + 3]] = data[at + 4]
        at = end
    kept.append(data[begin:at])
    tail = len(data) - len(data.rstrip(b"\xff\x00"))
    return b"".join(kept), 0 if lost < min(tail + 3, _PAGE) else lost


def _value(message: object, name: str) -> float:
    """A field; channels had other names before 3.4, and fewer."""
    value = getattr(message, name, None)
    channel = _OLD_CHANNEL.fullmatch(name)
    if value is None and channel is not None:
        value = getattr(message, f"Ch{channel[1]}", getattr(message, f"Chan{channel[1]}", 0.0))
    if value is None:
        raise LogError(f"a record lacks field {name}")
    return float(value)


def _armings(tables: Mapping[str, Table]) -> Table:
    """(K, 2) time, whether it is armed from then on. A log begins at arming unless it is told to log disarmed."""
    events = tables.get("EV", np.zeros((0, 2)))
    events = events[np.isin(events[:, 1], (_ARMED, _DISARMED))].copy()
    events[:, 1] = events[:, 1] == _ARMED
    said = tables.get("ARM", np.zeros((0, 2)))
    both = np.concatenate([events, said])
    return both[np.argsort(both[:, 0], kind="stable")]


def flights(path: Path) -> list[LogFlight]:
    """The one flight of the log. Raises LogError."""
    log = _read(path)
    armings = _armings(log.tables)
    first_s = min((float(table[0, 0]) for table in log.tables.values()), default=0.0)
    imu = log.tables.get("IMU")
    first_s = first_s if imu is None else float(imu[0, 0])
    on = armings[armings[:, 1] > 0.0]
    take_off_s = float(on[0, 0]) if len(on) else first_s
    values = log.parameters.at(take_off_s)
    frame = ardupilot.frame_of(values)
    return [
        LogFlight(
            path=path,
            autopilot="ardupilot",
            system=None,
            parameters=log.parameters,
            frame=frame,
            first_s=first_s,
            take_off_s=take_off_s,
            read=lambda vehicle: _rows(log, armings, vehicle, values, frame),
            fit=lambda vehicle: ardupilot.fitted(vehicle, values),
            notes=log.notes,
        )
    ]


def _rows(log: _Log, armings: Table, vehicle: Vehicle, values: Mapping[str, float], frame: Frame | None) -> Reading:
    """A row of the first IMU. Raises NotJudged."""
    tables = log.tables
    for name in ("IMU", "RCOU"):
        if name not in tables:
            raise NotJudged(f"no {name} records: set LOG_BITMASK to log them")
    wrong = ardupilot.misfit(values, vehicle, frame)
    if wrong:
        raise NotJudged(wrong)
    channels = ardupilot.channels(values, vehicle.motors, _SERVOS)
    if channels is None:
        raise NotJudged(
            "SERVO1_FUNCTION and following are not in the log: an ArduPilot before 3.5, or a log without parameters;"
            " which output drives which motor is not known"
        )
    imu, time_s = tables["IMU"], tables["IMU"][:, 0]
    output, name, outputs_hz = _outputs(log, vehicle, channels, values)
    attitude = _first(tables, "XKQ", "NKQ")
    state = _first(tables, "XKF1", "NKF1")
    where = None if state is None else interpolated(state[:, 0], state[:, 1:], time_s)
    quaternion = None
    if attitude is not None:  # not interpolated: q and -q are the same attitude
        quaternion = attitude[np.maximum(newest(attitude[:, 0], time_s), 0), 1:]
    speed, read_s = _speeds(tables.get("ESC"), channels, time_s)
    switch = newest(armings[:, 0], time_s)
    armed = np.where(switch >= 0, armings[switch, 1] > 0.0, True) if len(armings) else np.ones(len(time_s), bool)
    rows: list[Row] = [
        (
            float(time_s[k]),
            Sample(
                time_s=float(time_s[k]),
                gyro_rad_s=imu[k, 1:4],
                specific_force_m_s2=imu[k, 4:7],
                output=output[k],
                armed=bool(armed[k]),
                quaternion=None if quaternion is None else quaternion[k],
                position_m=None if where is None else where[k, :3],
                velocity_m_s=None if where is None else where[k, 3:],
                rotor_speed_rad_s=None if speed is None else speed[k],
                rotor_speed_time_s=None if read_s is None else read_s[k],
            ),
        )
        for k in range(len(time_s))
    ]
    end_s = _valid_until(log, armings, vehicle, channels)
    return Reading([row for row in rows if row[0] < end_s], name, outputs_hz, tables.get("BAT", NO_BATTERY))


def _outputs(
    log: _Log, vehicle: Vehicle, channels: list[int], values: Mapping[str, float]
) -> tuple[NDArray[np.float64], str, float]:
    """Motor outputs (N, m) at the times of IMU, NaN where there are none near; from which messages, and at how many Hz.
    Raises NotJudged."""
    told, time_s, rate = log.tables["RCOU"], log.tables["IMU"][:, 0], log.tables.get("RATE")
    told_s, told_hz = told[:, 0], rate_of_outputs(told[:, 0], "RCOU")
    # Pulses are interpolated before they become outputs, which are clipped.
    output = vehicle.output_of_pwm(interpolated(told_s, told[:, 1:], time_s)[:, channels])
    output[far(told_s, time_s)] = np.nan
    if rate is None or not rate_outputs.is_faster(rate, told_hz):
        return output, "RCOU", told_hz
    # A pulse is the whole microseconds of what was asked for (AP_MotorsMulticopter::output_to_pwm).
    asked = vehicle.output_of_pwm(told[:, 1:][:, channels] + 0.5)
    try:
        found = rate_outputs.reconstructed(rate, log.tables.get("MOTB"), told_s, asked, values)
    except NotJudged as error:
        log.note(f"motor outputs by RCOU at {told_hz:.0f} Hz alone, not by RATE: {error}")
        return output, "RCOU", told_hz
    within = found.at(time_s)
    output[within] = interpolated(found.time_s, found.output, time_s[within])
    return output, "RATE and RCOU", found.hz


def _valid_until(log: _Log, armings: Table, vehicle: Vehicle, channels: list[int]) -> float:
    """The arming from which on the log's parameters are others, that contradict the airframe."""
    for time_s, on in armings[1:]:
        if not on:
            continue
        values = log.parameters.at(time_s)
        try:
            same = ardupilot.channels(values, vehicle.motors, _SERVOS) == channels
        except NotJudged:
            same = False
        if not same or ardupilot.misfit(values, vehicle, None):
            log.note(f"from {time_s:.0f} s on, the next arming, the parameters are others: not read")
            return float(time_s)
    return np.inf


def _first(tables: Mapping[str, Table], *names: str) -> Table | None:
    return next((tables[name] for name in names if name in tables), None)


def _speeds(
    table: Table | None, channels: list[int], time_s: NDArray[np.float64]
) -> tuple[Table, Table] | tuple[None, None]:
    """Rotor speeds (N, m) in rad/s and when they were read, NaN: not yet; the ESC's number is that of its output."""
    if table is None:
        return None, None
    speed = np.full((len(time_s), len(channels)), np.nan)
    read_s = np.full_like(speed, np.nan)
    for motor, channel in enumerate(channels):
        mine = table[table[:, 1] == channel]
        index = newest(mine[:, 0], time_s)
        have = index >= 0
        speed[have, motor] = mine[index[have], 2] * _RPM
        read_s[have, motor] = mine[index[have], 0]
    return speed, read_s
