"""Ordinary flights of a fleet, kept as the telemetry logs that a ground station would have written."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, dialect
from sitl.fleet import Fleet
from sitl.trials.healthy import Script
from sitl.trials.wire import SYSTEM, WireAutopilot

_STAMP = struct.Struct(">Q")
_STREAMS_HZ = {
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU: 200.0,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 200.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 2.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 2.0,
}
_PARAMETERS = ("MOT_THST_EXPO", "MOT_SPIN_MIN", "MOT_SPIN_MAX", "INS_GYRO_FILTER")  # that a log may tell
_ENDING = 0.45  # of a short flight: the script's, with climb and turns
_AGAIN_S = 5.0, 110.0  # of the healthy script: what comes before gust and payload is flown again


def _script_s(time_s: float, seconds: float) -> float:
    """Where in the script a flight of so many ``seconds`` is: a short one leaves out the middle, not the turns."""
    first, last = _AGAIN_S
    if seconds < last:
        return time_s if time_s < (1.0 - _ENDING) * seconds else last - (seconds - time_s)
    return time_s if time_s < last else first + (time_s - last) % (last - first)


def write(
    fleet: Fleet, paths: list[Path], seconds: float, *, parameters: bool = False, px4: Mapping[str, float] | None = None
) -> None:
    """Fly steps, a square, climbs and turns, and keep what each vehicle tells, one file for each. ``px4``: they are
    PX4s with these parameters that are not stock, and tell all of them where ``parameters`` are asked for."""
    script = Script(fleet)
    codec = Codec(SYSTEM, COMPANION_COMPONENT)
    autopilots = [WireAutopilot(fleet, vehicle, px4=px4) for vehicle in range(fleet.vehicles)]
    for autopilot in autopilots:
        for message_id, rate_hz in _STREAMS_HZ.items():
            ask = dialect.MAVLink_command_long_message(
                SYSTEM, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0
            )
            autopilot.take(codec.pack(ask))
        if parameters and px4 is not None:
            autopilot.take(codec.pack(dialect.MAVLink_param_request_list_message(SYSTEM, 1)))
        for name in _PARAMETERS if parameters and px4 is None else ():
            autopilot.take(codec.pack(dialect.MAVLink_param_request_read_message(SYSTEM, 1, name.encode(), -1)))
    files = [path.open("wb") for path in paths]
    while fleet.time_s < seconds:
        time_s = fleet.time_s
        script.step(_script_s(time_s, seconds))
        for autopilot in autopilots:
            autopilot.scripts()
        fleet.step()
        stamp = _STAMP.pack(round(1e6 * (1_700_000_000.0 + fleet.time_s)))
        for autopilot, file in zip(autopilots, files, strict=True):
            autopilot.telemetry()
            for frame in autopilot.outgoing():
                file.write(stamp + frame)
    for file in files:
        file.close()
