"""Commands and parameters that the emulated autopilot answers, for vehicle 0 of a fleet."""

from __future__ import annotations

import math

import numpy as np

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.autopilot import Mode
from sitl.faults import Fault
from sitl.fleet import Fleet
from sitl.telemetry import HOME_ALTITUDE_M, Telemetry, to_local

_OK = dialect.MAV_RESULT_ACCEPTED
_DENIED = dialect.MAV_RESULT_DENIED
_UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED
_LAND_MODE, _GUIDED_MODE = 9, 4
_DEFAULT_TAKE_OFF_M = 10.0


class Commander:
    """Executes commands; ``params`` is the parameter table (name to value)."""

    def __init__(self, fleet: Fleet, telemetry: Telemetry, system: int) -> None:
        self._fleet, self._telemetry, self.system = fleet, telemetry, system
        self.params: dict[str, float] = {
            "SYSID_THISMAV": float(system),
            "FRAME_CLASS": 17.0,
            "FRAME_TYPE": 1.0,
            "MOT_THST_EXPO": fleet.parameters.thrust_expo,
            "MOT_SPIN_MIN": fleet.parameters.spin_min,
            "MOT_SPIN_MAX": fleet.parameters.spin_max,
            "INS_GYRO_FILTER": fleet.parameters.gyro_filter_hz,
            "WPNAV_SPEED": 500.0,
            "SIM_SPEEDUP": 1.0,
        }

    def command(self, message: Message) -> tuple[int, list[Message]]:
        """Result and extra messages of COMMAND_LONG or COMMAND_INT (stream requests are the server's)."""
        handlers = {
            dialect.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            dialect.MAV_CMD_NAV_TAKEOFF: self._take_off,
            dialect.MAV_CMD_NAV_LAND: self._land,
            dialect.MAV_CMD_DO_SET_MODE: self._set_mode,
            dialect.MAV_CMD_DO_REPOSITION: self._reposition,
            dialect.MAV_CMD_DO_CHANGE_SPEED: self._speed,
            dialect.MAV_CMD_INJECT_FAILURE: self._inject,
            dialect.MAV_CMD_REQUEST_MESSAGE: self._request_message,
        }
        handler = handlers.get(message.command)
        if handler is None:
            return _UNSUPPORTED, []
        return handler(message)

    def _arm(self, message: Message) -> tuple[int, list[Message]]:
        autopilot = self._fleet.autopilot
        if message.param1 >= 0.5:
            autopilot.arm(0)
            return _OK, []
        forced = message.param2 == 21196
        if autopilot.mode[0] != Mode.GROUND and not forced:
            return _DENIED, []
        autopilot.disarm(0)
        return _OK, []

    def _take_off(self, message: Message) -> tuple[int, list[Message]]:
        autopilot = self._fleet.autopilot
        if not autopilot.armed[0] or autopilot.mode[0] != Mode.GROUND:
            return _DENIED, []
        height = self._altitude(message)
        autopilot.take_off(0, _DEFAULT_TAKE_OFF_M if height is None else height, self._fleet.sensors.measured)
        return _OK, []

    @staticmethod
    def _altitude(message: Message) -> float | None:
        """Height above home of a command that carries an altitude in param7 (z), None when it carries none."""
        value = message.z if hasattr(message, "z") else message.param7
        if not math.isfinite(value) or value <= 0.0:
            return None
        # COMMAND_INT says in which frame; a height far above home can only be above the sea.
        return value - HOME_ALTITUDE_M if value > 0.5 * HOME_ALTITUDE_M else value

    def _land(self, _: Message) -> tuple[int, list[Message]]:
        if self._fleet.autopilot.mode[0] == Mode.GROUND:
            return _DENIED, []
        self._fleet.autopilot.land(0)
        return _OK, []

    def _set_mode(self, message: Message) -> tuple[int, list[Message]]:
        return self.set_mode(int(message.param2)), []

    def set_mode(self, custom_mode: int) -> int:
        """Result of a change of mode (4 guided, 9 land)."""
        autopilot = self._fleet.autopilot
        if custom_mode == _LAND_MODE and autopilot.mode[0] != Mode.GROUND:
            autopilot.land(0)
            return int(_OK)
        if custom_mode == _GUIDED_MODE:
            return int(_OK)
        return int(_DENIED)

    def _reposition(self, message: Message) -> tuple[int, list[Message]]:
        if self._fleet.autopilot.mode[0] != Mode.GUIDED:
            return _DENIED, []
        if message.get_type() == "COMMAND_INT":
            latitude, longitude = 1e-7 * message.x, 1e-7 * message.y
        else:
            latitude, longitude = message.param5, message.param6
        north, east = to_local(latitude, longitude)
        height = self._altitude(message)
        goal = self._fleet.autopilot.position.goal[0]
        return self.go_to(np.array([north, east, goal[2] if height is None else -height]), message.param4), []

    def go_to(self, position_m: np.ndarray, yaw_rad: float = math.nan) -> int:
        """Result of a goal in NED; ``yaw_rad`` NaN keeps the heading."""
        if self._fleet.autopilot.mode[0] != Mode.GUIDED or not np.isfinite(position_m).all():
            return int(_DENIED)
        position = self._fleet.autopilot.position
        position.goal[0] = position_m
        position.goal_velocity[0] = np.nan
        if math.isfinite(yaw_rad):
            position.goal_yaw[0] = yaw_rad
        return int(_OK)

    def _speed(self, message: Message) -> tuple[int, list[Message]]:
        if message.param2 > 0.0:
            self._fleet.autopilot.position.speed_xy[0] = message.param2
        return _OK, []

    def _inject(self, message: Message) -> tuple[int, list[Message]]:
        """MAV_CMD_INJECT_FAILURE: unit, type, instance (motor from 1; 0: all)."""
        motors = self._fleet.parameters.motors
        instance = int(message.param3)
        if int(message.param1) != dialect.FAILURE_UNIT_SYSTEM_MOTOR or not 0 <= instance <= motors:
            return _UNSUPPORTED, []
        kind = int(message.param2)
        chosen = range(1, motors + 1) if instance == 0 else (instance,)
        if kind not in (dialect.FAILURE_TYPE_OK, dialect.FAILURE_TYPE_OFF, dialect.FAILURE_TYPE_STUCK):
            return _UNSUPPORTED, []
        for motor in chosen:
            self._fleet.faults.clear(0, motor)
            if kind == dialect.FAILURE_TYPE_OFF:
                self._fleet.faults.add(Fault(vehicle=0, motor=motor, start_s=self._fleet.time_s))
            elif kind == dialect.FAILURE_TYPE_STUCK:
                self._fleet.faults.add(Fault(vehicle=0, motor=motor, start_s=self._fleet.time_s, kind="stuck"))
        return _OK, []

    def _request_message(self, message: Message) -> tuple[int, list[Message]]:
        maker = self._telemetry.makers.get(int(message.param1))
        return (_OK, [maker()]) if maker else (_UNSUPPORTED, [])

    def parameter(self, name: str) -> Message | None:
        """PARAM_VALUE of ``name``, None when there is no such parameter."""
        if name not in self.params:
            return None
        index = list(self.params).index(name)
        return dialect.MAVLink_param_value_message(
            name.encode(), self.params[name], dialect.MAV_PARAM_TYPE_REAL32, len(self.params), index
        )
