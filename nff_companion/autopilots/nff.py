"""Adapter for an autopilot that speaks our dialect (the emulated one): declarations, matrices and outputs."""

from __future__ import annotations

import math

import numpy as np

from nff_companion.autopilots.base import Applied, Capabilities, Finding, Stream
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.pipeline import Mode, Output

MATRIX_TIMEOUT_MS = 500
OVERRIDE_TIMEOUT_MS = 100
_MATRIX_INTERVAL_S = 0.05
_DECLARATION_INTERVAL_S = 0.05
_ANSWER_MAX_S = 1.0
_FACTORS = 48
_OUTPUTS = 16


class NffDialectAdapter:
    """One vehicle. ``target`` is the autopilot's (system, component)."""

    name = "nff"
    telemetry = None
    farewell_s = 0.0
    unfinished = False

    def __init__(self, vehicle: Vehicle, target: tuple[int, int]) -> None:
        self._vehicle, self.target = vehicle, target
        self._decoder = TelemetryDecoder(vehicle)
        self.capabilities = Capabilities(declare=True, matrix=True, outputs=True)
        self.applied = Applied()
        self._sequence = 0
        self._declared_sequence = 0
        self._declared = np.zeros(vehicle.motors, bool)
        self._declared_s = -np.inf
        self._matrix_s = -np.inf
        self._plan: object = None
        self._applied_s = -np.inf

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for; the inertial sample comes last in each cycle."""
        ids = dialect
        return [
            Stream(ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_HIGHRES_IMU, rate_hz),
            Stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, min(rate_hz, 100.0)),
            Stream(ids.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 20.0),
            Stream(ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0),
            Stream(ids.MAVLINK_MSG_ID_ESC_STATUS, min(rate_hz, 100.0), required=False),
            Stream(ids.MAVLINK_MSG_ID_NFF_APPLIED, 20.0),
        ]

    def observe(self, message: Message) -> Sample | None:
        """Telemetry, and what the autopilot says of our commands."""
        if message.get_msgId() == dialect.MAVLINK_MSG_ID_NFF_APPLIED:
            bits = np.arange(self._vehicle.motors)
            self._applied_s = 1e-6 * message.time_usec
            self.applied = Applied(
                source=message.source,
                failed=((message.failed_mask >> bits) & 1).astype(bool),
                matrix_sequence=message.matrix_sequence,
                override_sequence=message.override_sequence,
                declaration_sequence=message.declaration_sequence,
                refused={
                    name: getattr(message, f"refused_{name}")
                    for name in ("range", "nan", "stale", "replay", "dimension", "disarmed")
                },
            )
            return None
        return self._decoder.observe(message)

    def tick(self, now_s: float) -> list[Message]:
        """Nothing is due without telemetry."""
        return []

    def complaints(self) -> list[str]:
        """Nothing but what ``blocked`` says."""
        return []

    def findings(self) -> list[Finding]:
        """Whether it says what it has in force."""
        heard = bool(np.isfinite(self._applied_s))
        return [Finding("autopilot", heard, "NFF_APPLIED is heard" if heard else "NFF_APPLIED is not heard")]

    def hands_off(self) -> str:
        """Nothing stands in the way."""
        return ""

    def declare(self, failed: np.ndarray, time_s: float) -> list[Message]:
        """The declaration as it is now."""
        self._declared, self._declared_s = failed.copy(), time_s
        self._declared_sequence = self._next()
        mask = int((1 << np.flatnonzero(failed)).sum())
        sample_usec = round(1e6 * time_s)
        return [dialect.MAVLink_nff_motor_declaration_message(sample_usec, self._declared_sequence, mask, *self.target)]

    def verdict(self, output: Output) -> str:
        """The matrix, or the autopilot's own reduced mixing."""
        return "reallocated" if output.plan is not None else "NO matrix"

    def blocked(self, time_s: float, mode: Mode) -> str:
        """Why no command may be sent at ``time_s``: an autopilot that does not answer does not obey either."""
        if abs(time_s - self._applied_s) <= _ANSWER_MAX_S:
            return ""
        return "the autopilot does not say what it has in force (NFF_APPLIED): observing"

    def drive(self, outputs: np.ndarray, time_s: float) -> list[Message]:
        """Motor outputs (m,) that answer the sample of ``time_s``."""
        padded = outputs.tolist() + [math.nan] * (_OUTPUTS - len(outputs))
        return [
            dialect.MAVLink_nff_actuator_override_message(
                round(1e6 * time_s), self._next(), OVERRIDE_TIMEOUT_MS, *self.target, len(outputs), padded
            )
        ]

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) % 2**32
        return self._sequence

    def act(self, output: Output) -> list[Message]:
        """Declaration when it changed or is not yet confirmed, matrix at 20 Hz and on change."""
        if output.mode == Mode.OBSERVE:
            return []
        sample_usec = round(1e6 * output.time_s)
        messages: list[Message] = []
        changed = bool((output.failed != self._declared).any())
        confirmed = self.applied.failed is not None and bool((self.applied.failed == output.failed).all())
        again = not confirmed and not 0.0 <= output.time_s - self._declared_s < _DECLARATION_INTERVAL_S
        if output.flying and (changed or again):
            messages += self.declare(output.failed, output.time_s)
        if output.plan is not None:
            fresh = output.plan is not self._plan
            if fresh or not 0.0 <= output.time_s - self._matrix_s < _MATRIX_INTERVAL_S:
                self._plan, self._matrix_s = output.plan, output.time_s
                messages.append(self._matrix_message(output.plan.matrix, sample_usec))
        elif self._plan is not None:
            self._plan = None
            messages += self.release(output.time_s)
        return messages

    def _matrix_message(self, matrix: np.ndarray, sample_usec: int) -> Message:
        motors, axes = matrix.shape
        factors = np.zeros(_FACTORS)
        factors[: motors * axes] = matrix.ravel()
        return dialect.MAVLink_nff_allocation_matrix_message(
            sample_usec, self._next(), MATRIX_TIMEOUT_MS, *self.target, axes, motors, 1, factors.tolist()
        )

    def release(self, time_s: float) -> list[Message]:
        """Drop the matrix; outputs expire by themselves."""
        return [
            dialect.MAVLink_nff_allocation_matrix_message(
                round(1e6 * time_s), self._next(), MATRIX_TIMEOUT_MS, *self.target, 0, 0, 0, [0.0] * _FACTORS
            )
        ]
