"""Adapter for stock ArduPilot with our applet: declarations, tables, matrices and outputs through TUNNEL."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation.plan import Plan
from nff_companion.autopilots import times
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.card import Card
from nff_companion.autopilots.ardupilot.tunnel import Flag, Kind, TunnelMessage
from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.schedule import Command, Declare, Drive, Load
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.condition import Condition, InForce, Reason, Source, Statement, first, read_only
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import AllocationInfeasible, TunnelError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader
from nff_companion.mavlink.services.streams import Stream

_SPEED_HZ = 100.0
_GUIDED = 4
_SEQUENCES = 2**16
_ESC_TELEMETRY = (
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_1_TO_4,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_5_TO_8,
    dialect.MAVLINK_MSG_ID_ESC_TELEMETRY_9_TO_12,
)
_SILENT = Statement(Reason.SILENT, "the applet")
_READING = Statement(Reason.READING)
# Override follows the targets of GUIDED alone: in every other mode it would fly against the pilot.
_NOT_GUIDED = Statement(Reason.NOT_GUIDED)
_NOT_COMPARED = "the applet does not say which frame its mixer was compared with: install it again"


class ArduPilotAdapter:
    """One vehicle. ``target`` is the autopilot's (system, component); ``plans`` are computed ahead, by failed mask;
    ``instance`` 1 to 65535 tells this companion from others."""

    name = "ardupilot"

    def __init__(self, vehicle: Vehicle, target: tuple[int, int], plans: dict[int, Plan], instance: int) -> None:
        self._vehicle, self.target, self._instance = vehicle, target, instance
        self._decoder = TelemetryDecoder(vehicle)
        self._reader = ParameterReader(checks.names(vehicle), target, bytewise=False)
        self._contradictions: list[str] = []
        self._card = Card(vehicle, plans)
        self._sequence = 0
        self._next_heartbeat_s = -np.inf
        self._custom_mode = -1
        self._untold: Statement | None = None
        self._applied: dict[str, int] | None = None  # the last that was understood
        self._unreadable = ""  # what was wrong with the last that was not
        # Of our clock: the autopilot was heard first, these two last, and now.
        self._heard_s: float | None = None
        self._applied_s = self._unreadable_s = self._now_s = -np.inf
        self._condition: Condition | None = None  # None: to be made anew
        self._condition_ends_s = -np.inf

    # -- telemetry ----------------------------------------------------------------------------------------------

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
        """Telemetry, parameters, and what the applet says."""
        self._now_s = now_s
        if self._heard_s is None:
            self._heard_s = now_s
        kind = message.get_type()
        if kind == "TUNNEL":
            self._tunnel(message, now_s)
            return None
        if kind == "PARAM_VALUE":
            self._parameter(message)
            return None
        if kind == "HEARTBEAT":
            self._custom_mode = message.custom_mode
            self._condition = None
        return self._decoder.observe(message)

    def _parameter(self, message: Message) -> None:
        before = dict(self._reader.values)
        if self._reader.observe(message) is None or self._reader.values == before:
            return
        self._reader.want(checks.further(self._reader.values))
        self._contradictions = checks.contradictions(self._reader.values, self._vehicle)
        self._condition = None

    def _tunnel(self, message: Message, now_s: float) -> None:
        try:
            inner = tunnel.unwrap(message)
        except TunnelError as error:
            self._unreadable, self._unreadable_s, self._condition = str(error), now_s, None
            return
        if inner is None:
            return
        if inner.kind == Kind.STORED:
            self._card.stored(inner.values)
        elif inner.kind == Kind.APPLIED:
            self._take_applied(inner.values, now_s)
        self._condition = None

    def _take_applied(self, values: dict[str, int], now_s: float) -> None:
        before = self._applied
        if before is None or before["boot_ms"] != values["boot_ms"]:
            self._card.restarted()
        elif self._answers(now_s) and not 0 < (values["sequence"] - before["sequence"]) % _SEQUENCES < _SEQUENCES // 2:
            return  # overtaken on its way: what it says is over
        self._applied, self._applied_s = values, now_s
        self._card.heard(values)

    # -- condition ----------------------------------------------------------------------------------------------

    def _answers(self, now_s: float) -> bool:
        return now_s < self._applied_s + times.ANSWER_MAX_S

    def condition(self, now_s: float) -> Condition:
        """How the autopilot and its applet are; made anew only when something was heard or became too old."""
        self._now_s = now_s
        if self._condition is None or now_s >= self._condition_ends_s:
            self._condition = self._make_condition(now_s)
            patience = np.inf if self._heard_s is None else self._heard_s + times.GROUND_PATIENCE_S
            ends = (patience, self._applied_s + times.ANSWER_MAX_S, self._unreadable_s + times.ANSWER_MAX_S)
            self._condition_ends_s = min((end for end in ends if end > now_s), default=np.inf)
        return self._condition

    def _make_condition(self, now_s: float) -> Condition:
        applied = self._applied if self._answers(now_s) else None
        obstacle = self._obstacle(now_s, applied)
        takes_matrix = applied is not None and bool(applied["flags"] & Flag.MATRIX)
        return Condition(
            armed=self._decoder.armed,
            command=obstacle,
            allocate=Statement(Reason.NO_MATRIX_TAKEN) if applied is not None and not takes_matrix else None,
            drive=None if self._custom_mode == _GUIDED else _NOT_GUIDED,
            untold=self._untold,
            takes_matrix=takes_matrix,
            in_force=InForce() if applied is None else self._in_force(applied),
            telemetry=self._telemetry(),
            notes=self._notes(now_s, applied, obstacle),
        )

    def _obstacle(self, now_s: float, applied: dict[str, int] | None) -> Statement | None:
        """Why no command may be sent."""
        absent, wrong = self._absent(), self._contradictions
        return first(
            None if self._reader.complete else _READING,
            Statement(Reason.PARAMETER_SILENT, absent[0]) if absent else None,
            Statement(Reason.CONTRADICTION, wrong[0]) if wrong else None,
            self._mute(now_s) if applied is None else self._misfit(applied),
            Statement(Reason.CONTRADICTION, _NOT_COMPARED) if self._not_compared(applied) else None,
        )

    def _absent(self) -> list[str]:
        """Parameters of the firmware's own that it does not answer for."""
        return [name for name in self._reader.absent if name != checks.FRAME_BEFORE]

    def _not_compared(self, applied: dict[str, int] | None) -> bool:
        """An applet that answers, of a release that did not look at what flew before its mixer."""
        return applied is not None and checks.FRAME_BEFORE in self._reader.absent

    def _mute(self, now_s: float) -> Statement:
        """Nothing readable comes from the applet."""
        if now_s < self._unreadable_s + times.ANSWER_MAX_S:
            return Statement(Reason.UNREADABLE, self._unreadable)
        return _SILENT

    def _misfit(self, applied: dict[str, int]) -> Statement | None:
        """The applet flies another airframe, or obeys somebody else."""
        motors, owner = applied["motors"], applied["owner"]
        airframe = None
        if motors != self._vehicle.motors:
            airframe = Statement(Reason.APPLET_MOTORS, f"{motors} motors, not {self._vehicle.motors}")
        elif not self._card.stock_agrees:
            airframe = Statement(Reason.CARD_DIFFERS, self._vehicle.name)
        twin = Statement(Reason.TWIN, f"instance {owner}") if owner not in (0, self._instance) else None
        return first(twin, airframe)

    def _in_force(self, applied: dict[str, int]) -> InForce:
        source = Source(min(applied["source"], max(Source)))
        flags, failed = applied["flags"], applied["failed"]
        released = source == Source.MATRIX and bool(flags & Flag.YAW_RELEASED)
        by_table = source == Source.DECLARATION and bool(flags & Flag.MATRIX) and self._card.without_yaw(failed)
        return InForce(
            source=source,
            failed=read_only(((failed >> np.arange(self._vehicle.motors)) & 1).astype(bool)),
            yaw_released=released or by_table,
            refused=MappingProxyType({name: applied[name] for name in tunnel.REFUSALS}),
        )

    def _telemetry(self) -> TelemetryTable | None:
        """HIGHRES_IMU carries the gyro behind INS_GYRO_FILTER and the accelerometer behind INS_ACCEL_FILTER."""
        values = self._reader.values
        if "INS_GYRO_FILTER" not in values or "INS_ACCEL_FILTER" not in values:
            return None
        return TelemetryTable(values["INS_GYRO_FILTER"], values["INS_ACCEL_FILTER"])

    def _notes(self, now_s: float, applied: dict[str, int] | None, obstacle: Statement | None) -> tuple[Statement, ...]:
        out = []
        young = self._heard_s is None or now_s < self._heard_s + times.GROUND_PATIENCE_S
        if obstacle is not None and obstacle is not _READING and not (obstacle is _SILENT and young):
            out.append(obstacle)
        if applied is not None:
            runs_s = 1e-3 * (applied["time_ms"] - applied["boot_ms"])
            if not applied["flags"] & Flag.WATCHDOG and runs_s > times.GROUND_PATIENCE_S:
                out.append(Statement(Reason.WATCHDOG_SILENT))
            differing = self._card.differing()
            if differing and self._decoder.armed:
                out.append(Statement(Reason.TABLES_DIFFER, str(len(differing))))
        return tuple(out)

    def findings(self) -> list[Finding]:
        """Applet, watchdog, card, tables, and the parameters that must agree with the airframe."""
        now_s, values = self._now_s, self._reader.values
        applied = self._applied if self._answers(now_s) else None
        mute = self._mute(now_s)
        silent = "does not answer: installed? SCR_ENABLE 1?" if mute is _SILENT else mute.detail
        runs = applied is not None and bool(applied["flags"] & Flag.WATCHDOG)
        motors = "the applet does not say" if applied is None else f"the applet flies {applied['motors']}"
        stock = applied is not None and bool(self._card.stock_agrees)
        differs = Statement(Reason.CARD_DIFFERS, self._vehicle.name).text if applied is not None else silent
        wrong = self._contradictions + [f"no answer for {name}" for name in self._absent()]
        wrong += [_NOT_COMPARED] if self._not_compared(applied) else []
        read = self._reader.complete and not wrong
        out = [
            Finding("applet", applied is not None, "answers" if applied is not None else silent),
            Finding("watchdog", runs, "runs" if runs else "is silent"),
            Finding("motors", applied is not None and applied["motors"] == self._vehicle.motors, motors),
            Finding("card", stock, self._mixer() if stock else differs),
            Finding("tables", applied is not None and self._card.agrees, self._card.report()),
            Finding("parameters", read, "; ".join(wrong) or ("agree with the airframe" if read else _READING.text)),
        ]
        if applied is not None and applied["owner"] not in (0, self._instance):
            out.append(Finding("companion", False, f"the applet obeys another one, instance {applied['owner']}"))
        return out + [Finding("advice", None, text) for text in checks.advice(values, self._vehicle)]

    def _mixer(self) -> str:
        """What is in the mixer's place on the card, and by what that was found good; the stock one is the file's."""
        text, frame = f"the mixer is that of {self._vehicle.name}", checks.compared_with(self._reader.values)
        if not frame:
            return f"{text}; which frame it was compared with is not known"
        at = " at the installation" if self._reader.values.get("FRAME_CLASS") == checks.FRAME_CLASS_SCRIPTED else ""
        return f"{text}, which was compared{at} with {frame}"

    # -- commands -----------------------------------------------------------------------------------------------

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Parameters that are still unknown and the heartbeat; on the ground, where it may act, tables that differ."""
        self._now_s = now_s
        out = self._reader.tick(now_s)
        if out:
            self._condition = None
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + times.HEARTBEAT_INTERVAL_S
            out.append(self._message(Kind.HEARTBEAT))
        if permit == Permit.ACT and self._decoder.armed is False and self.condition(now_s).command is None:
            table = self._card.upload(now_s)
            if table is not None:
                out.append(self._message(Kind.TABLE, failed=table[0], rows=table[1]))
        return out

    def encode(self, command: Command) -> list[Message]:
        """Messages that tell the applet; none for a matrix that it cannot carry."""
        sample_ms = tunnel.milliseconds(command.time_s)
        if isinstance(command, Declare):
            return [self._message(Kind.DECLARATION, sample_ms=sample_ms, failed=_mask(command.failed))]
        if isinstance(command, Load):
            return self._matrix(command, sample_ms)
        if isinstance(command, Drive):
            c = self._vehicle.command
            pwm = np.round(c.pwm_min + (c.pwm_max - c.pwm_min) * np.clip(command.outputs, 0.0, 1.0)).astype(np.uint16)
            timeout_ms = round(1e3 * times.OVERRIDE_TIMEOUT_S)
            return [self._message(Kind.OVERRIDE, sample_ms=sample_ms, timeout_ms=timeout_ms, pwm=pwm)]
        self._set_untold(None)
        if command.leaving:
            self._next_heartbeat_s = np.inf  # it would take back the goodbye
        return [self._message(Kind.RELEASE, sample_ms=sample_ms, flags=tunnel.LEAVING if command.leaving else 0)]

    def _matrix(self, command: Load, sample_ms: int) -> list[Message]:
        try:
            rows = factors.of_matrix(self._vehicle, command.plan.matrix)
        except AllocationInfeasible as error:
            self._set_untold(Statement(Reason.NOT_TOLD, str(error)))
            return []
        self._set_untold(None)
        return [
            self._message(
                Kind.MATRIX,
                sample_ms=sample_ms,
                timeout_ms=round(1e3 * command.timeout_s),
                failed=_mask(command.failed),
                flags=tunnel.YAW_RELEASED if command.plan.released else 0,
                rows=rows,
            )
        ]

    def _set_untold(self, untold: Statement | None) -> None:
        if untold != self._untold:
            self._untold, self._condition = untold, None

    def _message(
        self, kind: Kind, *, rows: NDArray[np.int16] | None = None, pwm: NDArray[np.uint16] | None = None, **v: int
    ) -> Message:
        self._sequence = tunnel.following(self._sequence)
        inner = TunnelMessage(kind, {"sequence": self._sequence, "instance": self._instance, **v}, rows, pwm)
        return tunnel.wrap(inner.pack(), self.target)


def _mask(failed: NDArray[np.bool_]) -> int:
    return int((1 << np.flatnonzero(failed)).sum())
