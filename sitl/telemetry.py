"""Messages that the emulated autopilot sends, made from what the autopilot knows (never from the truth)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nff_companion.mavlink.codec import Message, dialect
from sitl import rotation
from sitl.autopilot.autopilot import Autopilot, Mode
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.plant import battery_voltage

HOME_LATITUDE_DEG, HOME_LONGITUDE_DEG, HOME_ALTITUDE_M = -35.363262, 149.165237, 584.0
BOOT_S = 1.0  # the autopilot's clock when the fleet starts
_INTERVAL_MAX_US = 3600e6
_EARTH_RADIUS_M = 6378137.0
_SERVOS = 16
_BATTERY_FULL_V, _CONVERTER_V = 22.2, 60.0 / 4096  # six cells; 12 bits of a power module for 60 V
_CUSTOM_MODE = {Mode.GROUND: 4, Mode.GUIDED: 4, Mode.LAND: 9}
_KINDS = {
    4: dialect.MAV_TYPE_QUADROTOR,
    6: dialect.MAV_TYPE_HEXAROTOR,
    8: dialect.MAV_TYPE_OCTOROTOR,
    10: dialect.MAV_TYPE_DECAROTOR,
    12: dialect.MAV_TYPE_DODECAROTOR,
}  # by motors
_HEALTHY_SENSORS = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_SENSOR_GPS
    | dialect.MAV_SYS_STATUS_AHRS
    | dialect.MAV_SYS_STATUS_PREARM_CHECK
)


def to_global(position_m: NDArray[np.float64]) -> tuple[int, int, int]:
    """Latitude and longitude in 1e-7 degrees, altitude in mm, of a NED position."""
    latitude = HOME_LATITUDE_DEG + math.degrees(position_m[0] / _EARTH_RADIUS_M)
    longitude = HOME_LONGITUDE_DEG + math.degrees(
        position_m[1] / (_EARTH_RADIUS_M * math.cos(math.radians(HOME_LATITUDE_DEG)))
    )
    return round(1e7 * latitude), round(1e7 * longitude), round(1e3 * (HOME_ALTITUDE_M - position_m[2]))


def to_local(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """North and east in m of a place."""
    north = math.radians(latitude_deg - HOME_LATITUDE_DEG) * _EARTH_RADIUS_M
    east = math.radians(longitude_deg - HOME_LONGITUDE_DEG) * _EARTH_RADIUS_M
    return north, east * math.cos(math.radians(HOME_LATITUDE_DEG))


class Telemetry:
    """Makes each message for one vehicle of a fleet; ``makers`` by message id."""

    def __init__(self, fleet: Fleet, vehicle: int = 0) -> None:
        self._fleet, self._i = fleet, vehicle
        self._groups: dict[str, int] = {}
        ids = dialect
        self.makers: dict[int, Callable[[], Message]] = {
            ids.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            ids.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended,
            ids.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery,
            ids.MAVLINK_MSG_ID_HOME_POSITION: self._home,
            ids.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps,
            ids.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            ids.MAVLINK_MSG_ID_ATTITUDE: self._attitude_euler,
            ids.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._version,
            ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude,
            ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            ids.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: self._position_target,
            ids.MAVLINK_MSG_ID_ATTITUDE_TARGET: self._attitude_target,
            ids.MAVLINK_MSG_ID_NFF_APPLIED: self._applied,
            ids.MAVLINK_MSG_ID_ESC_STATUS: self._esc_status,
            ids.MAVLINK_MSG_ID_ESC_INFO: self._esc_info,
            ids.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4: lambda: self._esc_telemetry(0),
            ids.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8: lambda: self._esc_telemetry(4),
            ids.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12: lambda: self._esc_telemetry(8),
            ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: self._servos,
            # Last: who waits for the inertial sample has the rest of the cycle.
            ids.MAVLINK_MSG_ID_HIGHRES_IMU: self._imu,
        }

    def cycles(self, message_id: int, interval_us: float) -> int | None:
        """Autopilot cycles between two of a message when so much is asked for; None: that is refused."""
        if not 1e6 / AUTOPILOT_RATE_HZ - 1 <= interval_us <= _INTERVAL_MAX_US:  # NaN too
            return None
        return max(round(1e-6 * interval_us * AUTOPILOT_RATE_HZ), 1)

    @property
    def _autopilot(self) -> Autopilot:
        return self._fleet.autopilot

    @property
    def time_usec(self) -> int:
        """The autopilot's clock: 1 s since its boot when the fleet starts."""
        return round(1e6 * (self._fleet.time_s + BOOT_S))

    @property
    def time_ms(self) -> int:
        """The same in ms."""
        return self.time_usec // 1000

    def _heartbeat(self) -> Message:
        armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED if self._autopilot.armed[self._i] else 0
        state = dialect.MAV_STATE_ACTIVE if self._autopilot.armed[self._i] else dialect.MAV_STATE_STANDBY
        mode = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED | armed
        return dialect.MAVLink_heartbeat_message(
            _KINDS.get(self._fleet.parameters.motors, dialect.MAV_TYPE_GENERIC_MULTIROTOR),
            dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
            mode,
            _CUSTOM_MODE[Mode(int(self._autopilot.mode[self._i]))],
            state,
            3,
        )

    def _sys_status(self) -> Message:
        return dialect.MAVLink_sys_status_message(
            _HEALTHY_SENSORS, _HEALTHY_SENSORS, _HEALTHY_SENSORS, 300, self._battery_mv(), -1, 80, 0, 0, 0, 0, 0, 0
        )

    def _battery_mv(self) -> int:
        """In steps of the converter that measures it."""
        volts = _BATTERY_FULL_V * float(battery_voltage(self._fleet.state, self._fleet.parameters)[self._i])
        return round(1e3 * _CONVERTER_V * round(volts / _CONVERTER_V))

    def _battery(self) -> Message:
        return dialect.MAVLink_battery_status_message(0, 0, 0, 2500, [self._battery_mv()] + [65535] * 9, -1, -1, -1, 80)

    def _extended(self) -> Message:
        flying = self._autopilot.mode[self._i] != Mode.GROUND
        height = -float(self._fleet.sensors.measured.position_m[self._i, 2])
        landed = dialect.MAV_LANDED_STATE_IN_AIR if flying and height > 0.3 else dialect.MAV_LANDED_STATE_ON_GROUND
        if self._autopilot.mode[self._i] == Mode.LAND:
            landed = dialect.MAV_LANDED_STATE_LANDING
        return dialect.MAVLink_extended_sys_state_message(0, landed)

    def _home(self) -> Message:
        place = to_global(np.zeros(3))
        return dialect.MAVLink_home_position_message(*place, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0)

    def _gps(self) -> Message:
        place = to_global(self._fleet.sensors.measured.position_m[self._i])
        return dialect.MAVLink_gps_raw_int_message(self.time_usec, 6, *place, 70, 90, 0, 0, 14)

    def _global_position(self) -> Message:
        measured = self._fleet.sensors.measured
        place = to_global(measured.position_m[self._i])
        velocity = [round(100 * float(v)) for v in measured.velocity_m_s[self._i]]
        heading = round(100 * math.degrees(float(rotation.yaw_of(measured.quaternion[self._i])))) % 36000
        above = round(-1e3 * float(measured.position_m[self._i, 2]))
        return dialect.MAVLink_global_position_int_message(self.time_ms, *place, above, *velocity, heading)

    def _attitude_euler(self) -> Message:
        w, x, y, z = (float(v) for v in self._fleet.sensors.measured.quaternion[self._i])
        rates = [float(v) for v in self._fleet.sensors.measured.gyro_rad_s[self._i]]
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return dialect.MAVLink_attitude_message(self.time_ms, roll, pitch, yaw, *rates)

    def _version(self) -> Message:
        capabilities = (
            dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
        )
        return dialect.MAVLink_autopilot_version_message(
            capabilities, 0x04070000, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 1
        )

    def _attitude(self) -> Message:
        measured = self._fleet.sensors.measured
        return dialect.MAVLink_attitude_quaternion_message(
            self.time_ms, *measured.quaternion[self._i].tolist(), *measured.gyro_rad_s[self._i].tolist(), [0.0] * 4
        )

    def _local_position(self) -> Message:
        measured = self._fleet.sensors.measured
        return dialect.MAVLink_local_position_ned_message(
            self.time_ms, *measured.position_m[self._i].tolist(), *measured.velocity_m_s[self._i].tolist()
        )

    def _position_target(self) -> Message:
        position = self._autopilot.position
        yaw = float(rotation.yaw_of(self._autopilot.attitude.target[self._i]))
        return dialect.MAVLink_position_target_local_ned_message(
            self.time_ms,
            dialect.MAV_FRAME_LOCAL_NED,
            0,
            *position.path[self._i].tolist(),
            *position.path_velocity[self._i].tolist(),
            *position.path_acceleration[self._i].tolist(),
            yaw,
            0.0,
        )

    def _attitude_target(self) -> Message:
        attitude = self._autopilot.attitude
        return dialect.MAVLink_attitude_target_message(
            self.time_ms,
            0,
            attitude.target[self._i].tolist(),
            *attitude.target_rate[self._i].tolist(),
            float(np.clip(self._autopilot.throttle[self._i], 0.0, 1.0)),
        )

    def _servos(self) -> Message:
        p = self._fleet.parameters
        pwm = [round(float(v)) for v in p.pwm_min + (p.pwm_max - p.pwm_min) * self._autopilot.output[self._i]]
        pwm += [0] * (_SERVOS - len(pwm))
        return dialect.MAVLink_servo_output_raw_message(self.time_usec % 2**32, 0, *pwm[:8], *pwm[8:])

    def _rpm(self) -> NDArray[np.int_]:
        """(m,) rotor speeds as ESCs would measure them."""
        p = self._fleet.parameters
        speed = np.sqrt(self._fleet.state.thrust_n[self._i] / p.max_thrust_n[self._i]) * p.max_speed_rad_s
        return np.round(speed * 60 / (2 * math.pi)).astype(int)

    def _four(self, first: int) -> list[int]:
        rpm = self._rpm()[first : first + 4].tolist()
        return rpm + [0] * (4 - len(rpm))

    def _next_group(self, name: str) -> int:
        """Index of the first motor of the group of four whose turn it is."""
        groups = (self._fleet.parameters.motors + 3) // 4
        self._groups[name] = (self._groups.get(name, -1) + 1) % groups
        return 4 * self._groups[name]

    def _esc_status(self) -> Message:
        first = self._next_group("status")
        return dialect.MAVLink_esc_status_message(first, self.time_usec, self._four(first), [22.2] * 4, [0.0] * 4)

    def _esc_info(self) -> Message:
        first, motors = self._next_group("info"), self._fleet.parameters.motors
        online = sum(1 << k for k in range(min(4, motors - first)))
        return dialect.MAVLink_esc_info_message(
            first, self.time_usec, self._fleet.cycle % 65536, motors, 2, online, [0] * 4, [0] * 4, [3000] * 4
        )

    def _esc_telemetry(self, first: int) -> Message:
        name = {0: "1_to_4", 4: "5_to_8", 8: "9_to_12"}[first]
        make = getattr(dialect, f"MAVLink_esc_telemetry_{name}_message")
        count = [self._fleet.cycle % 65536] * 4
        return make([30] * 4, [2220] * 4, [0] * 4, [0] * 4, self._four(first), count)

    def _imu(self) -> Message:
        measured = self._fleet.sensors.measured
        return dialect.MAVLink_highres_imu_message(
            self.time_usec,
            *measured.specific_force_m_s2[self._i].tolist(),
            *measured.gyro_rad_s[self._i].tolist(),
            0.2,
            0.0,
            0.4,
            950.0,
            0.0,
            0.0,
            25.0,
            0x3F,
        )

    def _applied(self) -> Message:
        port = self._autopilot.ports[self._i]
        mask = int((1 << np.flatnonzero(port.failed)).sum())
        refused = [min(v, 65535) for v in port.refused.values()]
        return dialect.MAVLink_nff_applied_message(
            self.time_usec,
            port.matrix_echo,
            port.override_echo,
            port.declaration_sequence,
            mask,
            port.accepted,
            *refused,
            int(self._autopilot.allocation[self._i]),
        )
