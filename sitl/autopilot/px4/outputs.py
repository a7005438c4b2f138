"""From motor thrusts to the pulses of the outputs, as FunctionMotors and MixingOutput of PX4's mixer_module do it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot.mixer import thrust_to_output
from sitl.autopilot.px4.parameters import FIRST_MOTOR, ParameterTable


@dataclass(frozen=True, kw_only=True)
class Outputs:
    """``motor`` (m,) whose index each output drives, -1: none; pulses (m,) us; ``curve`` is THR_MDL_FAC."""

    motor: NDArray[np.int_]
    least_us: NDArray[np.float64]
    most_us: NDArray[np.float64]
    disarmed_us: NDArray[np.float64]
    curve: float

    @staticmethod
    def read(table: ParameterTable, motors: int) -> Outputs:
        """From PWM_MAIN_FUNCn, MINn, MAXn, DISn."""

        def of(what: str) -> NDArray[np.float64]:
            return np.array([table[f"PWM_MAIN_{what}{k + 1}"] for k in range(motors)])

        motor = of("FUNC").astype(int) - FIRST_MOTOR
        curve = table["THR_MDL_FAC"]
        return Outputs(
            motor=np.where((motor >= 0) & (motor < motors), motor, -1),
            least_us=of("MIN"),
            most_us=of("MAX"),
            disarmed_us=of("DIS"),
            curve=curve if 0.0 < curve <= 1.0 else 0.0,
        )

    def wired_as(self, other: Outputs) -> Outputs:
        """With the motors of ``other``: functions change on the ground alone."""
        return replace(self, motor=other.motor)

    def pulses_us(self, thrust: NDArray[np.float64], stopped: NDArray[np.bool_]) -> NDArray[np.float64]:
        """(m,) for motor thrusts (m,) in 0..1; motors ``stopped`` (m,), and outputs without one, get the disarmed."""
        command = thrust_to_output(thrust, self.curve, 0.0, 1.0)[self.motor]
        pulse = self.least_us + (self.most_us - self.least_us) * command
        return np.where((self.motor < 0) | stopped[self.motor], self.disarmed_us, pulse)
