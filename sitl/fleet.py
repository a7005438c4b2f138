"""Plant, wind, sensors and autopilot of N vehicles, stepped together in virtual time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2, PlantParameters
from sitl.autopilot.autopilot import Autopilot, Mode
from sitl.faults import Fault, FaultSchedule
from sitl.noise import vehicle_generators
from sitl.plant import Plant, initial_state
from sitl.sensors import Sensors
from sitl.uncertainty import UNCERTAINTY_STREAM, Uncertainty
from sitl.wind import Wind

PLANT_RATE_HZ = 1200
AUTOPILOT_RATE_HZ = 400
_RATIO = PLANT_RATE_HZ // AUTOPILOT_RATE_HZ
CRASH_TILT_RAD = np.radians(90.0)


@dataclass(frozen=True, kw_only=True)
class FleetOptions:
    """How the fleet flies. ``seeds``: one per vehicle. Wind direction is drawn from the seed.

    ``model_error`` is a fraction of mass, inertia, thrust of all motors and the autopilot's hover throttle;
    ``uncertainty`` is all else that the file may have wrong.
    """

    seeds: list[int]
    model_error: float = 0.0
    wind_m_s: float | list[float] = 0.0  # for all, or one a vehicle
    turbulence_m_s: float | list[float] = 0.0
    height_m: float = 0.0
    gusts: NDArray[np.float64] | None = None
    uncertainty: Uncertainty = field(default_factory=Uncertainty.exact)


def learned_hover_throttle(nominal: PlantParameters, true: PlantParameters) -> NDArray[np.float64]:
    """(N,) throttle 0..1 in the units of an autopilot that knows ``nominal``'s curve, with which ``true`` hovers.

    Still air, full battery, all rotors alike. Where the curve is the nominal one it is the weight over all thrust.
    """
    fraction = true.mass_kg * GRAVITY_M_S2 / true.lift_n
    expo, idle = true.thrust_expo, true.spin_min
    linear = 1.0 - expo
    # (1 - e) c + e c^2 = f, in the form that holds for e = 0 too.
    command = 2.0 * fraction / (linear + np.sqrt(linear**2 + 4.0 * expo * fraction))
    output = idle + (true.spin_max - idle) * command
    told = np.clip((output - nominal.spin_min) / (nominal.spin_max - nominal.spin_min), 0.0, 1.0)
    throttle = (1.0 - nominal.thrust_expo) * told + nominal.thrust_expo * told**2
    same = (expo == nominal.thrust_expo) & (idle == nominal.spin_min)
    return np.where(same, fraction, throttle)


class Fleet:
    """``step`` advances one autopilot period (2.5 ms). Crashed vehicles stay where they fell.

    ``nominal`` is what the autopilot is told, ``parameters`` what flies.
    """

    def __init__(self, nominal: PlantParameters, options: FleetOptions, faults: list[Fault] | None = None) -> None:
        seeds = options.seeds
        dt = 1.0 / PLANT_RATE_HZ
        draw = vehicle_generators(seeds, 0)
        self.nominal = nominal
        weighed = nominal.perturbed(fraction=options.model_error, generators=draw)
        self.parameters = options.uncertainty.drawn(weighed, vehicle_generators(seeds, UNCERTAINTY_STREAM))
        hover_error = options.model_error * np.array([g.uniform(-1, 1) for g in draw])
        heading = np.array([g.uniform(0, 2 * np.pi) for g in draw])
        speed = np.broadcast_to(np.asarray(options.wind_m_s, float), (len(seeds),))[:, None]
        mean = speed * np.stack([np.cos(heading), np.sin(heading), np.zeros(len(seeds))], axis=1)
        sigma = np.broadcast_to(np.asarray(options.turbulence_m_s, float), (len(seeds),))
        self.wind = Wind(mean, sigma, dt, vehicle_generators(seeds, 1), options.gusts)
        self.sensors = Sensors(self.parameters, dt, vehicle_generators(seeds, 2))
        self.plant = Plant(self.parameters, dt)
        self.state = initial_state(self.parameters, height_m=options.height_m)
        self.faults = FaultSchedule(len(seeds), nominal.motors, faults or [])
        throttle = learned_hover_throttle(nominal, self.parameters) * (1.0 + hover_error)
        self.autopilot = Autopilot(nominal, 1.0 / AUTOPILOT_RATE_HZ, throttle)
        self.cycle = 0
        self.max_tilt_rad = np.zeros(len(seeds))
        self._in_air_start = options.height_m > 0.0
        if self._in_air_start:
            true = self.parameters
            one = (true.mass_kg * GRAVITY_M_S2 / nominal.motors)[:, None]
            if not nominal.alike:
                one = (true.mass_kg * GRAVITY_M_S2 / true.lift_n)[:, None] * true.max_thrust_n
            self.state.thrust_n[:] = np.minimum(one, true.max_thrust_n)
        for _ in range(PLANT_RATE_HZ // 20):  # the filters settle before the autopilot looks
            self.sensors.step(self.state, self.plant.specific_force(self.state))
        self.sensors.estimate(self.state)
        if self._in_air_start:
            self.autopilot.start_in_air(self.sensors.measured)

    @property
    def vehicles(self) -> int:
        """N."""
        return self.parameters.vehicles

    @property
    def time_s(self) -> float:
        """Virtual time since the start."""
        return self.cycle / AUTOPILOT_RATE_HZ

    def step(self) -> None:
        """One autopilot cycle and the plant steps that follow it."""
        output = self.autopilot.step(self.sensors.measured, self.time_s)
        for k in range(_RATIO):
            time_s = self.time_s + k / PLANT_RATE_HZ
            effectiveness, stuck = self.faults.at(time_s)
            self.plant.step(self.state, output, effectiveness, stuck, self.wind.step(time_s))
            self.sensors.step(self.state, self.plant.specific_force(self.state))
        self.sensors.estimate(self.state)
        self.cycle += 1
        self._judge()

    def _judge(self) -> None:
        """Latch crashes: ground contact other than a commanded landing, or tilt past 90 degrees."""
        state, autopilot = self.state, self.autopilot
        tilt = rotation.tilt_of(state.quaternion)
        self.max_tilt_rad = np.where(state.crashed, self.max_tilt_rad, np.maximum(self.max_tilt_rad, tilt))
        airborne = autopilot.armed & (autopilot.mode == Mode.GUIDED) & (autopilot.position.path[:, 2] < -1.0)
        state.crashed = state.crashed | (tilt > CRASH_TILT_RAD) | (state.on_ground & airborne)
