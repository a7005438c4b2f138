"""Commands that the emulated autopilot answers, for one vehicle of a fleet.

Parameters are floats from anybody's wire: NaN, infinite, and out of every range. Each handler takes what it needs
through ``whole`` or ``within`` and refuses the rest; nothing else may reach the vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.autopilot import Mode
from sitl.faults import Fault
from sitl.fleet import Fleet
from sitl.telemetry import HOME_ALTITUDE_M, Telemetry, to_local

_OK = dialect.MAV_RESULT_ACCEPTED
_DENIED = dialect.MAV_RESULT_DENIED
_UNSUPPORTED = dialect.MAV_RESULT_UNSUPPORTED
_LAND_MODE, _GUIDED_MODE = 9, 4
DEFAULT_TAKE_OFF_M = 10.0
_FAR_M = 10_000.0  # no goal is farther from home
_SPEED_MAX_M_S = 50.0
_MESSAGE_ID_MAX = 2**24 - 1


def whole(value: float, least: int, most: int) -> int | None:
    """``value`` as an integer; None when it is none of ``least`` to ``most``."""
    if not least <= value <= most or value != int(value):  # NaN fails the first, and so never meets int()
        return None
    return int(value)


def within(value: float, least: float, most: float) -> bool:
    """Whether ``value`` is a number of that range; NaN and infinities are none."""
    return math.isfinite(value) and least <= value <= most


class Commander:
    """Executes commands."""

    def __init__(self, fleet: Fleet, telemetry: Telemetry, vehicle: int = 0) -> None:
        self._fleet, self._telemetry, self._vehicle = fleet, telemetry, vehicle

    def command(self, message: Message) -> tuple[int | None, list[Message]]:
        """Result of COMMAND_LONG or COMMAND_INT (None: nobody answers), and extra messages. Stream requests are the
        server's."""
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
        wanted = whole(message.param1, 0, 1)
        if wanted is None:
            return _DENIED, []
        if wanted == 1:
            if not autopilot.armed[self._vehicle]:
                autopilot.arm(self._vehicle)
            return _OK, []
        forced = message.param2 == 21196
        if autopilot.mode[self._vehicle] != Mode.GROUND and not forced:
            return _DENIED, []
        autopilot.disarm(self._vehicle)
        return _OK, []

    def _take_off(self, message: Message) -> tuple[int, list[Message]]:
        autopilot = self._fleet.autopilot
        height = self._height(message, DEFAULT_TAKE_OFF_M)
        if height is None or not autopilot.armed[self._vehicle] or autopilot.mode[self._vehicle] != Mode.GROUND:
            return _DENIED, []
        autopilot.take_off(self._vehicle, height, self._fleet.sensors.measured)
        return _OK, []

    @staticmethod
    def _height(message: Message, default_m: float) -> float | None:
        """Height above home of param7 (z): ``default_m`` when it is NaN or 0, None when it is out of bounds."""
        value = message.z if hasattr(message, "z") else message.param7
        if math.isnan(value) or value == 0.0:
            return default_m
        # COMMAND_INT says in which frame; a height far above home can only be above the sea.
        height = value - HOME_ALTITUDE_M if value > 0.5 * HOME_ALTITUDE_M else value
        return height if value > 0.0 and within(height, -_FAR_M, _FAR_M) else None

    def _land(self, _: Message) -> tuple[int, list[Message]]:
        if self._fleet.autopilot.mode[self._vehicle] == Mode.GROUND:
            return _DENIED, []
        self._fleet.autopilot.land(self._vehicle)
        return _OK, []

    def _set_mode(self, message: Message) -> tuple[int, list[Message]]:
        custom_mode = whole(message.param2, 0, 2**32 - 1)
        return (_DENIED if custom_mode is None else self.set_mode(custom_mode)), []

    def set_mode(self, custom_mode: int) -> int:
        """Result of a change of mode (4 guided, 9 land)."""
        autopilot = self._fleet.autopilot
        if custom_mode == _LAND_MODE and autopilot.mode[self._vehicle] != Mode.GROUND:
            autopilot.land(self._vehicle)
            return int(_OK)
        if custom_mode == _GUIDED_MODE:
            return int(_OK)
        return int(_DENIED)

    def _reposition(self, message: Message) -> tuple[int, list[Message]]:
        if message.get_type() == "COMMAND_INT":
            latitude, longitude = 1e-7 * message.x, 1e-7 * message.y
        else:
            latitude, longitude = message.param5, message.param6
        height = self._height(message, -float(self._fleet.autopilot.position.goal[self._vehicle, 2]))
        if height is None or not within(latitude, -90.0, 90.0) or not within(longitude, -180.0, 180.0):
            return _DENIED, []
        return self.go_to(np.array([*to_local(latitude, longitude), -height]), message.param4), []

    def go_to(self, position_m: NDArray[np.float64], yaw_rad: float = math.nan) -> int:
        """Result of a goal in NED (3,), at most 10 km from home; ``yaw_rad`` NaN keeps the heading."""
        autopilot = self._fleet.autopilot
        near = all(within(float(v), -_FAR_M, _FAR_M) for v in position_m)
        turns = math.isnan(yaw_rad) or within(yaw_rad, -2.0 * math.pi, 2.0 * math.pi)
        if autopilot.mode[self._vehicle] != Mode.GUIDED or not near or not turns:
            return int(_DENIED)
        position = autopilot.position
        position.goal[self._vehicle] = position_m
        position.goal_velocity[self._vehicle] = np.nan
        if not math.isnan(yaw_rad):
            position.goal_yaw[self._vehicle] = yaw_rad
        return int(_OK)

    def _speed(self, message: Message) -> tuple[int, list[Message]]:
        """MAV_CMD_DO_CHANGE_SPEED: kind (0 air, 1 ground), speed in m/s (-1: no change)."""
        if whole(message.param1, 0, 1) is None:
            return _DENIED, []
        if message.param2 == -1.0:
            return _OK, []
        if not within(message.param2, 0.0, _SPEED_MAX_M_S) or message.param2 == 0.0:
            return _DENIED, []
        self._fleet.autopilot.position.speed_xy[self._vehicle] = message.param2
        return _OK, []

    def _inject(self, message: Message) -> tuple[int, list[Message]]:
        """MAV_CMD_INJECT_FAILURE: unit, type, instance (motor from 1; 0: all)."""
        motors = self._fleet.parameters.motors
        unit, kind = whole(message.param1, 0, 255), whole(message.param2, 0, 255)
        instance = whole(message.param3, 0, motors)
        if unit != dialect.FAILURE_UNIT_SYSTEM_MOTOR or instance is None:
            return _UNSUPPORTED, []
        chosen = range(1, motors + 1) if instance == 0 else (instance,)
        if kind not in (dialect.FAILURE_TYPE_OK, dialect.FAILURE_TYPE_OFF, dialect.FAILURE_TYPE_STUCK):
            return _UNSUPPORTED, []
        for motor in chosen:
            self._fleet.faults.clear(self._vehicle, motor)
            if kind == dialect.FAILURE_TYPE_OFF:
                self._fleet.faults.add(Fault(vehicle=self._vehicle, motor=motor, start_s=self._fleet.time_s))
            elif kind == dialect.FAILURE_TYPE_STUCK:
                self._fleet.faults.add(
                    Fault(vehicle=self._vehicle, motor=motor, start_s=self._fleet.time_s, kind="stuck")
                )
        return _OK, []

    def _request_message(self, message: Message) -> tuple[int, list[Message]]:
        message_id = whole(message.param1, 0, _MESSAGE_ID_MAX)
        maker = None if message_id is None else self._telemetry.makers.get(message_id)
        return (_OK, [maker()]) if maker else (_UNSUPPORTED, [])
