"""Logs written for tests from the recorded telemetry of an octorotor that loses motor 7 (tests/data)."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from conftest import DATA

from nff_companion.mavlink.codec import Codec, dialect

RECORDED = DATA / "ardupilot_motor7.tlog"
FAIL_S = 6.0  # from the first record
Record = tuple[float, bytes, Any]  # arrival in s, frame, message


def records(path: Path = RECORDED) -> list[Record]:
    """Of MAVLink 2 frames, one after the other."""
    data, at, out, codec = path.read_bytes(), 0, [], Codec(255, 190)
    while at < len(data):
        (stamp,) = struct.unpack_from(">Q", data, at)
        size = data[at + 9] + 12
        frame = data[at + 8 : at + 8 + size]
        out += [(1e-6 * stamp, frame, message) for message in codec.parse(frame)]
        at += 8 + size
    return out


def write_tlog(path: Path, rows: Iterable[tuple[float, bytes]]) -> Path:
    path.write_bytes(b"".join(struct.pack(">Q", round(1e6 * t)) + frame for t, frame in rows))
    return path


def tlog(path: Path, keep: Callable[[Any], bool] = lambda message: True, extra: Iterable[Any] = ()) -> Path:
    """The recording with the messages that are kept, and ``extra`` ones at its beginning."""
    rows = records()
    codec = Codec(1, 1)
    more = [(rows[0][0], codec.pack(message)) for message in extra]
    return write_tlog(path, more + [(t, frame) for t, frame, message in rows if keep(message)])


def of_system(rows: Iterable[Record], system: int, later_s: float = 0.0) -> list[tuple[float, bytes]]:
    """The same flight of another vehicle."""
    codec = Codec(system, 1)
    return [(t + later_s, codec.pack(copy.copy(message))) for t, _, message in rows]


def thinned(rows: Iterable[Record], name: str, every: int) -> list[tuple[float, bytes]]:
    """One of so many messages of one kind."""
    count, out = 0, []
    for t, frame, message in rows:
        count += message.get_type() == name
        if message.get_type() != name or count % every == 0:
            out.append((t, frame))
    return out


class ULogFile:
    """Writes the topics that are described."""

    def __init__(self) -> None:
        self.body = b"ULog\x01\x12\x35\x01" + bytes(8)
        self._put(b"B", bytes(40))
        self._ids = 0

    def _put(self, kind: bytes, data: bytes) -> None:
        self.body += struct.pack("<Hc", len(data), kind) + data

    def describe(self, topic: str, fields: str) -> None:
        self._put(b"F", f"{topic}:uint64_t timestamp;{fields};".encode())

    def parameter(self, name: str, value: float) -> None:
        kind = f"int32_t {name}" if isinstance(value, int) else f"float {name}"
        data = struct.pack("<i" if isinstance(value, int) else "<f", value)
        self._put(b"P", bytes([len(kind)]) + kind.encode() + data)

    def subscribe(self, topic: str, instance: int = 0) -> int:
        self._ids += 1
        self._put(b"A", struct.pack("<BH", instance, self._ids) + topic.encode())
        return self._ids

    def data(self, number: int, usec: int, layout: str, *values: float) -> None:
        self._put(b"D", struct.pack("<HQ" + layout, number, usec, *values))


class Outputs:
    """How the motors' outputs are written: topic, instance, first channel, and what is made of a pulse width."""

    def __init__(
        self,
        of_pwm: Callable[[float], float] = lambda pwm: pwm,
        topic: str = "actuator_outputs",
        *,
        idle_instance: bool = False,
        first: int = 0,
        every: int = 1,
    ) -> None:
        self.of_pwm, self.topic, self.idle_instance, self.first, self.every = of_pwm, topic, idle_instance, first, every


def ulog(
    path: Path,
    outputs: Outputs | None = None,
    *,
    offset_us: int = 0,
    imu_every: int = 1,
    parameters: Mapping[str, float] | None = None,
    leave_out: tuple[str, ...] = (),
    escs: bool = False,
    battery: bool = False,
) -> Path:
    """The recording as a ULog."""
    outputs = outputs or Outputs()
    log = ULogFile()
    for name, value in (parameters or {}).items():
        log.parameter(name, value)
    field = "control" if outputs.topic == "actuator_motors" else "output"
    log.describe("sensor_combined", "float[3] gyro_rad;float[3] accelerometer_m_s2")
    log.describe(outputs.topic, f"float[16] {field}")
    log.describe("actuator_armed", "bool armed")
    log.describe("vehicle_attitude", "float[4] q")
    log.describe("vehicle_local_position", "float x;float y;float z;float vx;float vy;float vz")
    if escs:
        log.describe("esc_status", ";".join(f"int32_t esc[{k}].esc_rpm" for k in range(8)))
    if battery:
        log.describe("battery_status", "float voltage_v;float voltage_filtered_v")
    idle = log.subscribe(outputs.topic, 0) if outputs.idle_instance else 0
    motors = log.subscribe(outputs.topic, int(outputs.idle_instance))
    kinds = ("sensor_combined", "actuator_armed", "vehicle_attitude", "vehicle_local_position")
    ids = {kind: log.subscribe(kind) for kind in kinds if kind not in leave_out}
    esc = log.subscribe("esc_status") if escs else 0
    power = [log.subscribe("battery_status", k) for k in range(2)] if battery else []
    now, count, driven, first_us = 0, 0, 0, 0
    for _, _, m in records():
        kind = m.get_type()
        if kind == "HIGHRES_IMU":
            now, count = m.time_usec + offset_us, count + 1
            if count % imu_every == 0 and "sensor_combined" in ids:
                log.data(ids["sensor_combined"], now, "6f", m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc)
        elif kind == "SERVO_OUTPUT_RAW" and outputs.topic not in leave_out:
            driven += 1
            if driven % outputs.every:
                continue
            pulses = [float(outputs.of_pwm(getattr(m, f"servo{i}_raw"))) for i in range(1, 9)]
            log.data(motors, m.time_usec + offset_us, "16f", *([0.0] * outputs.first + pulses + [0.0] * 8)[:16])
            if idle:
                log.data(idle, m.time_usec + offset_us, "16f", *[0.0] * 16)
            if esc:
                first_us = first_us or m.time_usec
                dead = m.time_usec - first_us > 1e6 * (FAIL_S + 0.02)
                speeds = [0 if dead and k == 6 else 6000 + driven % 7 + k for k in range(8)]
                log.data(esc, m.time_usec + offset_us, "8i", *speeds)
        elif kind == "HEARTBEAT" and now and "actuator_armed" in ids:
            log.data(ids["actuator_armed"], now, "?", bool(m.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED))
            for k, each in enumerate(power):
                log.data(each, now, "2f", 22.0 - k, 23.0)
        elif kind == "ATTITUDE_QUATERNION" and "vehicle_attitude" in ids:
            log.data(ids["vehicle_attitude"], 1000 * m.time_boot_ms + offset_us, "4f", m.q1, m.q2, m.q3, m.q4)
        elif kind == "LOCAL_POSITION_NED" and "vehicle_local_position" in ids:
            values = (m.x, m.y, m.z, m.vx, m.vy, m.vz)
            log.data(ids["vehicle_local_position"], 1000 * m.time_boot_ms + offset_us, "6f", *values)
    path.write_bytes(log.body)
    return path


_BIN = {
    "PARM": (1, "QNf", "TimeUS,Name,Value"),
    "IMU": (2, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "RCOU": (3, "Q" + "H" * 14, "TimeUS," + ",".join(f"C{k + 1}" for k in range(14))),
    "EV": (4, "QB", "TimeUS,Id"),
    "XKQ": (5, "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4"),
    "XKF1": (6, "QBffffff", "TimeUS,C,VN,VE,VD,PN,PE,PD"),
    "RATE": (7, "Qffff", "TimeUS,ROut,POut,YOut,AOut"),
    "MOTB": (8, "Qff", "TimeUS,LiftMax,BatVolt"),
    "BAT": (9, "QBff", "TimeUS,Inst,Volt,VoltR"),
}
_BYTES = {"Q": "Q", "B": "B", "f": "f", "H": "H", "N": "16s", "I": "I"}
_HEAD = b"\xa3\x95"
GOOD_PARAMETERS: dict[str, float] = {"FRAME_CLASS": 3.0, "FRAME_TYPE": 1.0, "MOT_PWM_MIN": 1000, "MOT_PWM_MAX": 2000}
GOOD_PARAMETERS |= {"MOT_THST_EXPO": 0.65, "MOT_SPIN_MIN": 0.15, "MOT_SPIN_MAX": 0.95}
GOOD_PARAMETERS |= {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 9)}


class DataFlashFile:
    """Writes ArduPilot's messages; ``old``: with TimeMS, as before 2015."""

    def __init__(self, *, old: bool = False) -> None:
        self.body, self._old = b"", old
        self._format(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
        for name, (number, new_layout, new_columns) in _BIN.items():
            layout = "I" + new_layout[1:] if old else new_layout
            columns = new_columns.replace("TimeUS", "TimeMS") if old else new_columns
            size = 3 + struct.calcsize("<" + "".join(_BYTES[c] for c in layout))
            self._format(number, size, name, layout, columns)

    def _format(self, number: int, size: int, name: str, layout: str, columns: str) -> None:
        texts = name.encode(), layout.encode(), columns.encode()
        self.body += _HEAD + b"\x80" + struct.pack("<BB4s16s64s", number, size, *texts)

    def add(self, name: str, usec: int, *values: Any) -> None:
        number, layout, _ = _BIN[name]
        time = usec // 1000 if self._old else usec
        layout = "I" + layout[1:] if self._old else layout
        self.body += _HEAD + bytes([number]) + struct.pack("<" + "".join(_BYTES[c] for c in layout), time, *values)


def dataflash(  # noqa: PLR0913, one for each thing that is changed
    path: Path,
    parameters: Mapping[str, float] | None = None,
    *,
    changes: Iterable[tuple[float, str, float]] = (),
    channels: tuple[int, ...] = tuple(range(8)),
    outputs_every: int = 1,
    leave_out: tuple[str, ...] = (),
    old: bool = False,
    junk_at_s: float | None = None,
    junk: bytes = b"",
    battery: bool = False,
) -> Path:
    """The recording as an ArduPilot log; ``changes`` of parameters (s from the beginning, name, value)."""
    log = DataFlashFile(old=old)
    rows = records()
    first_us = next(m.time_usec for _, _, m in rows if m.get_type() == "HIGHRES_IMU")
    log.add("EV", first_us, 10)
    for name, value in (GOOD_PARAMETERS if parameters is None else parameters).items():
        log.add("PARM", first_us, name.encode(), value)
    waiting, driven, spoilt = sorted(changes), 0, junk_at_s is None
    for stamp, _, m in rows:
        kind = m.get_type()
        if kind == "HIGHRES_IMU" and "IMU" not in leave_out:
            since_s = 1e-6 * (m.time_usec - first_us)
            while waiting and waiting[0][0] <= since_s:
                _, name, value = waiting.pop(0)
                log.add("PARM", m.time_usec, name.encode(), value)
            if not spoilt and junk_at_s is not None and since_s > junk_at_s:
                log.body, spoilt = log.body + junk, True
            log.add("IMU", m.time_usec, 0, m.xgyro, m.ygyro, m.zgyro, m.xacc, m.yacc, m.zacc)
        elif kind == "SERVO_OUTPUT_RAW" and "RCOU" not in leave_out:
            driven += 1
            if driven % outputs_every:
                continue
            pulses = [0] * 14
            for motor, channel in enumerate(channels):
                pulses[channel] = getattr(m, f"servo{motor + 1}_raw")
            log.add("RCOU", m.time_usec, *pulses)
        elif kind == "HEARTBEAT" and battery:
            for k in range(2):
                log.add("BAT", first_us + round(1e6 * (stamp - rows[0][0])), k, 22.0 - k, 23.0)
        elif kind == "ATTITUDE_QUATERNION":
            log.add("XKQ", 1000 * m.time_boot_ms, 0, m.q1, m.q2, m.q3, m.q4)
        elif kind == "LOCAL_POSITION_NED":
            log.add("XKF1", 1000 * m.time_boot_ms, 0, m.vx, m.vy, m.vz, m.x, m.y, m.z)
    path.write_bytes(log.body)
    return path
