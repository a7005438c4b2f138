"""Plant, wind, sensors and autopilot of N vehicles, stepped together in virtual time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2, PlantParameters
from sitl.autopilot.autopilot import Autopilot, Mode
from sitl.compiled import kernel, part, prepare
from sitl.faults import Fault, FaultSchedule, Faulty
from sitl.noise import vehicle_generators
from sitl.plant import Makings, Motion, Plant, advance, initial_state
from sitl.sensors import Instruments, Reading, Sensors, estimate, sample
from sitl.uncertainty import UNCERTAINTY_STREAM, Uncertainty
from sitl.wind import Air, Wind, blow

PLANT_RATE_HZ = 1200
AUTOPILOT_RATE_HZ = 400
_RATIO = PLANT_RATE_HZ // AUTOPILOT_RATE_HZ
CRASH_TILT_RAD = math.radians(90.0)
_GUIDED = int(Mode.GUIDED)
Places: TypeAlias = tuple[int, int, int, int]


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


class Flown(NamedTuple):
    """The vehicles and what is about them."""

    makings: Makings
    motion: Motion
    air: Air
    instruments: Instruments
    reading: Reading


class Watch(NamedTuple):
    """By what a crash is told."""

    armed: NDArray[np.bool_]  # (N,)
    mode: NDArray[np.int64]  # (N,)
    path: NDArray[np.float64]  # (N, 3)
    max_tilt_rad: NDArray[np.float64]  # (N,)


class Course(NamedTuple):
    """What happens to them in one cycle of the autopilot, of K plant steps."""

    output: NDArray[np.float64]  # (N, m)
    faults: Faulty
    time_s: float


@part
def _judge(n: int, motion: Motion, watch: Watch) -> None:
    """Latch a crash: ground contact other than a commanded landing, or tilt past 90 degrees."""
    tilt = rotation.tilt(rotation.quaternion(motion.quaternion, n))
    if not motion.crashed[n]:
        watch.max_tilt_rad[n] = max(watch.max_tilt_rad[n], tilt)
    airborne = watch.armed[n] and watch.mode[n] == _GUIDED and watch.path[n, 2] < -1.0
    motion.crashed[n] = motion.crashed[n] or tilt > CRASH_TILT_RAD or (motion.on_ground[n] and airborne)


@kernel
def _fly(flown: Flown, watch: Watch, course: Course, places: Places) -> None:
    """One cycle of the autopilot. ``places``: number of the plant's step, of the wind's and the sensors' noise, and of
    the sensors' step, each of the first."""
    makings, motion, air, instruments, reading = flown
    step, gust, draw, number = places
    steps = len(course.faults.stuck)
    for n in range(len(course.output)):
        for k in range(steps):
            wind = blow(n, air, gust + k, course.time_s + k / PLANT_RATE_HZ)
            advance(n, makings, motion, course.output, step + k, course.faults, k, wind)
            for i in range(course.output.shape[1]):
                instruments.shakers[n, i].strength = course.faults.shake[k, n, i]
            sample(n, instruments, motion, reading, draw + k, number + k)
        estimate(n, instruments, motion, reading, number + steps - 1)
        _judge(n, motion, watch)


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
        self.sensors.settle(self.state, PLANT_RATE_HZ // 20)  # the filters, before the autopilot looks
        self.autopilot.prepare(self.sensors.measured)
        prepare(_fly, *self._course(self.autopilot.output, 0))
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
        _fly(*self._course(output, _RATIO))
        self.cycle += 1

    def _course(self, output: NDArray[np.float64], steps: int) -> tuple[Flown, Watch, Course, Places]:
        """Arguments of ``_fly``; ``steps`` 0: to look at, nothing is taken."""
        autopilot = self.autopilot
        times = [self.time_s + k / PLANT_RATE_HZ for k in range(_RATIO)]
        makings, step = self.plant.take(steps)
        air, gust_draw = self.wind.take(steps)
        instruments, (draw, number) = self.sensors.take(steps)
        self.max_tilt_rad = self.max_tilt_rad.copy()
        flown = Flown(makings, self.state.renewed(), air, instruments, self.sensors.measured.renewed())
        watch = Watch(autopilot.armed, autopilot.mode, autopilot.position.path, self.max_tilt_rad)
        course = Course(output, self.faults.over(times), self.time_s)
        return flown, watch, course, (step, gust_draw, draw, number)
