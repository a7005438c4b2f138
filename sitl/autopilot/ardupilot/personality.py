"""One vehicle of the fleet as ArduPilot to its scripts and to whoever speaks MAVLink with it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.ardupilot.lua_host import LuaHost
from sitl.autopilot.ardupilot.port import ScriptedPort
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet

_FRAME = 10  # bytes of a MAVLink 2 frame before its payload
_PAYLOAD = 255
_BOOT_S = 1.0  # the autopilot's clock when the fleet starts
_SCRIPTED_FRAME = 17
_EVERY = 2  # cycles between runs of the scripts: about 200 Hz
_MOTOR_FUNCTIONS = [*range(33, 41), *range(82, 86)]
_AXES = 4


class ArduPilotPersonality:
    """``folder`` holds the scripts as they would lie on the autopilot's card."""

    def __init__(self, fleet: Fleet, vehicle: int, folder: Path, parameters: dict[str, float], system: int = 1) -> None:
        self._fleet, self._vehicle, self.system = fleet, vehicle, system
        self.parameters = parameters
        motors = fleet.parameters.motors
        p = fleet.parameters
        for name, value in {
            "MAV_SYSID": float(system),
            "SCR_ENABLE": 1.0,
            "FLIGHT_OPTIONS": 1.0,
            "MOT_PWM_MIN": p.pwm_min,
            "MOT_PWM_MAX": p.pwm_max,
            "INS_ACCEL_FILTER": float(p.accelerometer_filter_hz[0]),
            **{f"SERVO{i}_FUNCTION": float(_MOTOR_FUNCTIONS[i - 1]) for i in range(1, motors + 1)},
        }.items():
            parameters.setdefault(name, value)
        self.port = ScriptedPort(motors, 1.0 / AUTOPILOT_RATE_HZ)
        self.pilot_stops = False
        self.texts: list[tuple[float, int, str]] = []
        self._motors_added: set[int] = set()
        self._initialised = False
        self._tables: dict[int, str] = {}
        self._sent: list[tuple[int, Message]] = []
        self.scripts = LuaHost(folder, self)
        if self.scripted_frame:
            fleet.autopilot.scripted[vehicle] = self.port
        else:
            fleet.autopilot.overridden[vehicle] = self.port
        self.scripts.step()

    @property
    def scripted_frame(self) -> bool:
        """Whether the frame's factors come from a script; decided at boot."""
        return self.parameters.get("FRAME_CLASS") == _SCRIPTED_FRAME

    @property
    def can_arm(self) -> bool:
        """A scripted frame arms only once a script has initialised its motors."""
        return self._initialised or not self.scripted_frame

    def step(self) -> None:
        """To be called at each autopilot cycle."""
        if self._fleet.cycle % _EVERY == 0:
            self.scripts.step()

    def receive(self, message: Message, channel: int) -> None:
        """A message addressed to the autopilot, as scripts get it: a ``mavlink_message_t``."""
        frame = bytes(message.get_msgbuf())
        payload = frame[_FRAME : _FRAME + frame[1]]
        head = struct.pack("<HBBBBBBB", 0, frame[0], frame[1], 0, 0, frame[4], frame[5], frame[6]) + frame[7:10]
        self.scripts.receive(message.get_msgId(), head + payload.ljust(_PAYLOAD, b"\0"), channel)

    def outgoing(self) -> list[tuple[int, Message]]:
        """What scripts have sent since the last call: channel and message."""
        sent, self._sent = self._sent, []
        return sent

    # -- bindings -----------------------------------------------------------------------------------------------

    def millis(self) -> int:
        """Milliseconds since boot."""
        return int(1e3 * (self._fleet.time_s + _BOOT_S) + 1e-6)

    def micros(self) -> int:
        """Microseconds since boot."""
        return round(1e6 * (self._fleet.time_s + _BOOT_S))

    def parameter(self, name: bytes) -> float | None:
        """Value, None for an unknown name."""
        return self.parameters.get(name.decode())

    def set_parameter(self, name: bytes, value: float) -> bool:
        """Set without saving."""
        self.parameters[name.decode()] = float(np.float32(value))
        return True

    def add_table(self, key: int, prefix: bytes, count: int) -> bool:
        """A table of parameters for a script."""
        return self._tables.setdefault(key, prefix.decode()) == prefix.decode()

    def add_parameter(self, key: int, index: int, name: bytes, value: float) -> bool:
        """A parameter in such a table."""
        self.parameters.setdefault(self._tables[key] + name.decode(), float(value))
        return True

    def armed(self) -> bool:
        """Whether the vehicle is armed."""
        return bool(self._fleet.autopilot.armed[self._vehicle])

    def interlock(self) -> bool:
        """Whether the pilot's motor interlock lets the motors run."""
        return not self.pilot_stops

    def emergency_stop(self) -> bool:
        """Whether the pilot has stopped the motors."""
        return self.pilot_stops

    def text(self, severity: int, text: bytes) -> None:
        """STATUSTEXT."""
        said = text.decode(errors="replace")
        self.texts.append((self._fleet.time_s, severity, said))
        self._sent.append((-1, dialect.MAVLink_statustext_message(severity, said.encode())))

    def channel_of(self, function: int) -> int | None:
        """Servo channel (from 0) of a function."""
        for channel in range(self._fleet.parameters.motors):
            if self.parameters.get(f"SERVO{channel + 1}_FUNCTION") == function:
                return channel
        return None

    def override(self, channel: int, pwm: int, timeout_ms: int) -> None:
        """Hold a servo channel."""
        if channel < self._fleet.parameters.motors:
            self.port.override(channel, pwm, timeout_ms, self._fleet.time_s)

    def add_motor(self, motor: int, order: int) -> bool:
        """A motor of the scripted frame."""
        if self._initialised:
            return False
        self._motors_added.add(motor)
        return True

    def load_factors(self, *flat: float) -> None:
        """Factors of all motors."""
        table = np.array(flat, np.float32).astype(float).reshape(-1, _AXES)
        self.port.factors = table[: self._fleet.parameters.motors]

    def init_motors(self, count: int) -> bool:
        """Whether the scripted frame is complete."""
        self._initialised = self.port.factors is not None and len(self._motors_added) == count
        return self._initialised

    def send(self, channel: int, message_id: int, packet: bytes) -> bool:
        """Send a message of the firmware's own dialect."""
        if message_id != dialect.MAVLINK_MSG_ID_TUNNEL:
            raise ValueError(f"message {message_id} is not one that our scripts send")
        payload_type, system, component, length = struct.unpack_from("<HBBB", packet)
        body = list(packet[5 : 5 + 128].ljust(128, b"\0"))
        self._sent.append((channel, dialect.MAVLink_tunnel_message(system, component, payload_type, length, body)))
        return True
