"""Adapter for an autopilot that speaks our dialect (the emulated one): declarations, matrices and outputs."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots import times
from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.schedule import Command, Declare, Drive, Load
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.condition import Condition, InForce, Reason, Source, Statement, read_only
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.streams import Stream

_FACTORS = 48
_OUTPUTS = 16
_REFUSALS = ("range", "nan", "stale", "replay", "dimension", "disarmed")
_SILENT = Statement(Reason.SILENT, "the autopilot (NFF_APPLIED)")


class NffAdapter:
    """One vehicle. ``target`` is the autopilot's (system, component)."""

    name = "nff"

    def __init__(self, vehicle: Vehicle, target: tuple[int, int]) -> None:
        self._vehicle, self.target = vehicle, target
        self._decoder = TelemetryDecoder(vehicle)
        self._sequence = 0
        self._in_force = InForce()
        self._applied_s = -np.inf  # of our clock

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

    def observe(self, message: Message, now_s: float) -> Sample | None:
        """Telemetry, and what the autopilot says of our commands."""
        if message.get_msgId() != dialect.MAVLINK_MSG_ID_NFF_APPLIED:
            return self._decoder.observe(message)
        self._applied_s = now_s
        bits = np.arange(self._vehicle.motors)
        self._in_force = InForce(
            source=Source(min(message.source, max(Source))),
            failed=read_only(((message.failed_mask >> bits) & 1).astype(bool)),
            refused=MappingProxyType({name: getattr(message, f"refused_{name}") for name in _REFUSALS}),
        )
        return None

    def condition(self, now_s: float) -> Condition:
        """An autopilot that does not answer does not obey either."""
        obstacle = None if now_s - self._applied_s <= times.ANSWER_MAX_S else _SILENT
        if self._decoder.drives_more:
            # This autopilot drives nothing but motors: the airframe file is another vehicle's.
            more = f"the autopilot drives more outputs than the airframe's {self._vehicle.motors} motors"
            obstacle = Statement(Reason.CONTRADICTION, more)
        return Condition(
            armed=self._decoder.armed,
            command=obstacle,
            takes_matrix=True,
            in_force=self._in_force,
        )

    def encode(self, command: Command) -> list[Message]:
        """Messages that tell the autopilot."""
        sample_usec = round(1e6 * command.time_s)
        if isinstance(command, Declare):
            mask = int((1 << np.flatnonzero(command.failed)).sum())
            return [dialect.MAVLink_nff_motor_declaration_message(sample_usec, self._next(), mask, *self.target)]
        if isinstance(command, Drive):
            outputs = command.outputs.tolist()
            padded = outputs + [math.nan] * (_OUTPUTS - len(outputs))
            timeout_ms = round(1e3 * times.OVERRIDE_TIMEOUT_S)
            return [
                dialect.MAVLink_nff_actuator_override_message(
                    sample_usec, self._next(), timeout_ms, *self.target, len(outputs), padded
                )
            ]
        if isinstance(command, Load):
            return [self._matrix(sample_usec, command.plan.matrix, command.timeout_s)]
        return [self._matrix(sample_usec, None, times.MATRIX_TIMEOUT_S)]

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Nothing is due without telemetry."""
        return []

    def findings(self) -> list[Finding]:
        """Whether it says what it has in force."""
        heard = bool(np.isfinite(self._applied_s))
        return [Finding("autopilot", heard, "NFF_APPLIED is heard" if heard else "NFF_APPLIED is not heard")]

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) % 2**32
        return self._sequence

    def _matrix(self, sample_usec: int, matrix: NDArray[np.float64] | None, timeout_s: float) -> Message:
        """``matrix`` (m, n), None: the one in force is dropped."""
        factors = np.zeros(_FACTORS)
        motors, axes, valid = 0, 0, 0
        if matrix is not None:
            motors, axes, valid = *matrix.shape, 1
            factors[: motors * axes] = matrix.ravel()
        timeout_ms = round(1e3 * timeout_s)
        return dialect.MAVLink_nff_allocation_matrix_message(
            sample_usec, self._next(), timeout_ms, *self.target, axes, motors, valid, factors.tolist()
        )
