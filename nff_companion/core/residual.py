"""The residual y (6.5) from gyro, accelerometer and motor commands.

    y = x' - f(x) - B0 u,   x' = (upward specific force, angular acceleration)

The angular acceleration is the difference of two gyro samples over their interval, smoothed by a first-order lag of
``smoothing_s``; differentiation at full rate would hand on the gyro's noise times the sample rate. Model and
measurement pass the *same* chain: the modelled thrust goes through the motor's lag, the autopilot's own gyro filter,
the mean over the sample interval and the same smoothing. So the chain costs delay (about 8 ms for the smoothing and
11 ms for a 20 Hz gyro filter) but leaves no mismatch in transients, and y stays linear in the effectiveness:
y = B0 diag(w) (eta - 1) with w the thrust fractions after the chain.

Rotors in wind drag sideways. The accelerometer measures the sum of it; each rotor's share acts at its hub, so a
rotor that is lost, or pushes more than the others, turns the vehicle about its yaw axis. In 4 m/s that is more than
its own drag torque: the yaw row of B0 follows the measured lateral specific force; which share of it acts at the
rotors is learnt (disturbance.py).

Products of small arrays are written ``a.dot(b)``: ``a @ b`` gives the same bits for three times the cost of the call.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.filters import LowPass, lag_share
from nff_companion.core.tuning import ResidualTuning
from nff_companion.core.vehicle import YAW, Vehicle

Vector = tuple[float, float, float]


@dataclass(slots=True)
class ResidualState:
    """State between samples. Arrays (m,) are of the motors, in thrust fractions."""

    gyro: list[float]  # (3,) rad/s
    up: float  # upward specific force, m/s^2
    command: NDArray[np.float64]  # (m,)
    lagged: NDArray[np.float64]  # (m,) after the motor's lag
    low_pass: tuple[NDArray[np.float64], NDArray[np.float64]]  # (m,) each
    sensor_low_pass: tuple[float, float]  # for a filter that only one of the two sensors has
    filtered: NDArray[np.float64]  # (m,) after the gyro filter
    thrust_shown: NDArray[np.float64]  # (m,) w, after the whole chain: as it shows in y
    smoothed: NDArray[np.float64]  # (11,) what is measured, after its first-order lag: the four properties below

    @property
    def measured(self) -> NDArray[np.float64]:
        """(n,) x' - f(x): upward specific force, m/s^2, and angular accelerations, rad/s^2."""
        return self.smoothed[:4]

    @property
    def lateral_m_s2(self) -> NDArray[np.float64]:
        """(2,) specific force along x and y."""
        return self.smoothed[4:6]

    @property
    def rate_rad_s(self) -> NDArray[np.float64]:
        """(3,) body rates."""
        return self.smoothed[6:9]

    @property
    def lateral_slow_m_s2(self) -> NDArray[np.float64]:
        """(2,) specific force along x and y, smoothed for ``lateral_s``."""
        return self.smoothed[9:]


class ResidualFilter:
    """Constants of one airframe at one sample time; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, dt_s: float, tuning: ResidualTuning = ResidualTuning()) -> None:  # noqa: B008
        motor, telemetry = vehicle.motor, vehicle.telemetry
        up, down = lag_share(dt_s, motor.time_constant_up_s), lag_share(dt_s, motor.time_constant_down_s)
        # Of the two ways that the lag could go, up or down, the larger is the one taken where up is the faster.
        self._way = np.maximum if up >= down else np.minimum
        # Constants are arrays (m,): numpy needs half as long again for an array with a number.
        self._up, self._down = np.full(vehicle.motors, up), np.full(vehicle.motors, down)
        gyro, accelerometer = telemetry.gyro_filter_hz, telemetry.accelerometer_filter_hz
        self.low_pass = LowPass.design(gyro, dt_s)
        # Where one sensor alone is filtered, the other is given the same filter here.
        self._sensor_low_pass = LowPass.design(gyro, dt_s) if gyro and not accelerometer else None
        smooth = lag_share(dt_s, tuning.smoothing_s)
        self._smooth, self._idle = np.full(vehicle.motors, smooth), np.full(vehicle.motors, tuning.idle)
        self._shares = np.array([smooth] * 9 + [lag_share(dt_s, tuning.lateral_s)] * 2)
        self._inertia: list[float] = vehicle.inertia_kg_m2.tolist()
        self._nominal = vehicle.acceleration_effectiveness
        x, y = vehicle.position_m.T
        # (2, m) yaw acceleration per lateral specific force, were it all at one rotor
        self._side_drag = vehicle.mass_kg / vehicle.inertia_kg_m2[2] * np.stack([-y, x])

    def start(
        self, gyro: NDArray[np.float64], specific_force: NDArray[np.float64], command: NDArray[np.float64]
    ) -> ResidualState:
        """State as if the vehicle had flown like this for ever."""
        p, q, r = gyro.tolist()
        fx, fy, fz = specific_force.tolist()
        nothing = np.zeros_like(command)
        return ResidualState(
            gyro=[p, q, r],
            up=-fz,
            command=command,
            lagged=command,
            low_pass=self.low_pass.settled(command) if self.low_pass else (nothing, nothing),
            sensor_low_pass=self._sensor_low_pass.settled(-fz) if self._sensor_low_pass else (0.0, 0.0),
            filtered=command,
            thrust_shown=command,
            smoothed=np.array([-fz, 0.0, 0.0, 0.0, fx, fy, p, q, r, fx, fy]),
        )

    def side_drag(self, state: ResidualState) -> NDArray[np.float64]:
        """Yaw acceleration (m,) of each motor per thrust fraction if all the lateral drag acted at the rotors.

        A rotor's share of the drag goes with its speed, the root of its thrust.
        """
        speed = np.sqrt(np.maximum(state.thrust_shown, self._idle))
        return state.lateral_slow_m_s2.dot(self._side_drag) / (speed * speed.sum())

    def effectiveness_matrix(self, side_drag: NDArray[np.float64], rotor_share: float) -> NDArray[np.float64]:
        """B0 (n, m) in accelerations, with the yaw torque of the rotors' side drag in the present wind."""
        matrix = self._nominal.copy()
        matrix[YAW] += rotor_share * side_drag
        return matrix

    def step(
        self,
        state: ResidualState,
        gyro: NDArray[np.float64],
        specific_force: NDArray[np.float64],
        command: NDArray[np.float64],
        dt_s: float,
    ) -> ResidualState:
        """One sample: ``gyro`` (3,) rad/s, ``specific_force`` (3,) m/s^2, ``command`` (m,) thrust fractions.

        ``dt_s`` is the interval measured; filters are designed for the nominal one.
        """
        ahead = 0.5 * (state.command + command) - state.lagged
        lagged = state.lagged + self._way(self._up * ahead, self._down * ahead)
        low_pass, filtered = state.low_pass, lagged
        if self.low_pass is not None:
            low_pass, filtered = self.low_pass.step(low_pass, lagged)
        thrust_shown = state.thrust_shown
        thrust_shown = thrust_shown + self._smooth * (0.5 * (filtered + state.filtered) - thrust_shown)

        fx, fy, fz = specific_force.tolist()
        up, sensor = -fz, state.sensor_low_pass
        if self._sensor_low_pass is not None:
            sensor, up = self._sensor_low_pass.step(sensor, up)
        rates: list[float] = gyro.tolist()
        acceleration, rate = self._turning(state.gyro, rates, dt_s)
        now = np.array([0.5 * (up + state.up), *acceleration, fx, fy, *rate, fx, fy])
        return ResidualState(
            gyro=rates,
            up=up,
            command=command,
            lagged=lagged,
            low_pass=low_pass,
            sensor_low_pass=sensor,
            filtered=filtered,
            thrust_shown=thrust_shown,
            smoothed=state.smoothed + self._shares * (now - state.smoothed),
        )

    def _turning(self, before: list[float], now: list[float], dt_s: float) -> tuple[Vector, Vector]:
        """Angular acceleration less what Euler's equation gives without the rotors' torque, and the rate, both in the
        middle of two samples of the gyro."""
        jx, jy, jz = self._inertia
        (p0, q0, r0), (p1, q1, r1) = before, now
        p, q, r = 0.5 * (p1 + p0), 0.5 * (q1 + q0), 0.5 * (r1 + r0)
        acceleration = (
            (p1 - p0) / dt_s + q * r * (jz - jy) / jx,
            (q1 - q0) / dt_s + p * r * (jx - jz) / jy,
            (r1 - r0) / dt_s + p * q * (jy - jx) / jz,
        )
        return acceleration, (p, q, r)
