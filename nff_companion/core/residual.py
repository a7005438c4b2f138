"""The residual y (6.5) from gyro, accelerometer and motor commands.

    y = x' - f(x) - B0 u,   x' = (upward specific force, angular acceleration)

The angular acceleration is the difference of two gyro samples over their interval, smoothed by a first-order lag of
``SMOOTHING_S``; differentiation at full rate would hand on the gyro's noise times the sample rate. Model and
measurement pass the *same* chain: the modelled thrust goes through the motor's lag, the autopilot's own gyro filter,
the mean over the sample interval and the same smoothing. So the chain costs delay (about 8 ms for the smoothing and
11 ms for a 20 Hz gyro filter) but leaves no mismatch in transients, and y stays linear in the effectiveness:
y = B0 diag(w) (eta - 1) with w the thrust fractions after the chain.

Rotors in wind drag sideways. The accelerometer measures the sum of it; each rotor's share acts at its hub, so a
rotor that is lost, or pushes more than the others, turns the vehicle about its yaw axis. In 4 m/s that is more than
its own drag torque: the yaw row of B0 follows the measured lateral specific force; which share of it acts at the
rotors is learnt (disturbance.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nff_companion.core.filters import LowPass, lag_share
from nff_companion.core.vehicle import YAW, Vehicle

SMOOTHING_S = 0.008
_IDLE = 0.02  # least thrust fraction of a rotor that turns
_LATERAL_S = 0.15  # smoothing of the lateral specific force


@dataclass(slots=True)
class ResidualState:
    """State between samples. Arrays (m,) unless said otherwise."""

    gyro: np.ndarray  # (3,) rad/s
    up: float  # upward specific force, m/s^2
    command: np.ndarray  # thrust fraction commanded
    lagged: np.ndarray  # thrust fraction after the motor's lag
    low_pass: np.ndarray  # (2, m)
    sensor_low_pass: np.ndarray  # (2, 4) for a filter that only one of the two sensors has
    shown: np.ndarray  # thrust fraction after the gyro filter
    weight: np.ndarray  # w, after the whole chain
    measured: np.ndarray  # (n,) accelerations after the smoothing
    lateral: np.ndarray  # (2,) specific force along x and y, m/s^2, smoothed slowly
    push: np.ndarray  # (2,) the same, after the smoothing of ``measured``
    rate: np.ndarray  # (3,) body rates after the same smoothing
    dt_s: float


class ResidualFilter:
    """Constants of one airframe at one sample time; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, dt_s: float) -> None:
        self._inertia = vehicle.inertia_kg_m2
        motor, telemetry = vehicle.motor, vehicle.telemetry
        self.dt_s = dt_s
        self._up, self._down = lag_share(dt_s, motor.time_constant_up_s), lag_share(dt_s, motor.time_constant_down_s)
        gyro, accelerometer = telemetry.gyro_filter_hz, telemetry.accelerometer_filter_hz
        self.low_pass = LowPass.design(gyro, dt_s)
        # Where one sensor alone is filtered, the other is given the same filter here.
        self._accelerometer_low_pass = LowPass.design(gyro, dt_s) if gyro and not accelerometer else None
        self._smooth = lag_share(dt_s, SMOOTHING_S)
        self._lateral = lag_share(dt_s, _LATERAL_S)
        self._nominal = vehicle.acceleration_effectiveness
        x, y = vehicle.position_m.T
        # (2, m) yaw acceleration per lateral specific force, were it all at one rotor
        self._side_drag = vehicle.mass_kg / vehicle.inertia_kg_m2[2] * np.stack([-y, x])

    def start(self, gyro: np.ndarray, specific_force: np.ndarray, command: np.ndarray) -> ResidualState:
        """State as if the vehicle had flown like this for ever."""
        up = -float(specific_force[2])
        low_pass = self.low_pass.settled(command) if self.low_pass else np.zeros((2, len(command)))
        sensor = np.zeros((2, 4))
        if self._accelerometer_low_pass:
            sensor[:, :1] = self._accelerometer_low_pass.settled(np.array([up]))
        measured = np.array([up, 0.0, 0.0, 0.0])
        return ResidualState(
            gyro,
            up,
            command,
            command,
            low_pass,
            sensor,
            command,
            command.copy(),
            measured,
            specific_force[:2],
            specific_force[:2],
            gyro,
            self.dt_s,
        )

    def side_drag(self, state: ResidualState) -> np.ndarray:
        """Yaw acceleration (m,) of each motor per thrust fraction if all the lateral drag acted at the rotors.

        A rotor's share of the drag goes with its speed, the root of its thrust.
        """
        speed = np.sqrt(np.maximum(state.weight, _IDLE))
        return (state.lateral @ self._side_drag) / (speed * speed.sum())

    def effectiveness(self, side_drag: np.ndarray, rotor_share: float) -> np.ndarray:
        """B0 (n, m) in accelerations, with the yaw torque of the rotors' side drag in the present wind."""
        matrix = self._nominal.copy()
        matrix[YAW] += rotor_share * side_drag
        return matrix

    def step(
        self, state: ResidualState, gyro: np.ndarray, specific_force: np.ndarray, command: np.ndarray, dt_s: float
    ) -> ResidualState:
        """One sample: ``gyro`` (3,) rad/s, ``specific_force`` (3,) m/s^2, ``command`` (m,) thrust fractions.

        ``dt_s`` is the interval measured; filters are designed for the nominal one.
        """
        held = 0.5 * (state.command + command)
        lagged = state.lagged + np.where(held > state.lagged, self._up, self._down) * (held - state.lagged)
        if self.low_pass is None:
            low_pass, shown = state.low_pass, lagged
        else:
            low_pass, shown = self.low_pass.step(state.low_pass, lagged)
        up, sensor = -float(specific_force[2]), state.sensor_low_pass
        if self._accelerometer_low_pass is not None:
            part, value = self._accelerometer_low_pass.step(sensor[:, :1], np.array([up]))
            sensor = sensor.copy()
            sensor[:, :1], up = part, float(value[0])
        middle = 0.5 * (gyro + state.gyro)
        j = self._inertia
        p, q, r = float(middle[0]), float(middle[1]), float(middle[2])
        slope = (gyro - state.gyro) / dt_s
        # x' - f(x): Euler's equation without the rotors' torque
        acceleration = np.array(
            [
                0.5 * (up + state.up),
                slope[0] + q * r * (j[2] - j[1]) / j[0],
                slope[1] + p * r * (j[0] - j[2]) / j[1],
                slope[2] + p * q * (j[1] - j[0]) / j[2],
            ]
        )
        weight = state.weight + self._smooth * (0.5 * (shown + state.shown) - state.weight)
        measured = state.measured + self._smooth * (acceleration - state.measured)
        lateral = state.lateral + self._lateral * (specific_force[:2] - state.lateral)
        push = state.push + self._smooth * (specific_force[:2] - state.push)
        rate = state.rate + self._smooth * (middle - state.rate)
        return ResidualState(
            gyro, up, command, lagged, low_pass, sensor, shown, weight, measured, lateral, push, rate, dt_s
        )
