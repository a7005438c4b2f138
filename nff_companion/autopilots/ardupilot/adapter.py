"""Adapter for stock ArduPilot with our applet: declarations, tables, matrices and outputs through TUNNEL."""

from __future__ import annotations

import numpy as np

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.tunnel import Flag, Kind, TunnelMessage
from nff_companion.autopilots.base import Applied, Capabilities, Finding, Stream
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import AllocationInfeasible, TunnelError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader
from nff_companion.pipeline import Mode, Output

MATRIX_TIMEOUT_MS = 500
OVERRIDE_TIMEOUT_MS = 100
_MATRIX_INTERVAL_S = 0.05
_DECLARATION_INTERVAL_S = 0.05
_HEARTBEAT_INTERVAL_S = 0.2
_TABLE_INTERVAL_S = 0.02
_TABLE_RETRY_S = 0.5
_ANSWER_MAX_S = 1.0
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
    farewell_s = 0.0
    unfinished = False

    def __init__(self, vehicle: Vehicle, target: tuple[int, int], plans: dict[int, Plan]) -> None:
        self._vehicle, self.target = vehicle, target
        self.capabilities = Capabilities(declare=True, matrix=True, outputs=True)
        self._decoder = TelemetryDecoder(vehicle)
        self.applied = Applied()
        self.parameters = ParameterReader(checks.names(vehicle), target, bytewise=False)
        self._tables = {mask: t.tobytes() for mask, t in factors.of_plans(vehicle, plans).items()}
        self._stored: set[int] = set()
        self._table_sent_s = dict.fromkeys(self._tables, -np.inf)
        self._next_table_s = self._next_heartbeat_s = -np.inf
        self._sequence = 0
        self._mode = Mode.OBSERVE
        self._boot_ms: int | None = None
        self._flags = 0
        self._motors = vehicle.motors
        self._declared = np.zeros(vehicle.motors, bool)
        self._declared_s = self._matrix_s = self._applied_s = -np.inf
        self._plan: Plan | None = None
        self.unreadable = 0  # tunnel messages that could not be understood
        self._complaint = ""
        self._custom_mode = -1

    @property
    def tables_stored(self) -> bool:
        """Whether the applet has every table."""
        return len(self._stored) == len(self._tables)

    @property
    def watchdog_alive(self) -> bool:
        """Whether the second script on the autopilot runs."""
        return bool(self._flags & Flag.WATCHDOG)

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

    def observe(self, message: Message) -> Sample | None:
        """Telemetry, and what the applet says."""
        kind = message.get_type()
        if kind == "TUNNEL":
            self._tunnel(message)
            return None
        if kind == "PARAM_VALUE":
            self.parameters.observe(message)
            return None
        if kind == "HEARTBEAT":
            self._custom_mode = message.custom_mode
        return self._decoder.observe(message)

    def _tunnel(self, message: Message) -> None:
        try:
            inner = tunnel.unwrap(message)
        except TunnelError as error:
            self.unreadable += 1
            self._complaint = str(error)
            return
        if inner is None:
            return
        self._complaint = ""
        values = inner.values
        if inner.kind == Kind.STORED:
            table = self._tables.get(values["failed"])
            if table is not None and tunnel.check(table) == values["check"]:
                self._stored.add(values["failed"])
        elif inner.kind == Kind.APPLIED:
            if self._boot_ms != values["boot_ms"]:
                # The applet was started anew: what it had been told is gone.
                self._boot_ms, self._stored, self._declared_s = values["boot_ms"], set(), -np.inf
            self._applied_s = 1e-3 * values["time_ms"]
            self._flags, self._motors = values["flags"], values["motors"]
            self.capabilities = Capabilities(declare=True, matrix=bool(self._flags & Flag.MATRIX), outputs=True)
            bits = np.arange(self._vehicle.motors)
            self.applied = Applied(
                source=values["source"],
                failed=((values["failed"] >> bits) & 1).astype(bool),
                matrix_sequence=values["matrix_sequence"],
                override_sequence=values["override_sequence"],
                declaration_sequence=values["declaration_sequence"],
                refused={name: values[name] for name in tunnel.REFUSALS},
            )

    @property
    def telemetry(self) -> TelemetryTable | None:
        """HIGHRES_IMU carries the gyro behind INS_GYRO_FILTER and the accelerometer behind INS_ACCEL_FILTER."""
        values = self.parameters.values
        if "INS_GYRO_FILTER" not in values or "INS_ACCEL_FILTER" not in values:
            return None
        return TelemetryTable(values["INS_GYRO_FILTER"], values["INS_ACCEL_FILTER"])

    def complaints(self) -> list[str]:
        """What stands in the way of acting, and a watchdog that is silent."""
        out = checks.contradictions(self.parameters.values, self._vehicle)[:1]
        if self._boot_ms is None:
            out.append("applet does not answer, observing")
        elif not self.watchdog_alive:
            out.append("applet watchdog is silent")
        return out

    def findings(self) -> list[Finding]:
        """Applet, watchdog, tables, and the parameters that must agree with the airframe."""
        values = self.parameters.values
        alive = self._boot_ms is not None
        count, wanted = len(self._stored), len(self._tables)
        wrong = checks.contradictions(values, self._vehicle)
        out = [
            Finding(
                "applet", alive, "answers" if alive else self._complaint or "does not answer: installed? SCR_ENABLE 1?"
            ),
            Finding("watchdog", alive and self.watchdog_alive, "runs" if self.watchdog_alive else "is silent"),
            Finding("tables", self.tables_stored, f"{count} of {wanted} stored on the autopilot"),
            Finding("motors", alive and self._motors == self._vehicle.motors, f"the applet flies {self._motors}"),
        ]
        wrong += [f"no answer for {name}" for name in self.parameters.absent]
        read = self.parameters.complete and not wrong
        out.append(Finding("parameters", read, "; ".join(wrong) or "agree with the airframe"))
        out += [Finding("advice", None, text) for text in checks.advice(values, self._vehicle)]
        return out

    def hands_off(self) -> str:
        """Override follows the targets of GUIDED alone: in every other mode it would fly against the pilot."""
        return "" if self._custom_mode == _GUIDED else "override needs flight mode GUIDED: allocating instead"

    def declare(self, failed: np.ndarray, time_s: float) -> list[Message]:
        """The declaration as it is now."""
        self._declared, self._declared_s = failed.copy(), time_s
        mask = int((1 << np.flatnonzero(failed)).sum())
        return [self._message(Kind.DECLARATION, sample_ms=tunnel.milliseconds(time_s), failed=mask)]

    def verdict(self, output: Output) -> str:
        """The matrix where it can be loaded; else outputs, or nothing but a stopped motor."""
        if output.mode == Mode.OVERRIDE:
            return "driving outputs"
        return "reallocated" if output.plan is not None and self.capabilities.matrix else "stopped, NO matrix"

    def blocked(self, time_s: float, mode: Mode) -> str:
        """Why no command may be sent at ``time_s``; empty when one may."""
        if not self.parameters.complete:
            return "reading the autopilot's parameters"
        if self.parameters.absent:
            return f"the autopilot does not answer for {self.parameters.absent[0]}: observing"
        wrong = checks.contradictions(self.parameters.values, self._vehicle)
        if wrong:
            return f"{wrong[0]}: observing"
        if self._complaint:
            return f"applet: {self._complaint}"
        if abs(time_s - self._applied_s) > _ANSWER_MAX_S:
            return "the applet does not answer: is it installed, and SCR_ENABLE 1? Observing"
        if self._motors != self._vehicle.motors:
            return f"the applet flies {self._motors} motors, the airframe has {self._vehicle.motors}: install it again"
        if mode == Mode.ALLOCATE and not self.capabilities.matrix:
            return "FRAME_CLASS is not 17: no matrix can be loaded; set it, or use override mode"
        return ""

    # -- commands -----------------------------------------------------------------------------------------------

    def _message(
        self, kind: Kind, *, rows: np.ndarray | None = None, pwm: np.ndarray | None = None, **v: int
    ) -> Message:
        self._sequence = tunnel.following(self._sequence)
        inner = TunnelMessage(kind, {"sequence": self._sequence, **v}, rows, pwm)
        return tunnel.wrap(inner.pack(), self.target)

    def tick(self, now_s: float) -> list[Message]:
        """Heartbeat of the working loop, parameters that are still unknown, tables that are not yet stored."""
        out = self.parameters.tick(now_s)
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + _HEARTBEAT_INTERVAL_S
            out.append(self._message(Kind.HEARTBEAT, mode=int(self._mode)))
        if self._boot_ms is not None and now_s >= self._next_table_s and not self.tables_stored:
            self._next_table_s = now_s + _TABLE_INTERVAL_S
            for mask, table in self._tables.items():
                if mask not in self._stored and now_s - self._table_sent_s[mask] > _TABLE_RETRY_S:
                    self._table_sent_s[mask] = now_s
                    rows = np.frombuffer(table, np.int16).reshape(-1, 4)
                    out.append(self._message(Kind.TABLE, failed=mask, flags=0, rows=rows))
                    break
        return out

    def act(self, output: Output) -> list[Message]:
        """Declaration when it changed or is not yet confirmed, matrix at 20 Hz and on change."""
        self._mode = output.mode
        if output.mode == Mode.OBSERVE:
            return []
        sample_ms = tunnel.milliseconds(output.time_s)
        mask = int((1 << np.flatnonzero(output.failed)).sum())
        messages: list[Message] = []
        changed = bool((output.failed != self._declared).any())
        confirmed = self.applied.failed is not None and bool((self.applied.failed == output.failed).all())
        again = not confirmed and not 0.0 <= output.time_s - self._declared_s < _DECLARATION_INTERVAL_S
        if output.flying and (changed or again):
            messages += self.declare(output.failed, output.time_s)
        if output.plan is not None and self.capabilities.matrix:
            fresh = output.plan is not self._plan
            if fresh or not 0.0 <= output.time_s - self._matrix_s < _MATRIX_INTERVAL_S:
                self._plan, self._matrix_s = output.plan, output.time_s
                messages += self._matrix(output.plan, mask, sample_ms)
        elif self._plan is not None:
            self._plan = None
            messages += self.release(output.time_s)
        return messages

    def _matrix(self, plan: Plan, mask: int, sample_ms: int) -> list[Message]:
        try:
            rows = factors.of_matrix(self._vehicle, plan.matrix)
        except AllocationInfeasible as error:
            self._complaint = str(error)
            return []
        flags = int(bool(plan.released))
        return [
            self._message(
                Kind.MATRIX, sample_ms=sample_ms, timeout_ms=MATRIX_TIMEOUT_MS, failed=mask, flags=flags, rows=rows
            )
        ]

    def drive(self, outputs: np.ndarray, time_s: float) -> list[Message]:
        """Motor outputs (m,) in 0..1 that answer the sample of ``time_s``."""
        command = self._vehicle.command
        low, high = command.pwm_min, command.pwm_max
        pwm = np.clip(np.round(low + (high - low) * outputs), low, high).astype(np.uint16)
        sample_ms = tunnel.milliseconds(time_s)
        return [self._message(Kind.OVERRIDE, sample_ms=sample_ms, timeout_ms=OVERRIDE_TIMEOUT_MS, pwm=pwm)]

    def release(self, time_s: float) -> list[Message]:
        """Drop the matrix; outputs expire by themselves, declarations stay."""
        return [self._message(Kind.RELEASE, sample_ms=tunnel.milliseconds(time_s))]
