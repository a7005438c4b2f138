"""MAVLink telemetry to samples; the same for a live link and for a tlog.

One sample a HIGHRES_IMU, with the newest of everything else: autopilots send it at the highest rate, with the time of
the measurement. Motor outputs older than ``OUTPUT_AGE_MAX_S`` make the sample unusable (NaN), so that a stream that
stopped is never mistaken for motors that stand still.

A time is since boot or since 1970, and one autopilot may send both: each message's clock is compared with that of
HIGHRES_IMU.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import Message, dialect

OUTPUT_AGE_MAX_S = 0.1
STATE_AGE_MAX_S = 0.5
ATTITUDE_AGE_MAX_S = 0.1
MOVED_MAX_S = 0.15  # a position is carried on by its velocity for so long
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_MAX_SERVOS = 16
_WRAP_S = 1e-6 * 2**32  # SERVO_OUTPUT_RAW has 32 bits of microseconds: 71.6 minutes
_SAME_TIME_S = 1e-5  # times of one clock, seen through another's rounding (Unix time: to 0.2 us)
_OTHER_CLOCK_S = 10.0  # no message is as old as this: it is another clock
_FOLLOWED = 0.05  # s/s by which another clock may fall behind and still be followed
_IGNORES_VELOCITY = (
    dialect.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_VZ_IGNORE
)
_IGNORES_ACCELERATION = (
    dialect.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_FORCE_SET
)
_IGNORES_POSITION = (
    dialect.POSITION_TARGET_TYPEMASK_X_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Z_IGNORE
)
_RPM = 2.0 * np.pi / 60.0
_ESC_FIRST = {"ESC_TELEMETRY_1_TO_4": 0, "ESC_TELEMETRY_5_TO_8": 4, "ESC_TELEMETRY_9_TO_12": 8}


class _Clock:
    """Times of one kind of message, in the time of HIGHRES_IMU. Ages are real where both are of one clock; else the
    youngest message counts as new."""

    def __init__(self, wrap_s: float = 0.0) -> None:
        """``wrap_s``: after so long the time begins anew; 0: never."""
        self._wrap_s, self._shift_s = wrap_s, 0.0
        self._last_s, self._advanced_s = np.nan, -np.inf  # the last stamp, and the sample at which it was new

    def age_s(self, stamp_s: float, now_s: float) -> float:
        """Of a message that has just come, at a sample of ``now_s``."""
        age_s = self._between(stamp_s + self._shift_s, now_s)
        if stamp_s == self._last_s:  # a time that stands still is old, no other clock
            return age_s
        if abs(age_s) > _OTHER_CLOCK_S:
            age_s = self._between(stamp_s, now_s)
            self._shift_s = 0.0 if abs(age_s) <= _OTHER_CLOCK_S else age_s
            age_s -= self._shift_s
        elif self._shift_s:  # clocks drift apart, and are set
            move_s = min(age_s, _FOLLOWED * max(now_s - self._advanced_s, 0.0))
            self._shift_s += move_s
            age_s -= move_s
        self._last_s, self._advanced_s = stamp_s, now_s
        return age_s

    def _between(self, stamp_s: float, now_s: float) -> float:
        if not self._wrap_s:
            return now_s - stamp_s
        return (now_s - stamp_s + 0.5 * self._wrap_s) % self._wrap_s - 0.5 * self._wrap_s


class TelemetryDecoder:
    """Remembers the newest of each message."""

    def __init__(self, vehicle: Vehicle, channels: Sequence[int] | None = None) -> None:
        """``channels`` (from 0) of the motors' outputs; None: in the motors' order."""
        self._vehicle = vehicle
        if channels is None:
            channels = range(min(vehicle.motors, _MAX_SERVOS))
        self._pulses = attrgetter(*[f"servo{k + 1}_raw" for k in channels])
        self._armed: bool | None = None  # not heard
        self._beyond = f"servo{vehicle.motors + 1}_raw" if vehicle.motors < _MAX_SERVOS else ""
        self.drives_more = False  # outputs than the airframe has motors
        self._output: NDArray[np.float64] = np.full(vehicle.motors, np.nan)
        self._output_s = -np.inf
        self._quaternion: NDArray[np.float64] | None = None
        self._quaternion_s = -np.inf
        self._position: NDArray[np.float64] | None = None
        self._velocity: NDArray[np.float64] | None = None
        self._position_s = -np.inf
        self._target: NDArray[np.float64] | None = None
        self._target_yaw: float | None = None
        self._target_velocity: NDArray[np.float64] | None = None
        self._target_acceleration: NDArray[np.float64] | None = None
        self._target_s = -np.inf
        self._landed: bool | None = None
        m = vehicle.motors
        self._speed, self._speed_s = np.full(m, np.nan), np.full(m, np.nan)
        self._speed_count = np.full(m, -1)
        self._now_s: float | None = None  # of the last inertial sample
        self._clocks: dict[tuple[str, int], _Clock] = {("SERVO_OUTPUT_RAW", 0): _Clock(_WRAP_S)}
        self._handlers = {
            "HIGHRES_IMU": self._imu,
            "SERVO_OUTPUT_RAW": self._servos,
            "ATTITUDE_QUATERNION": self._attitude,
            "LOCAL_POSITION_NED": self._local_position,
            "POSITION_TARGET_LOCAL_NED": self._position_target,
            "HEARTBEAT": self._heartbeat,
            "EXTENDED_SYS_STATE": self._extended_state,
            "ESC_STATUS": self._esc_status,
            "ESC_TELEMETRY_1_TO_4": self._esc_telemetry,
            "ESC_TELEMETRY_5_TO_8": self._esc_telemetry,
            "ESC_TELEMETRY_9_TO_12": self._esc_telemetry,
        }

    @property
    def armed(self) -> bool | None:
        """By the autopilot's word; None: it has not said."""
        return self._armed

    def observe(self, message: Message) -> Sample | None:
        """Take one message of the autopilot; the sample that it completes, if any."""
        handler = self._handlers.get(message.get_type())
        return None if handler is None else handler(message)

    def _heartbeat(self, message: Message) -> None:
        self._armed = bool(message.base_mode & _ARMED)

    def _extended_state(self, message: Message) -> None:
        state = message.landed_state
        self._landed = None if state == 0 else state == dialect.MAV_LANDED_STATE_ON_GROUND

    def _servos(self, message: Message) -> None:
        if message.port != 0:
            return
        if self._vehicle.motors > _MAX_SERVOS:
            return
        pulses = self._pulses(message)
        self._output = self._vehicle.output_of_pwm(np.array(pulses, float))
        if self._armed and min(pulses) <= 0:
            # An output that an armed autopilot does not drive is no motor: the airframe is another one.
            self._output = np.full_like(self._output, np.nan)
        self._output_s = self._time_s(message, 1e-6 * message.time_usec)
        self.drives_more = bool(self._beyond) and getattr(message, self._beyond) > 0

    def _esc_status(self, message: Message) -> None:
        """Four motors from ``index``, at the time of the message; a message that repeats itself is not new."""
        read_s = self._time_s(message, 1e-6 * message.time_usec, message.index)
        for k, rpm in enumerate(message.rpm):
            motor = message.index + k
            if motor < self._vehicle.motors and not abs(read_s - self._speed_s[motor]) < _SAME_TIME_S:
                self._read_speed(motor, abs(rpm) * _RPM, read_s)

    def _esc_telemetry(self, message: Message) -> None:
        """Four servo outputs; ``count`` grows with each reading of the ESC, and stands when it says no more."""
        first = _ESC_FIRST[message.get_type()]
        for k, (rpm, count) in enumerate(zip(message.rpm, message.count, strict=True)):
            motor = first + k
            if motor < self._vehicle.motors and count != self._speed_count[motor]:
                self._speed_count[motor] = count
                self._read_speed(motor, rpm * _RPM, self._now_s or 0.0)

    def _read_speed(self, index: int, speed_rad_s: float, read_s: float) -> None:
        """Into new arrays: the samples before keep theirs."""
        self._speed, self._speed_s = self._speed.copy(), self._speed_s.copy()
        self._speed[index], self._speed_s[index] = speed_rad_s, read_s

    def _attitude(self, message: Message) -> None:
        self._quaternion = np.array([message.q1, message.q2, message.q3, message.q4])
        self._quaternion_s = self._time_s(message, 1e-3 * message.time_boot_ms)

    def _local_position(self, message: Message) -> None:
        self._position = np.array([message.x, message.y, message.z])
        self._velocity = np.array([message.vx, message.vy, message.vz])
        self._position_s = self._time_s(message, 1e-3 * message.time_boot_ms)

    def _position_target(self, message: Message) -> None:
        # A field that is marked as ignored is sent as zero: the origin, and north.
        ignored = message.type_mask
        self._target = None if ignored & _IGNORES_POSITION else np.array([message.x, message.y, message.z])
        self._target_velocity = None if ignored & _IGNORES_VELOCITY else np.array([message.vx, message.vy, message.vz])
        self._target_acceleration = (
            None if ignored & _IGNORES_ACCELERATION else np.array([message.afx, message.afy, message.afz])
        )
        self._target_yaw = None if ignored & dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE else message.yaw
        self._target_s = self._time_s(message, 1e-3 * message.time_boot_ms)

    def _time_s(self, message: Message, stamp_s: float, index: int = 0) -> float:
        """Time of a message in that of the samples; before the first of them as it stands. Messages of one kind and
        another ``index`` are other streams, of which one may stop."""
        if self._now_s is None:
            return stamp_s
        stream = message.get_type(), index
        clock = self._clocks.get(stream)
        if clock is None:
            clock = self._clocks[stream] = _Clock()
        return self._now_s - clock.age_s(stamp_s, self._now_s)

    @staticmethod
    def _moved(
        position: NDArray[np.float64] | None, velocity: NDArray[np.float64] | None, age_s: float
    ) -> NDArray[np.float64] | None:
        """Where it is by now: positions and targets come less often than samples, and a step in them is answered with
        a jerk (at 7.5 m/s and 20 Hz one of 0.4 m)."""
        if position is None or velocity is None or not 0.0 < age_s <= MOVED_MAX_S:
            return position
        return position + velocity * age_s

    def _imu(self, message: Message) -> Sample:
        time_s = 1e-6 * message.time_usec
        if self._now_s is None and np.isfinite(self._output_s):
            # Outputs that came first, by a clock that may have wrapped.
            self._output_s = time_s - self._clocks["SERVO_OUTPUT_RAW", 0].age_s(self._output_s, time_s)
        self._now_s = time_s
        fresh = abs(time_s - self._output_s) <= OUTPUT_AGE_MAX_S
        located = abs(time_s - self._position_s) <= STATE_AGE_MAX_S
        aimed = abs(time_s - self._target_s) <= STATE_AGE_MAX_S
        return Sample(
            time_s=time_s,
            gyro_rad_s=np.array([message.xgyro, message.ygyro, message.zgyro]),
            specific_force_m_s2=np.array([message.xacc, message.yacc, message.zacc]),
            output=self._output if fresh else np.full_like(self._output, np.nan),
            armed=bool(self._armed),
            quaternion=self._quaternion if abs(time_s - self._quaternion_s) <= ATTITUDE_AGE_MAX_S else None,
            position_m=self._moved(self._position, self._velocity, time_s - self._position_s) if located else None,
            velocity_m_s=self._velocity if located else None,
            target_position_m=self._moved(self._target, self._target_velocity, time_s - self._target_s)
            if aimed
            else None,
            target_yaw_rad=self._target_yaw if aimed else None,
            target_velocity_m_s=self._target_velocity if aimed else None,
            target_acceleration_m_s2=self._target_acceleration if aimed else None,
            landed=self._landed,
            rotor_speed_rad_s=self._speed,
            rotor_speed_time_s=self._speed_s,
        )
