"""Inertial sensors with noise, bias and vibration, and the autopilot's own state estimate with noise and delay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sitl import rotation
from sitl.airframe import PlantParameters
from sitl.compiled import kernel, part
from sitl.noise import NormalBlocks
from sitl.plant import Motion, PlantState, specific_force_at

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
_TURN = 2 * math.pi

SENSORS = np.dtype(
    [
        ("gyro_bias_rad_s", "f8", (3,)),
        ("accelerometer_bias_m_s2", "f8", (3,)),
        ("imu_m", "f8", (3,)),
        ("gyro_turn", "f8", (3, 3)),  # rows: its axes in the body's
        ("accelerometer_turn", "f8", (3, 3)),
        ("gyro_filter", "f8", (3,)),  # b, a1, a2
        ("accelerometer_filter", "f8", (3,)),
        ("gyro_memory", "f8", (3, 2)),
        ("accelerometer_memory", "f8", (3, 2)),
        ("wander", "f8", (9,)),  # error of attitude rad, position m, velocity m/s
        ("decay", "f8"),  # of that error in a step
        ("dt_s", "f8"),
    ]
)
SHAKER = np.dtype(
    [
        ("full_speed_rad_s", "f8"),
        ("max_thrust_n", "f8"),
        ("phase", "f8"),
        ("strength", "f8"),  # 1: of a whole propeller
        ("roll", "f8"),  # share of the gyro's shaking
        ("pitch", "f8"),
        ("yaw", "f8"),
        ("x", "f8"),  # and of the accelerometer's
        ("y", "f8"),
        ("z", "f8"),
    ]
)
_WANDER = np.repeat([_ATTITUDE_NOISE_RAD, _POSITION_NOISE_M, _VELOCITY_NOISE_M_S], 3)


@dataclass(slots=True)
class Measured:
    """What the autopilot knows: filtered sensors and its own estimate. Shapes (N, .), FRD and NED.

    Each cycle gives each field a new array: who keeps one keeps what it was.
    """

    gyro_rad_s: NDArray[np.float64]
    specific_force_m_s2: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]

    def renewed(self) -> Reading:
        """Its arrays after each was replaced by a copy, to be written."""
        self.gyro_rad_s, self.specific_force_m_s2 = self.gyro_rad_s.copy(), self.specific_force_m_s2.copy()
        self.quaternion = self.quaternion.copy()
        self.position_m, self.velocity_m_s = self.position_m.copy(), self.velocity_m_s.copy()
        return self.reading()

    def reading(self) -> Reading:
        """Its arrays."""
        return Reading(self.gyro_rad_s, self.specific_force_m_s2, self.quaternion, self.position_m, self.velocity_m_s)


class Reading(NamedTuple):
    """The arrays of ``Measured``."""

    gyro_rad_s: NDArray[np.float64]
    specific_force_m_s2: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]


class Instruments(NamedTuple):
    """What ``sample`` and ``estimate`` read and write."""

    sensors: NDArray[np.void]  # (N,) of SENSORS
    shakers: NDArray[np.void]  # (N, m) of SHAKER
    noise: NDArray[np.float64]  # (N, block, 15)
    past: NDArray[np.float64]  # (N, steps, 6) position and velocity, a ring


def low_pass(cutoff_hz: float, dt_s: float) -> tuple[float, float, float]:
    """Second-order Butterworth low-pass by bilinear transform: b, a1, a2; ``cutoff_hz`` 0 passes through, b = 0."""
    if cutoff_hz <= 0.0:
        return 0.0, 0.0, 0.0
    warped = math.tan(math.pi * cutoff_hz * dt_s)
    scale = 1.0 + math.sqrt(2.0) * warped + warped**2
    return warped**2 / scale, 2.0 * (warped**2 - 1.0) / scale, (1.0 - math.sqrt(2.0) * warped + warped**2) / scale


@part
def _filtered(coefficients: NDArray[np.float64], memory: NDArray[np.float64], axis: int, value: float) -> float:
    """One sample through ``low_pass``."""
    b = coefficients[0]
    if b == 0.0:
        return value
    last, last_but_one = memory[axis, 0], memory[axis, 1]
    new = value - coefficients[1] * last - coefficients[2] * last_but_one
    memory[axis, 0], memory[axis, 1] = new, last
    return b * (new + 2.0 * last + last_but_one)


@part
def _along(axes: NDArray[np.float64], vector: rotation.Vector) -> rotation.Vector:
    """Components of ``vector`` along each row of ``axes``."""
    x, y, z = vector
    return (
        axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z,
        axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z,
        axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z,
    )


@part
def sample(n: int, instruments: Instruments, motion: Motion, reading: Reading, draw: int, step: int) -> None:
    """Sample the inertial sensors of vehicle ``n``; ``draw``: place of the step's noise."""
    own, noise = instruments.sensors[n], instruments.noise
    x = y = z = p = q = r = 0.0
    for i in range(motion.thrust_n.shape[1]):
        shaker = instruments.shakers[n, i]
        squared = abs(motion.thrust_n[n, i]) / shaker.max_thrust_n  # of the rotor's speed over the full one
        phase = shaker.phase + own.dt_s * shaker.full_speed_rad_s * math.sqrt(squared)
        while phase >= _TURN:
            phase -= _TURN
        shaker.phase = phase
        shake = shaker.strength * math.sin(phase) * squared
        p += shake * shaker.roll
        q += shake * shaker.pitch
        r += shake * shaker.yaw
        x += shake * shaker.x
        y += shake * shaker.y
        z += shake * shaker.z
    shaken, pushed = (p, q, r), (x, y, z)
    rate = _along(own.gyro_turn, rotation.vector(motion.rate_rad_s, n))
    force = _along(own.accelerometer_turn, specific_force_at(n, motion, rotation.components(own.imu_m)))
    for k in range(3):
        gyro = rate[k] + own.gyro_bias_rad_s[k] + _GYRO_NOISE_RAD_S * noise[n, draw, k]
        gyro += _VIBRATION_GYRO_RAD_S * shaken[k]
        felt = force[k] + own.accelerometer_bias_m_s2[k] + _ACCELEROMETER_NOISE_M_S2 * noise[n, draw, 3 + k]
        felt += _VIBRATION_ACCELEROMETER_M_S2 * pushed[k]
        reading.gyro_rad_s[n, k] = _filtered(own.gyro_filter, own.gyro_memory, k, gyro)
        reading.specific_force_m_s2[n, k] = _filtered(own.accelerometer_filter, own.accelerometer_memory, k, felt)
    drive = math.sqrt(1 - own.decay * own.decay)
    for k in range(9):
        own.wander[k] = own.decay * own.wander[k] + drive * _WANDER[k] * noise[n, draw, 6 + k]
    past = instruments.past
    place = step % past.shape[1]
    for k in range(3):
        past[n, place, k], past[n, place, 3 + k] = motion.position_m[n, k], motion.velocity_m_s[n, k]


@part
def estimate(n: int, instruments: Instruments, motion: Motion, reading: Reading, step: int) -> None:
    """The autopilot's own estimate of vehicle ``n`` after its ``step``-th sample."""
    wander, past = instruments.sensors[n].wander, instruments.past
    oldest = (step + 1) % past.shape[1] if step >= past.shape[1] else 0
    attitude = rotation.quaternion(motion.quaternion, n)
    rotation.put_quaternion(reading.quaternion, n, rotation.turned(attitude, rotation.components(wander)))
    for k in range(3):
        reading.position_m[n, k] = past[n, oldest, k] + wander[3 + k]
        reading.velocity_m_s[n, k] = past[n, oldest, 3 + k] + wander[6 + k]


@kernel
def _settle(instruments: Instruments, motion: Motion, reading: Reading, place: tuple[int, int], steps: int) -> None:
    draw, step = place
    for n in range(len(motion.battery)):
        for k in range(steps):
            sample(n, instruments, motion, reading, draw + k, step + k)
        estimate(n, instruments, motion, reading, step + steps - 1)


def _axes(turn_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3, 3) rows: the axes, in the body's, of sensors turned by the rotation vectors (N, 3)."""
    return Rotation.from_rotvec(turn_rad).as_matrix().swapaxes(1, 2)


class Sensors:
    """One set for the fleet; ``measured`` is what they say."""

    def __init__(self, parameters: PlantParameters, dt_s: float, generators: list[np.random.Generator]) -> None:
        n, m = parameters.vehicles, parameters.motors
        self._noise = NormalBlocks(generators, 15)
        self._sensors, self._shakers = np.zeros(n, SENSORS), np.zeros((n, m), SHAKER)
        bias = np.stack([g.standard_normal(6) for g in generators])
        self._sensors["gyro_bias_rad_s"] = _GYRO_BIAS_RAD_S * bias[:, :3]
        self._sensors["accelerometer_bias_m_s2"] = _ACCELEROMETER_BIAS_M_S2 * bias[:, 3:]
        gyro, accelerometer = parameters.gyro_filter_hz.tolist(), parameters.accelerometer_filter_hz.tolist()
        self._sensors["gyro_filter"] = [low_pass(cutoff, dt_s) for cutoff in gyro]
        self._sensors["accelerometer_filter"] = [low_pass(cutoff, dt_s) for cutoff in accelerometer]
        self._sensors["imu_m"] = parameters.imu_m
        self._sensors["gyro_turn"] = _axes(parameters.gyro_turn_rad)
        self._sensors["accelerometer_turn"] = _axes(parameters.accelerometer_turn_rad)
        self._sensors["decay"], self._sensors["dt_s"] = math.exp(-dt_s / _WANDER_TIME_S), dt_s
        self._shakers["strength"] = 1.0
        self._shakers["phase"] = np.stack([g.uniform(0, 2 * math.pi, m) for g in generators])
        direction = np.stack([g.standard_normal((m, 6)) for g in generators]) / math.sqrt(m)
        for k, name in enumerate(("roll", "pitch", "yaw", "x", "y", "z")):
            self._shakers[name] = direction[..., k]
        self._shakers["full_speed_rad_s"] = parameters.max_speed_rad_s
        self._shakers["max_thrust_n"] = parameters.max_thrust_n
        self._past = np.zeros((n, max(round(_ESTIMATOR_DELAY_S / dt_s), 1), 6))
        self._step = 0
        self.measured = Measured(
            gyro_rad_s=np.zeros((n, 3)),
            specific_force_m_s2=np.zeros((n, 3)),
            quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            position_m=np.zeros((n, 3)),
            velocity_m_s=np.zeros((n, 3)),
        )

    def take(self, steps: int) -> tuple[Instruments, tuple[int, int]]:
        """For ``sample`` over that many steps: what it needs, and the place of the first one's noise and its number."""
        self._step += steps
        place = self._noise.take(steps), self._step - steps
        return Instruments(self._sensors, self._shakers, self._noise.buffer, self._past), place

    def switch(self, vehicle: int, gyro_rad_s: NDArray[np.float64], accelerometer_m_s2: NDArray[np.float64]) -> None:
        """Another inertial unit from now on: its biases (3,) are these beyond those of the one before."""
        self._sensors["gyro_bias_rad_s"][vehicle] += gyro_rad_s
        self._sensors["accelerometer_bias_m_s2"][vehicle] += accelerometer_m_s2

    def mislead(self, vehicle: int, error: NDArray[np.float64]) -> None:
        """The autopilot's estimate is off at once by ``error`` (9,): attitude rad (body), position m, velocity m/s; it
        comes back within seconds."""
        self._sensors["wander"][vehicle] += error

    def settle(self, state: PlantState, steps: int) -> None:
        """Sample a state at rest ``steps`` times, and estimate it."""
        instruments, place = self.take(steps)
        _settle(instruments, state.motion(), self.measured.renewed(), place, steps)
