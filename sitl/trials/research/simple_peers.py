"""Peers that name a motor by a threshold: recursive least squares, and the autopilots' own checks for a loss of thrust
and for a motor that draws no current."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.estimate import Measurement
from nff_companion.core.vehicle import Vehicle
from sitl import rotation
from sitl.trials.research.peer import Look, PeerEstimator

_PRIOR = 0.3  # deviation of an effectiveness before anything was seen
_WANDER_PER_S = 1.0  # of an effectiveness, per root of a second
_DISTURBED_PER_S = 0.5  # of the disturbance, in deviations of the residual
_LOST = 0.5  # effectiveness below which a motor is named

# ArduCopter/crash_check.cpp, thrust_loss_check.
_THROTTLE, _LEAN_DEG = 0.9, 15.0
# PX4 v1.16, failure_detector.cpp, updateMotorStatus: FD_ACT_MOT_THR, FD_ACT_MOT_TOUT.
_DRIVEN, _NO_CURRENT_S = 0.2, 0.1


class LeastSquares(PeerEstimator):
    """Effectiveness and a slow disturbance by recursive least squares, y = d + B0 diag(w) (eta - 1), which forgets by
    random walks; a motor is named below one half. ``memory``: eta - 1 and d (m + n,), and their covariance."""

    confirm_s = 0.02

    def memory(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """All motors whole, more or less, and no disturbance that one knows of."""
        prior = np.concatenate([np.full(self.vehicle.motors, _PRIOR**2), self._variance])
        return np.zeros(len(prior)), np.diag(prior)

    def look(
        self,
        memory: Any,
        residual: NDArray[np.float64],
        thrust: NDArray[np.float64],
        measurement: Measurement,
        failed: NDArray[np.bool_],
    ) -> Look:
        """The motor that lacks most."""
        state, covariance = memory
        m, n = self.vehicle.motors, self.vehicle.axes
        shown = np.concatenate([self._matrix * thrust, np.eye(n)], axis=1)
        wander = np.concatenate([np.full(m, _WANDER_PER_S**2), _DISTURBED_PER_S**2 * self._variance])
        covariance = covariance + np.diag(wander * measurement.dt_s)
        cross = covariance @ shown.T
        gain = np.linalg.solve(shown @ cross + self._noise, cross.T).T
        state = state + gain @ (residual - shown @ state)
        covariance = covariance - gain @ cross.T
        covariance = 0.5 * (covariance + covariance.T)
        eta = 1.0 + np.where(failed, 0.0, state[:m])
        worst = int(eta.argmin())
        named = worst if eta[worst] < _LOST else -1
        return Look((state, covariance), named, float(np.clip(1.0 - eta[worst], 0.0, 1.0)), eta, state[m:])


class ThrustLoss(PeerEstimator):
    """ArduCopter's check: nearly full throttle for 1 s while it sinks and hardly leans; the motor asked for most
    is named. What it cannot see from here, the attitude error, is left out. ``memory``: thrusts (m,), smoothed."""

    confirm_s = 1.0

    def __init__(self, vehicle: Vehicle, dt_s: float) -> None:
        super().__init__(vehicle, dt_s)
        self._share = 1.0 - math.exp(-dt_s / 0.5)

    def memory(self) -> NDArray[np.float64]:
        """Nothing asked yet."""
        return np.zeros(self.vehicle.motors)

    def look(
        self,
        memory: Any,
        residual: NDArray[np.float64],
        thrust: NDArray[np.float64],
        measurement: Measurement,
        failed: NDArray[np.bool_],
    ) -> Look:
        """By throttle, sinking and lean."""
        asked = memory + self._share * (np.where(failed, 0.0, measurement.command) - memory)
        motion = measurement.motion
        throttle = float(measurement.command[~failed].mean())
        lost = motion is not None and throttle > _THROTTLE and motion.velocity_m_s[2] > 0.0
        if lost and motion is not None:
            lost = math.degrees(float(rotation.tilt_of(motion.quaternion[None])[0])) < _LEAN_DEG
        named = int(asked.argmax()) if lost else -1
        return Look(asked, named, 1.0, np.ones(len(asked)), np.zeros(len(residual)))


class Current(PeerEstimator):
    """PX4's check: a motor that is driven and draws hardly any current for a tenth of a second. A motor that stands
    still draws none, and one that turns more than that check asks for: so it goes by the rotor speeds that the ESCs
    tell, and without them names nothing. No ``memory``."""

    confirm_s = _NO_CURRENT_S

    def memory(self) -> None:
        """Nothing is kept."""

    def look(
        self,
        memory: Any,
        residual: NDArray[np.float64],
        thrust: NDArray[np.float64],
        measurement: Measurement,
        failed: NDArray[np.bool_],
    ) -> Look:
        """The first that stands still while it is driven."""
        m, named = self.vehicle.motors, -1
        if measurement.stopped is not None:
            still = measurement.stopped & ~failed & (measurement.command > _DRIVEN)
            named = int(still.argmax()) if still.any() else -1
        eta = np.ones(m)
        eta[named] = 0.0 if named >= 0 else 1.0
        return Look(None, named, 1.0, eta, np.zeros(len(residual)))
