"""Messages as PX4 sends them: its heartbeat and version, pulses of its outputs, integrated inertial samples."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.autopilot import Mode
from sitl.autopilot.px4.mixer import Px4Mixer
from sitl.autopilot.px4.parameters import ParameterTable
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.telemetry import Telemetry

V1_16 = 0x011000FF  # a release
MAIN_AUTO, TAKE_OFF, HOLD, LAND = 4, 2, 3, 6  # of custom modes: main, and sub of auto
_SUB_MODES = {Mode.GROUND: HOLD, Mode.GUIDED: HOLD, Mode.LAND: LAND}
_AUTO_FLAGS = (
    dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    | dialect.MAV_MODE_FLAG_AUTO_ENABLED
    | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    | dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
)
_OUTPUTS = 32  # of ACTUATOR_OUTPUT_STATUS
_SERVOS = 16
_ROUNDING = 0.01  # of a cycle
_UNIQUE_ID = 7
# Ours, and what ArduPilot alone sends.
_UNKNOWN = (
    dialect.MAVLINK_MSG_ID_NFF_APPLIED,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12,
)


class Px4Telemetry(Telemetry):
    """``noted`` is called once a cycle, before the loops: HIGHRES_IMU holds the mean of an integration."""

    def __init__(self, fleet: Fleet, vehicle: int, table: ParameterTable, mixer: Px4Mixer) -> None:
        super().__init__(fleet, vehicle)
        self._table, self._mixer = table, mixer
        self._inertial: deque[NDArray[np.float64]] = deque(maxlen=AUTOPILOT_RATE_HZ)
        for message_id in _UNKNOWN:
            del self.makers[message_id]
        self.makers = {dialect.MAVLINK_MSG_ID_ACTUATOR_OUTPUT_STATUS: self._output_status} | self.makers

    @property
    def _integrated_cycles(self) -> int:
        """Autopilot cycles of one integration, IMU_INTEG_RATE; the emulated IMU cannot be integrated over less."""
        return max(math.ceil(AUTOPILOT_RATE_HZ / max(self._table["IMU_INTEG_RATE"], 1.0) - _ROUNDING), 1)

    def cycles(self, message_id: int, interval_us: float) -> int | None:
        """A message goes out when its topic is renewed and the interval is over: an interval a little above that of the
        topic halves the rate."""
        if not 0.0 < interval_us < math.inf:
            return None
        topic = self._integrated_cycles if message_id == dialect.MAVLINK_MSG_ID_HIGHRES_IMU else 1
        return topic * max(math.ceil(1e-6 * interval_us * AUTOPILOT_RATE_HZ / topic - _ROUNDING), 1)

    def noted(self) -> None:
        """Keep the inertial sample of the cycle before."""
        self._inertial.append(self._sample())

    def _sample(self) -> NDArray[np.float64]:
        measured = self._fleet.sensors.measured
        return np.concatenate([measured.specific_force_m_s2[self._i], measured.gyro_rad_s[self._i]])

    def _imu(self) -> Message:
        before = list(self._inertial)[1 - self._integrated_cycles :] if self._integrated_cycles > 1 else []
        mean = np.mean([*before, self._sample()], axis=0)
        return dialect.MAVLink_highres_imu_message(
            self.time_usec, *mean.tolist(), 0.2, 0.0, 0.4, 950.0, 0.0, 0.0, 25.0, 0x3F
        )

    def _heartbeat(self) -> Message:
        armed = bool(self._autopilot.armed[self._i])
        mode = Mode(int(self._autopilot.mode[self._i]))
        return dialect.MAVLink_heartbeat_message(
            self._table.whole("MAV_TYPE"),
            dialect.MAV_AUTOPILOT_PX4,
            _AUTO_FLAGS | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0),
            MAIN_AUTO << 16 | _SUB_MODES[mode] << 24,
            dialect.MAV_STATE_ACTIVE if armed else dialect.MAV_STATE_STANDBY,
            3,
        )

    def _version(self) -> Message:
        capabilities = (
            dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
            | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
            | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        )
        none = [0] * 8
        return dialect.MAVLink_autopilot_version_message(
            capabilities, V1_16, 0, V1_16, 0, none, none, none, 0, 0, _UNIQUE_ID
        )

    def _servos(self) -> Message:
        pulses = [round(float(v)) for v in self._mixer.pulses_us[:_SERVOS]]
        pulses += [0] * (_SERVOS - len(pulses))
        return dialect.MAVLink_servo_output_raw_message(self.time_usec % 2**32, 0, *pulses[:8], *pulses[8:])

    def _output_status(self) -> Message:
        pulses = self._mixer.pulses_us.tolist()
        active = (1 << len(pulses)) - 1
        return dialect.MAVLink_actuator_output_status_message(
            self.time_usec, active, pulses + [0.0] * (_OUTPUTS - len(pulses))
        )

    def _rpm(self) -> NDArray[np.int_]:
        """As PX4's own simulator has them: made of the outputs, so that no failure ever shows in them."""
        full = self._fleet.parameters.max_speed_rad_s * 60.0 / (2.0 * math.pi)
        return np.round(full * self._autopilot.output[self._i]).astype(int)
