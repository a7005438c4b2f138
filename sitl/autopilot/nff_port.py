"""The companion's messages of our dialect, given to one vehicle's port, which refuses and counts what is absurd."""

from __future__ import annotations

import numpy as np

from nff_companion.mavlink.codec import Message
from sitl.fleet import Fleet
from sitl.telemetry import BOOT_S


class NffPort:
    """Takes NFF_* messages for one vehicle of a fleet."""

    def __init__(self, fleet: Fleet, vehicle: int = 0) -> None:
        self._fleet, self._vehicle = fleet, vehicle
        self._handlers = {
            "NFF_ALLOCATION_MATRIX": self._matrix,
            "NFF_ACTUATOR_OVERRIDE": self._override,
            "NFF_MOTOR_DECLARATION": self._declaration,
        }

    def take(self, message: Message) -> bool:
        """Take one message; whether it was one of ours."""
        handler = self._handlers.get(message.get_type())
        if handler is None:
            return False
        handler(message)
        self._fleet.autopilot.port_changed()
        return True

    def _matrix(self, message: Message) -> None:
        axes, motors = message.axes, message.motors
        values = np.array(message.factors, float)
        matrix = values[: axes * motors].reshape(motors, axes) if axes * motors <= len(values) else np.zeros((0, 0))
        self._fleet.autopilot.ports[self._vehicle].receive_matrix(
            matrix,
            sequence=message.sequence,
            timeout_s=1e-3 * message.timeout_ms,
            valid=bool(message.valid),
            sample_s=_sample_s(message),
            now_s=self._fleet.time_s,
        )

    def _override(self, message: Message) -> None:
        self._fleet.autopilot.ports[self._vehicle].receive_override(
            np.array(message.outputs[: message.motors], float),
            sequence=message.sequence,
            timeout_s=1e-3 * message.timeout_ms,
            armed=bool(self._fleet.autopilot.armed[self._vehicle]),
            sample_s=_sample_s(message),
            now_s=self._fleet.time_s,
        )

    def _declaration(self, message: Message) -> None:
        motors = self._fleet.parameters.motors
        failed = ((message.failed_mask >> np.arange(motors)) & 1).astype(bool)
        if message.failed_mask >> motors:
            failed = np.zeros(0, bool)  # names motors that are not there: refused as a wrong dimension
        self._fleet.autopilot.ports[self._vehicle].receive_declaration(
            failed,
            armed=bool(self._fleet.autopilot.armed[self._vehicle]),
            sequence=message.sequence,
            sample_s=_sample_s(message),
            now_s=self._fleet.time_s,
        )


def _sample_s(message: Message) -> float:
    """Time of the sample that a command answers, on the fleet's clock."""
    return float(1e-6 * message.sample_usec - BOOT_S)
