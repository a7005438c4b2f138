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
rotors is learnt (disturbance.py). What tilted rotors push sideways is in that measurement too, and is not told apart.

Products of small arrays are written ``a.dot(b)``: ``a @ b`` gives the same bits for three times the cost of the call.
"""

from __future__ import annotations

from collections.abc import Callable
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
    sent: tuple[NDArray[np.float64], ...] = ()  # (m,) each, newest first: commands that the motors have yet to hear

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


def _way(up: NDArray[np.float64], down: NDArray[np.float64]) -> Callable[..., NDArray[np.float64]]:
    """Which of the two ways that the lag could go, up or down (m,) each, is taken.

    Where up is the faster it is the larger of the two, whichever way it goes; where down is, the smaller.
    """
    if (up >= down).all():
        return np.maximum
    if (up <= down).all():
        return np.minimum
    return _by_sign


def _by_sign(rising: NDArray[np.float64], falling: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(rising > 0.0, rising, falling)


class ResidualFilter:
    """Constants of one airframe at one sample time; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, dt_s: float, tuning: ResidualTuning = ResidualTuning()) -> None:  # noqa: B008
        telemetry = vehicle.telemetry
        # Constants are arrays (m,): numpy needs half as long again for an array with a number.
        self._up = np.array([lag_share(dt_s, lag_s) for lag_s in vehicle.rotors.time_constant_up_s.tolist()])
        self._down = np.array([lag_share(dt_s, lag_s) for lag_s in vehicle.rotors.time_constant_down_s.tolist()])
        self._way = _way(self._up, self._down)
        late = telemetry.output_delay_s / dt_s
        self._late, self._late_share = int(late), late - int(late)
        self._is_late = late > 0.0
        gyro, accelerometer = telemetry.gyro_filter_hz, telemetry.accelerometer_filter_hz
        self.low_pass = LowPass.design(gyro, dt_s)
        # Where one sensor alone is filtered, the other is given the same filter here.
        self._sensor_low_pass = LowPass.design(gyro, dt_s) if gyro and not accelerometer else None
        smooth = lag_share(dt_s, tuning.smoothing_s)
        self._smooth, self._idle = np.full(vehicle.motors, smooth), np.full(vehicle.motors, tuning.idle)
        self._shares = np.array([smooth] * 9 + [lag_share(dt_s, tuning.lateral_s)] * 2)
        self._inertia: list[float] = vehicle.inertia_kg_m2.tolist()
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
            sent=(command,) * (self._late + 1) if self._is_late else (),
        )

    def side_drag(self, state: ResidualState) -> NDArray[np.float64]:
        """Yaw acceleration (m,) of each motor per thrust fraction if all the lateral drag acted at the rotors.

        A rotor's share of the drag goes with its speed, the root of its thrust.
        """
        speed = np.sqrt(np.maximum(state.thrust_shown, self._idle))
        return state.lateral_slow_m_s2.dot(self._side_drag) / (speed * speed.sum())

    @staticmethod
    def effectiveness_matrix(
        steady: NDArray[np.float64], side_drag: NDArray[np.float64], rotor_share: float
    ) -> NDArray[np.float64]:
        """``steady`` (n, m) in accelerations, with the yaw torque of the rotors' side drag in the present wind."""
        matrix = steady.copy()
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

        ``dt_s`` is the interval measured; filters and the outputs' delay are designed for the nominal one.
        """
        sent = state.sent
        if self._is_late:
            sent = (command, *sent)
            newer, older = sent[self._late], sent[self._late + 1]
            command, sent = newer + self._late_share * (older - newer), sent[:-1]
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
            sent=sent,
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
