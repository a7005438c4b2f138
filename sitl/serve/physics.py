"""One vehicle without an autopilot: outputs in, the truth out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import PlantParameters
from sitl.faults import Fault, FaultSchedule
from sitl.noise import NormalBlocks, vehicle_generators
from sitl.plant import Plant, initial_state
from sitl.uncertainty import UNCERTAINTY_STREAM, Uncertainty
from sitl.wind import Wind

_STEP_MAX_S = 1.0 / 800.0
_GYRO_NOISE_RAD_S = 0.004
_ACCELEROMETER_NOISE_M_S2 = 0.05
_IMPACT_M_S = 3.0
_LAG_MAX_S = 0.25
_CRASH_TILT_RAD = np.pi / 2


@dataclass(frozen=True, kw_only=True)
class PhysicsOptions:
    """``model_error`` is a fraction; wind in m/s; ``uncertainty`` is what else the file has wrong."""

    seed: int = 1
    wind_m_s: float = 0.0
    turbulence_m_s: float = 0.0
    model_error: float = 0.0
    uncertainty: Uncertainty = field(default_factory=Uncertainty.exact)


def pace(next_s: float, interval_s: float) -> float:
    """Wait until the step after the one due at ``next_s``; that time. Who is late loses time, and does not hurry."""
    next_s += interval_s
    ahead = next_s - time.monotonic()
    if ahead > 0.0:
        time.sleep(ahead)
    return next_s if ahead > -_LAG_MAX_S else time.monotonic()


class Physics:
    """Steps the plant by any interval; sensors have white noise and no filter, those are the autopilot's."""

    def __init__(self, nominal: PlantParameters, options: PhysicsOptions, faults: list[Fault] | None = None) -> None:
        draw = vehicle_generators([options.seed], 0)
        weighed = nominal.perturbed(fraction=options.model_error, generators=draw)
        self.parameters = options.uncertainty.drawn(weighed, vehicle_generators([options.seed], UNCERTAINTY_STREAM))
        heading = draw[0].uniform(0, 2 * np.pi)
        self._mean = options.wind_m_s * np.array([[np.cos(heading), np.sin(heading), 0.0]])
        self._options = options
        self._dt_s = 0.0
        self._plant: Plant | None = None
        self._wind: Wind | None = None
        self._noise = NormalBlocks(vehicle_generators([options.seed], 2), 6)
        self.state = initial_state(self.parameters)
        self.faults = FaultSchedule(1, nominal.motors, faults or [])
        self.time_s = 0.0
        self.max_tilt_rad = 0.0
        self.output = np.zeros(nominal.motors)
        Plant(self.parameters, _STEP_MAX_S).prepare(self.state)
        self._air(_STEP_MAX_S).prepare()

    def _air(self, dt_s: float) -> Wind:
        sigma = np.array([self._options.turbulence_m_s])
        return Wind(self._mean, sigma, dt_s, vehicle_generators([self._options.seed], 1))

    def step(self, output: NDArray[np.float64], interval_s: float) -> None:
        """Advance by ``interval_s`` under motor outputs (m,) in 0..1; what is not a number stands still."""
        count = max(int(np.ceil(interval_s / _STEP_MAX_S - 1e-9)), 1)
        dt = interval_s / count
        if self._plant is None or abs(dt - self._dt_s) > 1e-9:
            # The discrete lags hold for one step length; an autopilot's is steady but may be told late.
            self._dt_s, self._plant = dt, Plant(self.parameters, dt)
            self._wind = self._air(dt)
        assert self._wind is not None
        self.output = np.clip(np.nan_to_num(output, nan=0.0, posinf=0.0, neginf=0.0), 0.0, 1.0)
        state = self.state
        for _ in range(count):
            faulty = self.faults.at(self.time_s)
            falling = float(state.velocity_m_s[0, 2])
            was_up = not bool(state.on_ground[0])
            self._plant.step(state, self.output[None], self._wind.step(self.time_s), faulty)
            self.time_s += dt
            if was_up and bool(state.on_ground[0]) and falling > _IMPACT_M_S:
                state.crashed[0] = True
        tilt = float(rotation.tilt_of(state.quaternion)[0])
        if not state.on_ground[0] and not state.crashed[0]:
            self.max_tilt_rad = max(self.max_tilt_rad, tilt)
            if tilt > _CRASH_TILT_RAD:
                state.crashed[0] = True

    def inertial(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gyro rad/s and specific force m/s^2, (3,) each, with noise."""
        assert self._plant is not None
        noise = self._noise.next()[0]
        gyro = self.state.rate_rad_s[0] + _GYRO_NOISE_RAD_S * noise[:3]
        return gyro, self._plant.specific_force(self.state)[0] + _ACCELEROMETER_NOISE_M_S2 * noise[3:]

    @property
    def position_m(self) -> NDArray[np.float64]:
        """(3,) NED."""
        return np.asarray(self.state.position_m[0])

    @property
    def velocity_m_s(self) -> NDArray[np.float64]:
        """(3,) NED."""
        return np.asarray(self.state.velocity_m_s[0])

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """(4,) body to NED."""
        return np.asarray(self.state.quaternion[0])
