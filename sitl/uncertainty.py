"""How far the plant that flies is from its airframe file: drawn once a vehicle, known to nobody else."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sitl.airframe import PlantParameters

UNCERTAINTY_STREAM = 3  # of a seed's generators, its own: who draws nothing here flies as if this were not here
_OWN, _SENSORS = 8, 11  # draws of a vehicle as a whole, and of its sensors
_SPIN_SPAN_MIN = 0.1  # what is left between idle and full output, whatever is drawn
_CALIBRATED_SHARE = 0.2  # of what an estimate leaves open: an assumption until it is measured


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """Widths of what is drawn, each independent of the others; the default is a plant just as its file says.

    Factors are drawn log-uniform between their ends (low, high), all else uniform. Mass, inertia and the
    thrust of all motors together are ``model_error`` of the fleet's options, not repeated here.
    """

    lag_factor: tuple[float, float] = (1.0, 1.0)  # of both time constants
    lag_split: float = 0.0  # +- fraction that the rising one is slower, and the falling one quicker by as much
    torque_factor: tuple[float, float] = (1.0, 1.0)  # of torque over thrust
    thrust_expo: float = 0.0  # +-, kept within 0..1
    spin_min: float = 0.0  # +-, of full output
    motor_thrust: float = 0.0  # +- fraction, each motor by itself
    place: float = 0.0  # +- fraction of the rotor's arm, each rotor, in x and in y
    centre_of_mass: float = 0.0  # radius of a disc, as fraction of the longest arm
    output_delay_s: float = 0.0  # 0 to this: the motors hear later than telemetry tells
    imu_place: float = 0.0  # +- fraction of the longest arm, in x, y and z, beside where the centre of mass was put
    sensor_turn_rad: float = 0.0  # +- about each axis, of gyro and of accelerometer
    filter_factor: tuple[float, float] = (1.0, 1.0)  # of the cut-off of the gyro's filter and of the accelerometer's

    @classmethod
    def exact(cls) -> Uncertainty:
        """Nothing is drawn."""
        return cls()

    @classmethod
    def calibrated(cls) -> Uncertainty:
        """An airframe file fitted to flights of the vehicle."""
        return cls.estimated()._narrowed(_CALIBRATED_SHARE)

    @classmethod
    def geometry(cls) -> Uncertainty:
        """A file whose rotors were placed with a ruler, and whose vehicle was not balanced; nothing else is off."""
        full = cls.estimated()
        return cls(place=full.place, centre_of_mass=full.centre_of_mass)

    @classmethod
    def estimated(cls) -> Uncertainty:
        """An airframe file guessed from the frame, its size and weight, and data sheets."""
        return cls(
            lag_factor=(0.6, 1.6),
            lag_split=0.1,
            torque_factor=(0.6, 1.5),
            thrust_expo=0.3,
            spin_min=0.06,
            motor_thrust=0.08,
            place=0.05,
            centre_of_mass=0.04,  # 2 cm on an arm of 0.5 m
            output_delay_s=0.010,
            imu_place=0.06,  # 3 cm
            sensor_turn_rad=math.radians(2.0),
            filter_factor=(0.7, 1.4),
        )

    def _narrowed(self, share: float) -> Uncertainty:
        def towards_one(factor: tuple[float, float]) -> tuple[float, float]:
            return 1.0 + share * (factor[0] - 1.0), 1.0 + share * (factor[1] - 1.0)

        return Uncertainty(
            lag_factor=towards_one(self.lag_factor),
            lag_split=share * self.lag_split,
            torque_factor=towards_one(self.torque_factor),
            thrust_expo=share * self.thrust_expo,
            spin_min=share * self.spin_min,
            motor_thrust=share * self.motor_thrust,
            place=share * self.place,
            centre_of_mass=share * self.centre_of_mass,
            output_delay_s=share * self.output_delay_s,
            imu_place=share * self.imu_place,
            sensor_turn_rad=share * self.sensor_turn_rad,
            filter_factor=towards_one(self.filter_factor),
        )

    def drawn(self, nominal: PlantParameters, generators: list[np.random.Generator]) -> PlantParameters:
        """The plants that fly, one a generator; ``nominal`` itself when nothing is to be drawn.

        The order and number of draws are the same whatever the widths: a wider one moves its own quantity alone.
        """
        if self == Uncertainty():
            return nominal
        n, m = nominal.vehicles, nominal.motors
        if len(generators) != n:
            raise ValueError(f"{len(generators)} generators for {n} vehicles: give one for each")
        unit = np.array([g.uniform(-1.0, 1.0, _OWN + 3 * m + _SENSORS) for g in generators])  # (N, .)
        lag, split, torque, expo, idle, angle, radius, delay = unit[:, :_OWN].T
        motor, place = unit[:, _OWN : _OWN + m], unit[:, _OWN + m : -_SENSORS].reshape(n, m, 2)
        imu, gyro, accelerometer = unit[:, -_SENSORS:-2].reshape(n, 3, 3).swapaxes(0, 1)
        cutoff = _between(self.filter_factor, unit[:, -2:].T)
        lag = _between(self.lag_factor, lag)
        split = 1.0 + self.lag_split * split
        arm = np.hypot(nominal.position_m[..., 0], nominal.position_m[..., 1])  # (m,) or (N, m)
        longest = arm.max(axis=-1)
        offset = self.centre_of_mass * longest * np.sqrt(0.5 + 0.5 * radius)  # even over the disc
        offset = offset[:, None] * np.stack([np.cos(math.pi * angle), np.sin(math.pi * angle)], axis=1)
        aside = np.concatenate([offset, np.zeros((n, 1))], axis=1)
        return replace(
            nominal,
            time_constant_up_s=_scaled(nominal.time_constant_up_s, lag * split),
            time_constant_down_s=_scaled(nominal.time_constant_down_s, lag / split),
            torque_per_thrust_m=_scaled(nominal.torque_per_thrust_m, _between(self.torque_factor, torque)),
            thrust_expo=np.clip(nominal.thrust_expo + self.thrust_expo * expo, 0.0, 1.0),
            spin_min=np.clip(nominal.spin_min + self.spin_min * idle, 0.0, nominal.spin_max - _SPIN_SPAN_MIN),
            max_thrust_n=nominal.max_thrust_n * (1.0 + self.motor_thrust * motor),
            position_m=nominal.position_m + self.place * arm[..., None] * place - offset[:, None],
            pressure_centre_m=nominal.pressure_centre_m - aside,
            output_delay_s=nominal.output_delay_s + self.output_delay_s * (0.5 + 0.5 * delay),
            imu_m=nominal.imu_m + self.imu_place * np.reshape(longest, (-1, 1)) * imu - aside,
            gyro_turn_rad=nominal.gyro_turn_rad + self.sensor_turn_rad * gyro,
            accelerometer_turn_rad=nominal.accelerometer_turn_rad + self.sensor_turn_rad * accelerometer,
            gyro_filter_hz=nominal.gyro_filter_hz * cutoff[0],
            accelerometer_filter_hz=nominal.accelerometer_filter_hz * cutoff[1],
        )


LEVELS: dict[str, Callable[[], Uncertainty]] = {
    "exact": Uncertainty.exact,
    "calibrated": Uncertainty.calibrated,
    "geometry": Uncertainty.geometry,
    "estimated": Uncertainty.estimated,
}


def _between(factor: tuple[float, float], unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log-uniform for ``unit`` (N,) uniform in -1..1."""
    low, high = math.log(factor[0]), math.log(factor[1])
    return np.exp(low + (high - low) * (0.5 + 0.5 * unit))


def _scaled(value: NDArray[np.float64], factor: NDArray[np.float64]) -> NDArray[np.float64]:
    """``value`` (N,) or (N, m) times ``factor`` (N,)."""
    return (value.T * factor).T
