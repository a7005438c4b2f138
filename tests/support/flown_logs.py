"""Flights of a rigid body that turns by its motors, as the readers of logs hand them over."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.replay.flight import Frame, LogFlight, Reading, Row
from nff_companion.replay.parameters import Parameters

RATE_HZ = 200.0


@dataclass(frozen=True)
class Flight:
    """``lost``: share that is left of a motor (from 1) after ``fail_s`` of the flight."""

    vehicle: Vehicle
    seconds: float = 20.0
    fail_s: float = 12.0
    lost: dict[int, float] = field(default_factory=dict)
    noise_rad_s: float = 0.002
    turns_rad: float = 0.0  # to both sides, every five seconds
    finer: bool = False  # the motors answer between the samples, as they do, and not in steps

    def rows(self, rng: np.random.Generator) -> list[Row]:
        """It holds its attitude by a rate loop, is shaken by torques that its mixer asks for, and lands nowhere."""
        model, dt_s = self.vehicle, 1.0 / RATE_HZ
        accelerations = model.acceleration_effectiveness
        mixer = np.linalg.pinv(accelerations)
        rate, angle, wanted = np.zeros(3), np.zeros(3), np.zeros(3)
        lagged = np.full(model.motors, model.hover)
        rows: list[Row] = []
        for k in range(round(self.seconds * RATE_HZ)):
            wanted += (3.0 * rng.standard_normal(3) - wanted) * 0.2
            goal = np.array([0.0, 0.0, self.turns_rad * np.sin(2.0 * np.pi * 0.2 * k * dt_s)])
            turn = wanted * [4.0, 4.0, 1.0] - 8.0 * rate - 16.0 * (angle - goal)
            asked = np.clip(model.hover + mixer[:, 1:] @ turn, 0.0, 1.0)
            before, lag_s = lagged, max(model.motor.time_constant_up_s, 1e-6)
            lagged = lagged + (asked - lagged) * (1.0 - np.exp(-dt_s / lag_s))
            given = asked + (before - lagged) * lag_s / dt_s if self.finer else lagged.copy()
            for motor, share in self.lost.items():
                given[motor - 1] *= share if k * dt_s >= self.fail_s else 1.0
            up, *turning = accelerations @ given
            rate = rate + np.array(turning) * dt_s
            angle = np.clip(angle + rate * dt_s, -1.0, 1.0)
            noise = self.noise_rad_s * rng.standard_normal(3)
            rows.append((100.0 + k * dt_s, self._sample(100.0 + k * dt_s, rate + noise, up, asked)))
        return rows

    def _sample(self, time_s: float, rate: NDArray[np.float64], up: float, thrust: NDArray[np.float64]) -> Sample:
        return Sample(
            time_s=time_s,
            gyro_rad_s=rate,
            specific_force_m_s2=np.array([0.0, 0.0, -up]),
            output=self.vehicle.output_for(thrust),
            armed=True,
        )


def log_flight(
    rows: list[Row],
    parameters: dict[str, float] | None = None,
    *,
    autopilot: Literal["ardupilot", "px4", ""] = "ardupilot",
    motors: int | None = None,
    name: str = "flight.bin",
    outputs_hz: float = RATE_HZ,
) -> LogFlight:
    """A log that tells its ``parameters`` and so many ``motors``; None: it does not say."""
    told = Parameters()
    for key, value in (parameters or {}).items():
        told.put(0.0, key, value)
    return LogFlight(
        path=Path(name),
        autopilot=autopilot,
        system=None,
        parameters=told,
        frame=None if motors is None else Frame(f"{motors} motors", motors),
        first_s=rows[0][0],
        take_off_s=rows[0][0],
        read=lambda vehicle: Reading(rows, "RCOU", outputs_hz),
    )
