"""Commands as PX4 takes them, for one vehicle of a fleet."""

from __future__ import annotations

import numpy as np

from nff_companion.mavlink.codec import Message, dialect
from sitl.autopilot.autopilot import Mode
from sitl.autopilot.px4.mixer import Px4Mixer
from sitl.autopilot.px4.parameters import ParameterTable
from sitl.autopilot.px4.telemetry import HOLD, LAND, MAIN_AUTO, TAKE_OFF, Px4Telemetry
from sitl.commands import DEFAULT_TAKE_OFF_M, Commander, whole
from sitl.fleet import Fleet

_OK = int(dialect.MAV_RESULT_ACCEPTED)
_DENIED = int(dialect.MAV_RESULT_DENIED)
_UNSUPPORTED = int(dialect.MAV_RESULT_UNSUPPORTED)
_ALL = 0  # instance of an injected failure


class Px4Commander(Commander):
    """An injected failure stops the motor's output: the motor itself is well. SYS_FAILURE_EN counts at boot."""

    def __init__(
        self, fleet: Fleet, vehicle: int, telemetry: Px4Telemetry, table: ParameterTable, mixer: Px4Mixer
    ) -> None:
        super().__init__(fleet, telemetry, vehicle)
        self._mixer = mixer
        self._injects = table.whole("SYS_FAILURE_EN") == 1
        self._takes_off = False  # as soon as it is armed

    def command(self, message: Message) -> tuple[int | None, list[Message]]:
        """As ``Commander.command``; no result: nobody answers."""
        if message.command == dialect.MAV_CMD_INJECT_FAILURE and not self._injects:
            return None, []
        return super().command(message)

    def _arm(self, message: Message) -> tuple[int, list[Message]]:
        result = super()._arm(message)
        autopilot = self._fleet.autopilot
        if self._takes_off and autopilot.armed[self._vehicle] and autopilot.mode[self._vehicle] == Mode.GROUND:
            self._begin_take_off()
        return result

    def _begin_take_off(self) -> None:
        self._takes_off = False
        self._fleet.autopilot.take_off(self._vehicle, DEFAULT_TAKE_OFF_M, self._fleet.sensors.measured)

    def _set_mode(self, message: Message) -> tuple[int, list[Message]]:
        """Main and sub mode in params 2 and 3; acknowledged also when it cannot be: the heartbeat tells."""
        main, sub = whole(message.param2, 0, 255), whole(message.param3, 0, 255)
        if main is None or sub is None:
            return _DENIED, []
        self._change_mode(main, sub)
        return _OK, []

    def set_mode(self, custom_mode: int) -> int:
        """SET_MODE, main and sub mode in its upper bytes."""
        self._change_mode(custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF)
        return _OK

    def _change_mode(self, main: int, sub: int) -> None:
        autopilot, vehicle = self._fleet.autopilot, self._vehicle
        if main != MAIN_AUTO or sub not in (TAKE_OFF, HOLD, LAND):
            return
        flying = autopilot.mode[vehicle] != Mode.GROUND
        self._takes_off = sub == TAKE_OFF and not flying
        if sub == LAND and flying:
            autopilot.land(vehicle)
        elif self._takes_off and autopilot.armed[vehicle]:
            self._begin_take_off()

    def _inject(self, message: Message) -> tuple[int, list[Message]]:
        """FailureInjector of v1.16: motors are stopped and let go; what it does about their ESCs has no ESC here."""
        motors = len(self._mixer.stopped)
        unit, kind = whole(message.param1, 0, 255), whole(message.param2, 0, 255)
        instance = whole(message.param3, 0, motors)
        if unit != dialect.FAILURE_UNIT_SYSTEM_MOTOR or instance is None:
            return _UNSUPPORTED, []
        if kind not in (dialect.FAILURE_TYPE_OK, dialect.FAILURE_TYPE_OFF):
            return _UNSUPPORTED, []
        chosen = np.ones(motors, bool) if instance == _ALL else np.arange(1, motors + 1) == instance
        stopped = self._mixer.stopped & ~chosen if kind == dialect.FAILURE_TYPE_OK else self._mixer.stopped | chosen
        self._mixer.inject(stopped)
        return _OK, []
