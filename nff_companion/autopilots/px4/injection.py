"""Telling PX4 of a failed motor by MAV_CMD_INJECT_FAILURE: no parameter is changed, but it takes one motor only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nff_companion.autopilots.px4.remedy import Advisor
from nff_companion.autopilots.px4.versions import behaviour
from nff_companion.mavlink.codec import Message, dialect

INJECTION_NEEDS = {"SYS_FAILURE_EN": 1.0, "CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}
_RESEND_S = 0.05


class Injection:
    """``motor`` (from 1) is what PX4 was told, None: nothing. ``note`` is for the pilot."""

    def __init__(self, motors: int, target: tuple[int, int]) -> None:
        self._motors, self._target = motors, target
        self.motor: int | None = None
        self.note = ""
        self._kind = int(dialect.FAILURE_TYPE_OK)
        self._pending: tuple[int, int] | None = None  # motor and type, not yet acknowledged
        self._sent_s = self._tick_s = -np.inf

    def prepare(self, version: tuple[int, int, int], values: Mapping[str, float]) -> str:
        """Take the type that this version reallocates on; why injection would do nothing, empty when it works."""
        known = behaviour(version)
        if known is None or known.inject_type is None:
            return "this PX4 does not reallocate on an injected failure: use px4_method = scale"
        for name, wanted in INJECTION_NEEDS.items():
            if values.get(name) != wanted:
                return f"{name} is {values.get(name)}, injection needs {wanted:.0f}: set it, or use px4_method = scale"
        self._kind = known.inject_type
        return ""

    def act(self, believed: np.ndarray, advisor: Advisor) -> list[Message]:
        """Tell the first total failure of ``believed`` (m,) effectiveness, or that it is lifted."""
        dead = [int(i) + 1 for i in np.flatnonzero(believed == 0.0)]
        self.note = f"PX4 takes one injected failure: motors {dead} cannot be told" if len(dead) > 1 else ""
        if self.motor is not None and self.motor not in dead:
            motor, self.motor = self.motor, None
            return self._send(motor, int(dialect.FAILURE_TYPE_OK))
        if self.motor is not None or not dead:
            return []
        told = np.ones(self._motors)
        told[dead[0] - 1] = 0.0
        fault = advisor.predict(told, told, yaw_released=False).fault(yaw=True)
        if fault:
            self.note = f"not told to PX4: {fault}"
            return []
        self.motor = dead[0]
        return self._send(self.motor, self._kind)

    def lift(self) -> None:
        """Undo it, armed or not: PX4 keeps an injected failure over a disarming until it is told otherwise."""
        self._pending = None if self.motor is None else (self.motor, int(dialect.FAILURE_TYPE_OK))
        self.motor = None

    @property
    def unfinished(self) -> bool:
        """Whether something was told that is not acknowledged."""
        return self._pending is not None

    def tick(self, now_s: float) -> list[Message]:
        """Again, what was not acknowledged."""
        self._tick_s = now_s
        if self._pending is None or now_s < self._sent_s + _RESEND_S:
            return []
        return self._send(*self._pending)

    def observe(self, message: Message) -> bool:
        """Take a COMMAND_ACK; whether it acknowledges what was told."""
        if message.command != dialect.MAV_CMD_INJECT_FAILURE or self._pending is None:
            return False
        self._pending = None
        if message.result == dialect.MAV_RESULT_ACCEPTED:
            return True
        self.motor, self.note = None, f"PX4 refused the injected failure ({message.result})"
        return False

    def _send(self, motor: int, kind: int) -> list[Message]:
        self._pending, self._sent_s = (motor, kind), self._tick_s
        unit = float(dialect.FAILURE_UNIT_SYSTEM_MOTOR)
        values = (unit, float(kind), float(motor), 0.0, 0.0, 0.0, 0.0)
        return [dialect.MAVLink_command_long_message(*self._target, dialect.MAV_CMD_INJECT_FAILURE, 0, *values)]
