"""Flights without failures, as the network is trained on: inputs and residuals of each condition, at up to 50 Hz.

A condition is what stays the same during one flight: this vehicle, this payload, this wind. Inputs and residuals come
out of the companion's own step, so that training and flight see the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion import condition as conditions
from nff_companion.companion import Companion
from nff_companion.core.parts import Parts
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import AXES, Vehicle
from nff_companion.errors import LogError

RATE_HZ = 50.0
_SETTLE_S = 2.0  # of each flight left out: filters and take-off
_ROWS_MIN = 400
_NOBODY = conditions.Condition()  # there is no autopilot to be told
_MEAN_MAX_MOTORS = 2.5  # mean residual of a flight, in losses of one motor at hover: beyond it is another vehicle


@dataclass(frozen=True)
class Condition:
    """One flight: ``features`` (L, d) and ``residual`` (L, n) in SI, ``rate_hz`` rows a second."""

    name: str
    features: NDArray[np.float64]
    residual: NDArray[np.float64]
    rate_hz: float = RATE_HZ


@dataclass(frozen=True)
class Dataset:
    """Conditions, and what identifies them."""

    conditions: list[Condition]

    @property
    def sha256(self) -> str:
        """Hash over all rows, in single precision."""
        digest = hashlib.sha256()
        for condition in self.conditions:
            digest.update(np.ascontiguousarray(condition.features, np.float32).tobytes())
            digest.update(np.ascontiguousarray(condition.residual, np.float32).tobytes())
        return digest.hexdigest()

    @property
    def minutes(self) -> float:
        """Flight time."""
        return sum(len(c.features) / c.rate_hz for c in self.conditions) / 60.0


class Recorder:
    """Takes the samples of one flight; ``condition`` is what has come of them."""

    def __init__(self, vehicle: Vehicle, rate_hz: float) -> None:
        # phi a may explain everything: no motor is looked for in flights without failures.
        self._companion = Companion(vehicle, rate_hz, parts=Parts(name="nf", identify=False))
        self._state = self._companion.start(conditions.Mode.OBSERVE)
        self._vehicle, self._rate_hz = vehicle, min(rate_hz, RATE_HZ)
        self._features: list[NDArray[np.float64]] = []
        self._residual: list[NDArray[np.float64]] = []
        self._due_s = -np.inf
        self._flying_since_s: float | None = None

    def add(self, sample: Sample) -> None:
        """One telemetry sample."""
        self._state, output = self._companion.step(self._state, sample, _NOBODY)
        estimate = output.estimate
        if estimate is None:
            self._flying_since_s = None
            return
        if self._flying_since_s is None:
            self._flying_since_s = self._due_s = output.time_s
        if output.time_s - self._flying_since_s < _SETTLE_S or output.time_s < self._due_s - 1e-9:
            return
        self._due_s += max(1.0 / RATE_HZ, output.time_s - self._due_s - 1.0 / RATE_HZ)
        if estimate.features is not None:
            self._features.append(estimate.features)
            self._residual.append(estimate.raw)

    def condition(self, name: str) -> Condition:
        """The flight so far. Raises LogError when it is too short, or lacks attitude and velocity."""
        if len(self._features) < _ROWS_MIN:
            raise LogError(
                f"{name} has {len(self._features)} rows at {self._rate_hz:.0f} Hz of flight with attitude and velocity;"
                f" {_ROWS_MIN} are needed: log ATTITUDE_QUATERNION and LOCAL_POSITION_NED, or vehicle_attitude and"
                " vehicle_local_position"
            )
        residual = np.array(self._residual)
        self._plausible(name, residual)
        return Condition(name, np.array(self._features), residual, self._rate_hz)

    def _plausible(self, name: str, residual: NDArray[np.float64]) -> None:
        """Raises LogError where the airframe cannot be the one that flew."""
        one = np.sqrt(((self._vehicle.acceleration_effectiveness * self._vehicle.hover) ** 2).mean(axis=1))
        mean = np.abs(residual.mean(axis=0))
        if (mean > _MEAN_MAX_MOTORS * one).any():
            axis = int((mean / one).argmax())
            raise LogError(
                f"{name}: on the {AXES[axis]} axis {self._vehicle.name} is off by as much as"
                f" {mean[axis] / one[axis]:.1f} lost motors in the mean: check airframe, motor order, mass and"
                " full thrust, and that no motor failed"
            )


def record(vehicle: Vehicle, rate_hz: float, samples: Iterable[Sample], name: str) -> Condition:
    """One flight. Raises LogError."""
    recorder = Recorder(vehicle, rate_hz)
    for sample in samples:
        recorder.add(sample)
    return recorder.condition(name)


def split(condition: Condition, seconds: float) -> list[Condition]:
    """A long flight as several conditions: the wind changes."""
    rows = max(round(seconds * condition.rate_hz), _ROWS_MIN)
    parts = max(len(condition.features) // rows, 1)
    pieces = zip(np.array_split(condition.features, parts), np.array_split(condition.residual, parts), strict=True)
    return [Condition(f"{condition.name}#{k + 1}", f, r, condition.rate_hz) for k, (f, r) in enumerate(pieces)]
