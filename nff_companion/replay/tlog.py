"""MAVLink telemetry logs (.tlog): 8 bytes big-endian microseconds of arrival, then the frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.adoption import is_vehicle
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.calibration.record import NO_BATTERY
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import LogError, NotJudged
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.services.parameter_reader import decode, name_of
from nff_companion.replay import ardupilot
from nff_companion.replay.flight import Frame, LogFlight, Reading, Row, rate_of_outputs
from nff_companion.replay.parameters import Parameters

_STAMP = struct.Struct(">Q")
_V1, _V2 = 0xFE, 0xFD
_SIGNATURE = 13
_SIGNED = 0x01
_LEAST = _STAMP.size + 8
_DAY_US = 86_400_000_000
_JUMP_S = 1.0
_NO_VOLTAGE_V = 65.5  # and more, in SYS_STATUS: not known
_SERVOS = 16  # that SERVO_OUTPUT_RAW has
_MOTORS = {
    dialect.MAV_TYPE_QUADROTOR: 4,
    dialect.MAV_TYPE_HEXAROTOR: 6,
    dialect.MAV_TYPE_OCTOROTOR: 8,
    dialect.MAV_TYPE_DECAROTOR: 10,
    dialect.MAV_TYPE_DODECAROTOR: 12,
}
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_TAKEN = frozenset({"HIGHRES_IMU", "SERVO_OUTPUT_RAW", "HEARTBEAT", "PARAM_VALUE", "ATTITUDE_QUATERNION"}) | {
    "LOCAL_POSITION_NED",
    "POSITION_TARGET_LOCAL_NED",
    "EXTENDED_SYS_STATE",
    "SYS_STATUS",
    "ESC_STATUS",
    "ESC_TELEMETRY_1_TO_4",
    "ESC_TELEMETRY_5_TO_8",
    "ESC_TELEMETRY_9_TO_12",
}


_TAKEN_NUMBERS = frozenset(getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in _TAKEN)


def _number(frame: bytes) -> int:
    """Message number of a frame."""
    return frame[5] if frame[0] == _V1 else int.from_bytes(frame[7:10], "little")


class Records:
    """Records of one file; ``skipped`` bytes belong to none, once they have been gone through."""

    def __init__(self, path: Path) -> None:
        """Raises LogError."""
        try:
            self._data = path.read_bytes()
        except OSError as error:
            raise LogError(f"{path} cannot be read: {error.strerror}") from error
        self._path = path
        self.skipped = 0

    def __iter__(self) -> Iterator[tuple[float, bytes]]:
        """(arrival in s since 1970, frame). After a tear it goes on where records follow one another again. Raises
        LogError when the file is no tlog."""
        data, at, found, before = self._data, 0, 0, None
        while at + _LEAST <= len(data):
            size = self._size(at)
            stamp = _STAMP.unpack_from(data, at)[0]
            if not size or not self._followed(at + size, stamp) or (before and abs(stamp - before) > _DAY_US):
                at += 1
                self.skipped += 1
                if not found and self.skipped > len(data) // 2:
                    break
                continue
            yield 1e-6 * stamp, data[at + _STAMP.size : at + size]
            at, before, found = at + size, stamp, found + 1
        self.skipped += len(data) - at
        if not found:
            raise LogError(f"{self._path} holds no MAVLink record; is it a tlog?")

    def _size(self, at: int) -> int:
        """Length of the record at ``at``, 0: there is none."""
        data, start = self._data, at + _STAMP.size
        if start + 3 > len(data):
            return 0
        if data[start] == _V2:
            frame = data[start + 1] + 12 + (_SIGNATURE if data[start + 2] & _SIGNED else 0)
        elif data[start] == _V1:
            frame = data[start + 1] + 8
        else:
            return 0
        return _STAMP.size + frame if start + frame <= len(data) else 0

    def _followed(self, at: int, stamp: int) -> bool:
        """Whether another record of about that time begins at ``at``, or the file ends within it."""
        if at + _LEAST > len(self._data):
            return True
        return (
            self._data[at + _STAMP.size] in (_V1, _V2) and abs(_STAMP.unpack_from(self._data, at)[0] - stamp) < _DAY_US
        )


def frames(path: Path) -> Iterator[tuple[float, bytes]]:
    """(arrival in s since 1970, frame) of each record. Raises LogError when the file is not a tlog."""
    return iter(Records(path))


def first_stamp(path: Path) -> float:
    """Arrival of the first record, s since 1970."""
    return next(frames(path))[0]


@dataclass
class _Heard:
    """Of one system's autopilot."""

    messages: list[tuple[float, Message]] = field(default_factory=list)
    heartbeat: Any = None  # the first
    vehicle: bool | None = None  # None: no heartbeat
    counts: dict[str, int] = field(default_factory=dict)
    armed_s: float | None = None  # first heard to be armed
    written: list[tuple[float, Message]] = field(default_factory=list)  # PARAM_VALUEs

    def take(self, stamp: float, message: Message) -> None:
        kind = message.get_type()
        if kind not in _TAKEN:
            return
        self.counts[kind] = self.counts.get(kind, 0) + 1
        self.messages.append((stamp, message))
        if kind == "HEARTBEAT":
            self.heartbeat = self.heartbeat or message
            self.vehicle = bool(self.vehicle) or is_vehicle(message)
            if self.armed_s is None and message.base_mode & _ARMED:
                self.armed_s = stamp
        elif kind == "PARAM_VALUE":
            self.written.append((stamp, message))

    def parameters(self) -> Parameters:
        """Of the whole log: how integers are written the heartbeat says, which may come after them."""
        found = Parameters()
        for stamp, message in self.written:
            value = decode(message.param_value, message.param_type, bytewise=self.px4)
            found.put(stamp, name_of(message), value)
        return found

    @property
    def ardupilot(self) -> bool:
        return self.heartbeat is not None and self.heartbeat.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA

    @property
    def px4(self) -> bool:
        return self.heartbeat is not None and self.heartbeat.autopilot == dialect.MAV_AUTOPILOT_PX4


def flights(path: Path) -> list[LogFlight]:
    """One of each vehicle that is heard. Raises LogError."""
    heard: dict[int, _Heard] = {}
    codec, records, first_s = Codec(255, dialect.MAV_COMP_ID_MISSIONPLANNER), Records(path), None
    for stamp, frame in records:
        first_s = stamp if first_s is None else first_s
        if _number(frame) not in _TAKEN_NUMBERS:
            continue  # most of a log, and not worth decoding
        for message in codec.parse_datagram(frame):
            if message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
                heard.setdefault(message.get_srcSystem(), _Heard()).take(stamp, message)
    notes = [f"{records.skipped} bytes belong to no record and were passed over"] if records.skipped else []
    vehicles = {system: one for system, one in sorted(heard.items()) if one.vehicle}
    # Whoever sends samples and no heartbeat is somebody to be spoken of, where nobody else is a vehicle.
    vehicles = vehicles or {system: one for system, one in sorted(heard.items()) if one.vehicle is None}
    if not vehicles or first_s is None:
        raise NotJudged(f"{path}: no autopilot of a multirotor is heard (HEARTBEAT of component 1)")
    return [_flight(path, system, one, first_s, notes) for system, one in vehicles.items()]


def _flight(path: Path, system: int, heard: _Heard, first_s: float, notes: list[str]) -> LogFlight:
    take_off_s = first_s if heard.armed_s is None else heard.armed_s
    parameters = heard.parameters()
    frame = ardupilot.frame_of(parameters.at(take_off_s)) if heard.ardupilot else None
    if frame is None and heard.ardupilot and heard.heartbeat.type in _MOTORS:
        motors = _MOTORS[heard.heartbeat.type]
        frame = Frame(f"{motors} motors by MAV_TYPE {heard.heartbeat.type}", motors)

    def fit(vehicle: Vehicle) -> Vehicle:
        if heard.px4:
            return vehicle.with_telemetry(TelemetryTable(0.0, 0.0))
        return ardupilot.fitted(vehicle, parameters.at(take_off_s)) if heard.ardupilot else vehicle

    return LogFlight(
        path=path,
        autopilot="ardupilot" if heard.ardupilot else "px4" if heard.px4 else "",
        system=system,
        parameters=parameters,
        frame=frame,
        first_s=first_s,
        take_off_s=take_off_s,
        read=lambda vehicle: _rows(heard, vehicle, frame, parameters.at(take_off_s)),
        fit=fit,
        notes=notes,
    )


def _rows(heard: _Heard, vehicle: Vehicle, frame: Frame | None, values: dict[str, float]) -> Reading:
    """By the decoder of the live link. Raises NotJudged."""
    for name in ("HEARTBEAT", "HIGHRES_IMU", "SERVO_OUTPUT_RAW"):
        if not heard.counts.get(name):
            raise NotJudged(f"no {name} of the autopilot: have it sent and logged")
    channels = None
    if heard.ardupilot:
        wrong = ardupilot.misfit(values, vehicle, frame)
        if wrong:
            raise NotJudged(wrong)
        channels = ardupilot.channels(values, vehicle.motors, _SERVOS)
    sent = [(s, m.time_usec) for s, m in heard.messages if m.get_type() == "SERVO_OUTPUT_RAW" and m.port == 0]
    fresh = [after[0] for before, after in pairwise(sent) if after[1] != before[1]]
    outputs_hz = rate_of_outputs(np.array(fresh), "SERVO_OUTPUT_RAW")
    decoder = TelemetryDecoder(vehicle, channels)
    rows: list[Row] = []
    for stamp, message in heard.messages:
        sample = decoder.observe(message)
        if sample is not None:
            rows.append((stamp, sample))
    return Reading(rows, "SERVO_OUTPUT_RAW", outputs_hz, _battery(heard, rows))


def _battery(heard: _Heard, rows: list[Row]) -> NDArray[np.float64]:
    """(B, 2) s of the samples' clock, V."""
    told = [(s, 1e-3 * m.voltage_battery) for s, m in heard.messages if m.get_type() == "SYS_STATUS"]
    known = np.array([(s, v) for s, v in told if v < _NO_VOLTAGE_V]).reshape(-1, 2)
    if not len(known) or not rows:
        return NO_BATTERY
    arrived, sampled = np.array([(stamp, sample.time_s) for stamp, sample in rows]).T
    if (np.diff(arrived) < 0.0).any() or (np.diff(sampled) < -_JUMP_S).any():
        return NO_BATTERY  # the clock of either was set: which reading is when is not known
    return np.column_stack([np.interp(known[:, 0], arrived, sampled), known[:, 1]])
