"""Adapter for stock ArduPilot with our applet: declarations, tables, matrices and outputs through TUNNEL."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots import times
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.tunnel import Flag, Kind, TunnelMessage
from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.schedule import Command, Declare, Drive, Load
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.condition import Condition, InForce, Reason, Source, Statement, read_only
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import AllocationInfeasible, TunnelError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader
from nff_companion.mavlink.services.streams import Stream

_SPEED_HZ = 100.0
_GUIDED = 4
_ESC_TELEMETRY = (
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12,
)


class ArduPilotAdapter:
    """One vehicle. ``target`` is the autopilot's (system, component); ``plans`` are computed ahead, by failed mask."""

    name = "ardupilot"

    def __init__(self, vehicle: Vehicle, target: tuple[int, int], plans: dict[int, Plan], instance: int = 1) -> None:
        self._vehicle, self.target, self._instance = vehicle, target, instance
        self._decoder = TelemetryDecoder(vehicle)
        self._parameters = ParameterReader(checks.names(vehicle), target, bytewise=False)
        self._next_heartbeat_s = -np.inf
        self._sequence = 0
        self._boot_ms: int | None = None
        self._flags = 0
        self._motors = vehicle.motors
        self._applied_s = self._first_s = -np.inf
        self._in_force = InForce()
        self._complaint = ""
        self._untold: Statement | None = None
        self._custom_mode = -1
        self._wrong: list[str] = []

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for. The autopilot keeps at most ten different intervals."""
        ids = dialect
        return [
            Stream(ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_HIGHRES_IMU, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, min(rate_hz, 50.0)),
            Stream(ids.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 20.0, required=False),  # in GUIDED alone
            Stream(ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0),
            *(
                Stream(message_id, min(rate_hz, _SPEED_HZ), required=False)
                for message_id in _ESC_TELEMETRY[: (self._vehicle.motors + 3) // 4]
            ),
        ]

    def observe(self, message: Message, now_s: float) -> Sample | None:
        """Telemetry, and what the applet says."""
        kind = message.get_type()
        if not np.isfinite(self._first_s):
            self._first_s = now_s
        if kind == "TUNNEL":
            self._tunnel(message, now_s)
            return None
        if kind == "PARAM_VALUE":
            self._parameters.observe(message)
            self._wrong = checks.contradictions(self._parameters.values, self._vehicle)
            return None
        if kind == "HEARTBEAT":
            self._custom_mode = message.custom_mode
        return self._decoder.observe(message)

    def _tunnel(self, message: Message, now_s: float) -> None:
        try:
            inner = tunnel.unwrap(message)
        except TunnelError as error:
            self._complaint = str(error)
            return
        if inner is None or inner.kind != Kind.APPLIED:
            return
        self._complaint = ""
        values = inner.values
        self._boot_ms, self._applied_s = values["boot_ms"], now_s
        self._flags, self._motors = values["flags"], values["motors"]
        bits = np.arange(self._vehicle.motors)
        self._in_force = InForce(
            source=Source(min(values["source"], max(Source))),
            failed=read_only(((values["failed"] >> bits) & 1).astype(bool)),
            refused=MappingProxyType({name: values[name] for name in tunnel.REFUSALS}),
        )

    def condition(self, now_s: float) -> Condition:
        """What stands in the way, and what the applet has in force."""
        matrix = bool(self._flags & Flag.MATRIX)
        values = self._parameters.values
        telemetry = None
        if "INS_GYRO_FILTER" in values and "INS_ACCEL_FILTER" in values:
            telemetry = TelemetryTable(values["INS_GYRO_FILTER"], values["INS_ACCEL_FILTER"])
        return Condition(
            armed=self._decoder.armed,
            command=self._obstacle(now_s),
            allocate=None if matrix else Statement(Reason.NO_MATRIX_TAKEN),
            drive=None if self._custom_mode == _GUIDED else Statement(Reason.NOT_GUIDED),
            untold=self._untold,
            takes_matrix=matrix,
            in_force=self._in_force,
            telemetry=telemetry,
            notes=self._notes(now_s),
        )

    def _obstacle(self, now_s: float) -> Statement | None:
        if not self._parameters.complete:
            return Statement(Reason.READING)
        if self._parameters.absent:
            return Statement(Reason.PARAMETER_SILENT, self._parameters.absent[0])
        if self._wrong:
            return Statement(Reason.CONTRADICTION, self._wrong[0])
        if self._complaint:
            return Statement(Reason.UNREADABLE, self._complaint)
        if now_s - self._applied_s > times.ANSWER_MAX_S:
            return Statement(Reason.SILENT, "the applet")
        if self._motors != self._vehicle.motors:
            return Statement(Reason.APPLET_MOTORS, f"{self._motors} motors, the airframe has {self._vehicle.motors}")
        return None

    def _notes(self, now_s: float) -> tuple[Statement, ...]:
        if self._boot_ms is None:
            late = now_s - self._first_s > times.GROUND_PATIENCE_S
            return (Statement(Reason.SILENT, "the applet"),) if late else ()
        return () if self._flags & Flag.WATCHDOG else (Statement(Reason.WATCHDOG_SILENT),)

    def findings(self) -> list[Finding]:
        """Applet, watchdog, and the parameters that must agree with the airframe."""
        values, alive = self._parameters.values, self._boot_ms is not None
        watchdog = bool(self._flags & Flag.WATCHDOG)
        out = [
            Finding(
                "applet", alive, "answers" if alive else self._complaint or "does not answer: installed? SCR_ENABLE 1?"
            ),
            Finding("watchdog", alive and watchdog, "runs" if watchdog else "is silent"),
            Finding("motors", alive and self._motors == self._vehicle.motors, f"the applet flies {self._motors}"),
        ]
        wrong = [*self._wrong, *(f"no answer for {name}" for name in self._parameters.absent)]
        read = self._parameters.complete and not wrong
        out.append(Finding("parameters", read, "; ".join(wrong) or "agree with the airframe"))
        return out + [Finding("advice", None, text) for text in checks.advice(values, self._vehicle)]

    # -- commands -----------------------------------------------------------------------------------------------

    def _message(
        self, kind: Kind, *, rows: np.ndarray | None = None, pwm: np.ndarray | None = None, **v: int
    ) -> Message:
        self._sequence = tunnel.following(self._sequence)
        inner = TunnelMessage(kind, {"sequence": self._sequence, **v}, rows, pwm)
        return tunnel.wrap(inner.pack(), self.target)

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Heartbeat of the working loop, and parameters that are still unknown."""
        out = self._parameters.tick(now_s)
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + times.HEARTBEAT_INTERVAL_S
            out.append(self._message(Kind.HEARTBEAT, mode=0))
        return out

    def encode(self, command: Command) -> list[Message]:
        """Messages that tell the applet."""
        sample_ms = tunnel.milliseconds(command.time_s)
        if isinstance(command, Declare):
            return [self._message(Kind.DECLARATION, sample_ms=sample_ms, failed=_mask(command.failed))]
        if isinstance(command, Load):
            return self._matrix(command, sample_ms)
        if isinstance(command, Drive):
            low, high = self._vehicle.command.pwm_min, self._vehicle.command.pwm_max
            pwm = np.clip(np.round(low + (high - low) * command.outputs), low, high).astype(np.uint16)
            timeout_ms = round(1e3 * times.OVERRIDE_TIMEOUT_S)
            return [self._message(Kind.OVERRIDE, sample_ms=sample_ms, timeout_ms=timeout_ms, pwm=pwm)]
        return [self._message(Kind.RELEASE, sample_ms=sample_ms)]

    def _matrix(self, command: Load, sample_ms: int) -> list[Message]:
        try:
            rows = factors.of_matrix(self._vehicle, command.plan.matrix)
        except AllocationInfeasible as error:
            self._untold = Statement(Reason.NOT_TOLD, str(error))
            return []
        self._untold = None
        flags, timeout_ms = int(bool(command.plan.released)), round(1e3 * times.MATRIX_TIMEOUT_S)
        mask = _mask(command.failed)
        return [
            self._message(Kind.MATRIX, sample_ms=sample_ms, timeout_ms=timeout_ms, failed=mask, flags=flags, rows=rows)
        ]


def _mask(failed: np.ndarray) -> int:
    return int((1 << np.flatnonzero(failed)).sum())
