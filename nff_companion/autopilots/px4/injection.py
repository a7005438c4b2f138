"""Telling PX4 of a failed motor by MAV_CMD_INJECT_FAILURE: no parameter is changed, but it takes one motor only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.base import Permit
from nff_companion.autopilots.px4.remedy import Advisor
from nff_companion.autopilots.px4.versions import behaviour
from nff_companion.condition import InForce, Reason, Source, Statement, read_only
from nff_companion.mavlink.codec import Message, dialect

INJECTION_NEEDS = {"SYS_FAILURE_EN": 1.0, "CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}
_RESEND_S = 0.05
_REFUSED_AGAIN_S = 1.0  # a lifting that was refused is tried again
_OK = int(dialect.FAILURE_TYPE_OK)
_LATER = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_IN_PROGRESS)


class Injection:
    """``untold`` is for the pilot. Motors are numbered from 1; ``now_s`` is any monotonic clock."""

    def __init__(self, motors: int, target: tuple[int, int]) -> None:
        self._motors, self._target = motors, target
        self.untold: Statement | None = None
        self._told: int | None = None  # what PX4 is to hold
        self._confirmed: int | None = None  # and what it has acknowledged
        self._impossible: dict[int, str] = {}  # motors that may not be told in this flight, and why
        self._kind = _OK
        self._pending: tuple[int, int] | None = None  # motor and type, not yet acknowledged
        self._next_s = -np.inf
        # Copies of a command are acknowledged one by one: those of the one before do not speak for this one.
        self._unanswered = self._stale = 0

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

    def in_force(self) -> InForce:
        """What PX4 has acknowledged."""
        failed = read_only(np.arange(1, self._motors + 1) == (self._confirmed or 0))
        return InForce(Source.STOCK if self._confirmed is None else Source.DECLARATION, failed)

    def tell(self, believed: NDArray[np.float64], advisor: Advisor, now_s: float) -> list[Message]:
        """Tell the first total failure of ``believed`` (m,) effectiveness, or that it is lifted; again until
        acknowledged."""
        dead = [int(i) + 1 for i in np.flatnonzero(believed == 0.0)]
        if self._told is not None and self._told not in dead:
            self._want(self._told, _OK)
            self._told = None
        elif self._told is None and self._pending is None and dead and dead[0] not in self._impossible:
            self._inject(dead[0], advisor)
        self.untold = self._why_untold(believed, dead, advisor)
        return self._send(now_s)

    def _inject(self, motor: int, advisor: Advisor) -> None:
        told = np.ones(self._motors)
        told[motor - 1] = 0.0
        fault = advisor.predict(told, told, yaw_released=False).fault(yaw=True)
        if fault:
            self._impossible[motor] = fault
        else:
            self._told = motor
            self._want(motor, self._kind)

    def _why_untold(self, believed: NDArray[np.float64], dead: list[int], advisor: Advisor) -> Statement | None:
        if not advisor.lifts(believed):
            return Statement(Reason.NO_LIFT)
        left = [motor for motor in dead if motor != self._told]
        if left:
            one = f"PX4 takes one injected failure: motors {left} cannot be told"
            return Statement(Reason.NOT_TOLD, self._impossible.get(left[0], one))
        if ((believed > 0.0) & (believed < 1.0)).any():
            return Statement(Reason.NOT_TOLD, "an injected failure tells no partial loss")
        return None

    def lift(self) -> None:
        """Undo it, armed or not: PX4 keeps an injected failure over a disarming until it is told otherwise."""
        motor = self._told or self._confirmed
        if motor is not None and self._pending != (motor, _OK):
            self._want(motor, _OK)
        self._told, self.untold, self._impossible = None, None, {}

    @property
    def unfinished(self) -> bool:
        """Whether something was told that is not acknowledged."""
        return self._pending is not None

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Again, what was not acknowledged: a lifting by who may tidy, a failure by who may act."""
        if self._pending is None or permit < (Permit.TIDY if self._pending[1] == _OK else Permit.ACT):
            return []
        return self._send(now_s)

    def observe(self, message: Message, now_s: float) -> None:
        """Take a COMMAND_ACK."""
        if message.command != dialect.MAV_CMD_INJECT_FAILURE or self._pending is None:
            return
        self._unanswered = max(self._unanswered - 1, 0)
        if self._stale > 0:
            self._stale -= 1
            return
        motor, kind = self._pending
        if message.result == dialect.MAV_RESULT_ACCEPTED:
            self._pending = None
            self._confirmed = None if kind == _OK else motor
        elif kind == _OK:
            self._next_s = now_s + _REFUSED_AGAIN_S
        elif message.result not in _LATER:
            self._pending = self._told = None
            self._impossible[motor] = f"PX4 refused the injected failure ({message.result})"
            self.untold = Statement(Reason.NOT_TOLD, self._impossible[motor])

    def _want(self, motor: int, kind: int) -> None:
        self._pending, self._next_s, self._stale = (motor, kind), -np.inf, self._unanswered

    def _send(self, now_s: float) -> list[Message]:
        if self._pending is None or now_s < self._next_s:
            return []
        self._next_s = now_s + _RESEND_S
        self._unanswered += 1
        motor, kind = self._pending
        unit = float(dialect.FAILURE_UNIT_SYSTEM_MOTOR)
        values = (unit, float(kind), float(motor), 0.0, 0.0, 0.0, 0.0)
        return [dialect.MAVLink_command_long_message(*self._target, dialect.MAV_CMD_INJECT_FAILURE, 0, *values)]
