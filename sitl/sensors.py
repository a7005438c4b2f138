"""Inertial sensors with noise, bias and vibration, and the autopilot's own state estimate with noise and delay."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import PlantParameters
from sitl.noise import NormalBlocks
from sitl.plant import PlantState

_GYRO_NOISE_RAD_S = 0.006
_GYRO_BIAS_RAD_S = 0.003
_ACCELEROMETER_NOISE_M_S2 = 0.08
_ACCELEROMETER_BIAS_M_S2 = 0.08
_VIBRATION_GYRO_RAD_S = 0.01
_VIBRATION_ACCELEROMETER_M_S2 = 1.0
_ATTITUDE_NOISE_RAD = math.radians(0.25)
_POSITION_NOISE_M = 0.05
_VELOCITY_NOISE_M_S = 0.03
_WANDER_TIME_S = 4.0
_ESTIMATOR_DELAY_S = 0.02


class LowPass:
    """Second-order Butterworth low-pass by bilinear transform, at rest at zero; ``cutoff_hz`` 0 passes through."""

    def __init__(self, cutoff_hz: float, dt_s: float) -> None:
        self._active = cutoff_hz > 0.0
        if self._active:
            warped = math.tan(math.pi * cutoff_hz * dt_s)
            scale = 1.0 + math.sqrt(2.0) * warped + warped**2
            self._b = warped**2 / scale
            self._a1 = 2.0 * (warped**2 - 1.0) / scale
            self._a2 = (1.0 - math.sqrt(2.0) * warped + warped**2) / scale
        self._d1: NDArray[np.float64] | float = 0.0
        self._d2: NDArray[np.float64] | float = 0.0

    def step(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """One sample (N, width)."""
        if not self._active:
            return value
        d0 = value - self._a1 * self._d1 - self._a2 * self._d2
        out = self._b * (d0 + 2.0 * self._d1 + self._d2)
        self._d2, self._d1 = self._d1, d0
        return out


@dataclass(slots=True)
class Measured:
    """What the autopilot knows: filtered sensors and its own estimate. Shapes (N, .), FRD and NED."""

    gyro_rad_s: NDArray[np.float64]
    specific_force_m_s2: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]


class Sensors:
    """One set for the fleet; ``step`` runs at the plant's rate, ``estimate`` at the autopilot's."""

    def __init__(self, parameters: PlantParameters, dt_s: float, generators: list[np.random.Generator]) -> None:
        n, m = parameters.vehicles, parameters.motors
        self._dt = dt_s
        self._noise = NormalBlocks(generators, 15)
        bias = np.stack([g.standard_normal(6) for g in generators])
        self._gyro_bias = _GYRO_BIAS_RAD_S * bias[:, :3]
        self._accelerometer_bias = _ACCELEROMETER_BIAS_M_S2 * bias[:, 3:]
        self._phase = np.stack([g.uniform(0, 2 * math.pi, m) for g in generators])
        self._direction = np.stack([g.standard_normal((m, 6)) for g in generators]) / math.sqrt(m)
        self._speed_scale = parameters.max_speed_rad_s
        self._max_thrust = parameters.max_thrust_n
        rest = np.zeros((n, 6))
        self._gyro_filter = LowPass(parameters.gyro_filter_hz, dt_s)
        self._accelerometer_filter = LowPass(parameters.accelerometer_filter_hz, dt_s)
        self._wander = np.zeros((n, 9))
        self._decay = math.exp(-dt_s / _WANDER_TIME_S)
        self._scale = math.sqrt(1 - self._decay**2) * np.repeat(
            [_ATTITUDE_NOISE_RAD, _POSITION_NOISE_M, _VELOCITY_NOISE_M_S], 3
        )
        steps = max(round(_ESTIMATOR_DELAY_S / dt_s), 1)
        self._delayed: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque(maxlen=steps)
        self.measured = Measured(
            gyro_rad_s=rest[:, :3],
            specific_force_m_s2=rest[:, 3:],
            quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            position_m=np.zeros((n, 3)),
            velocity_m_s=np.zeros((n, 3)),
        )

    def step(self, state: PlantState, specific_force: NDArray[np.float64]) -> None:
        """Sample the inertial sensors once; the result is in ``measured``."""
        normal = self._noise.next()
        speed = np.sqrt(state.thrust_n / self._max_thrust)
        self._phase = (self._phase + self._dt * self._speed_scale * speed) % (2 * math.pi)
        shake = np.vecmat(np.sin(self._phase) * speed**2, self._direction)
        gyro = state.rate_rad_s + self._gyro_bias + _GYRO_NOISE_RAD_S * normal[:, :3]
        accelerometer = specific_force + self._accelerometer_bias + _ACCELEROMETER_NOISE_M_S2 * normal[:, 3:6]
        gyro = gyro + _VIBRATION_GYRO_RAD_S * shake[:, :3]
        accelerometer = accelerometer + _VIBRATION_ACCELEROMETER_M_S2 * shake[:, 3:]
        self._wander = self._decay * self._wander + self._scale * normal[:, 6:]
        self._delayed.append((state.position_m, state.velocity_m_s))
        self.measured.gyro_rad_s = self._gyro_filter.step(gyro)
        self.measured.specific_force_m_s2 = self._accelerometer_filter.step(accelerometer)

    def estimate(self, state: PlantState) -> None:
        """The autopilot's own estimate of the last sample; the result is in ``measured``."""
        position, velocity = self._delayed[0]
        out = self.measured
        out.quaternion = rotation.normalise(
            rotation.multiply(state.quaternion, rotation.from_rotation_vector(self._wander[:, :3]))
        )
        out.position_m = position + self._wander[:, 3:6]
        out.velocity_m_s = velocity + self._wander[:, 6:9]
