"""What happens to a vehicle and is no fault of a motor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nff_companion.mavlink.codec import dialect
from sitl.trials.campaign.scenario import Case
from sitl.trials.virtual import VirtualFlight

_EVENT_STREAM = 12  # of a seed's generators
_GUST_S, _GUST_M_S = (0.5, 3.0), (3.0, 8.0)
_PAYLOAD = 0.05, 0.2  # of the mass
_SHIFT = 0.05  # of the longest arm, that the centre of mass moves
_SLIDE_S = 0.1, 0.5  # it takes: sliding 2 cm by a fifth of its weight, 0.14
_SAG = 0.03, 0.12  # of the voltage
_SLAM_M, _SLAMS, _SLAM_S = (5.0, 12.0), 6, (0.3, 0.9)  # sticks from stop to stop: so far, so often, for so long each
_IMU = 0.01, 0.2  # deviations of the biases of one inertial unit from another's: rad/s, m/s^2
_JUMP_M = 1.0, 5.0  # of the position
_RESET_YAW_RAD, _RESET_TILT_RAD, _RESET_M_S = math.radians(25.0), math.radians(2.0), 1.0
_SILENT_S, _SLOW_S, _SLOW = (0.05, 2.0), (1.0, 5.0), 10
_STREAMS = (
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
)


def gusts(cases: list[Case]) -> NDArray[np.float64] | None:
    """Rows as ``sitl.wind`` takes them."""
    rows = []
    for vehicle, case in enumerate(cases):
        if case.event == "gust":
            draw = _draw(case)
            heading, speed = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(*_GUST_M_S)
            push = speed * math.cos(heading), speed * math.sin(heading), draw.uniform(-0.3, 0.3) * speed
            rows.append((vehicle, case.at_s, draw.uniform(*_GUST_S), *push))
    return np.array(rows) if rows else None


def _draw(case: Case) -> np.random.Generator:
    return np.random.default_rng([case.seed, _EVENT_STREAM])


class Events:
    """All but the gusts, each at its time."""

    def __init__(self, flight: VirtualFlight, cases: list[Case]) -> None:
        self._flight, self._fleet = flight, flight.fleet
        self._slams: list[tuple[float, int, float, float]] = []  # when, vehicle, and where to (north, east)
        self._slides: list[tuple[float, int, tuple[float, float, float], float]] = []  # as ``_slide`` takes them
        self._waiting = sorted(
            (case.at_s, vehicle) for vehicle, case in enumerate(cases) if case.event not in ("none", "gust")
        )
        self._cases = cases

    def step(self, time_s: float) -> None:
        """What is due."""
        while self._waiting and time_s >= self._waiting[0][0]:
            _, vehicle = self._waiting.pop(0)
            self._happen(vehicle, self._cases[vehicle])
        while self._slams and time_s >= self._slams[0][0]:
            _, vehicle, north, east = self._slams.pop(0)
            self._fleet.autopilot.position.goal[vehicle, :2] += north, east

        self._slides = [left for slide in self._slides if (left := self._slide(time_s, *slide)) is not None]

    def _slide(
        self, time_s: float, since_s: float, vehicle: int, far: tuple[float, float, float], done: float
    ) -> tuple[float, int, tuple[float, float, float], float] | None:
        """A load that slides from ``since_s`` on, ever faster: ``far`` forward, to the right, as shares of the arm, and
        in how many seconds; ``done`` is the share of it so far. None: it has arrived."""
        forward, right, lasts_s = far
        now = min((time_s - since_s) / lasts_s, 1.0) ** 2
        self._fleet.plant.shift_mass(vehicle, (now - done) * forward, (now - done) * right)
        return (since_s, vehicle, far, now) if now < 1.0 else None

    def _happen(self, vehicle: int, case: Case) -> None:
        draw, plant, state = _draw(case), self._fleet.plant, self._fleet.state
        if case.event in ("drop", "hook"):
            share = draw.uniform(*_PAYLOAD) * (-1.0 if case.event == "drop" else 1.0)
            mass = plant.mass_kg.copy()
            mass[vehicle] *= 1.0 + share
            plant.mass_kg = mass
        elif case.event == "shift":
            angle, far = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(0.3, 1.0) * _SHIFT
            where = far * math.cos(angle), far * math.sin(angle), draw.uniform(*_SLIDE_S)
            self._slides.append((case.at_s, vehicle, where, 0.0))
        elif case.event == "sag":
            battery = state.battery.copy()
            battery[vehicle] -= draw.uniform(*_SAG)
            state.battery = battery
        elif case.event == "slam":
            self._slam(vehicle, case.at_s, draw)
        elif case.event == "imu":
            gyro, accelerometer = _IMU
            biases = gyro * draw.standard_normal(3), accelerometer * draw.standard_normal(3)
            self._fleet.sensors.switch(vehicle, *biases)
        elif case.event in ("jump", "reset"):
            self._fleet.sensors.mislead(vehicle, _misled(case, draw))
        elif vehicle < len(self._flight.companions):  # the ones without a companion have no link
            self._stumble(vehicle, case, draw)

    def _slam(self, vehicle: int, at_s: float, draw: np.random.Generator) -> None:
        """There and back again, faster than the vehicle can follow."""
        heading, far = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(*_SLAM_M)
        for k in range(_SLAMS):
            side = far * (1.0 if k % 2 == 0 else -1.0) * (1.0 if k in (0, _SLAMS - 1) else 2.0)
            self._slams.append((at_s, vehicle, side * math.cos(heading), side * math.sin(heading)))
            at_s += draw.uniform(*_SLAM_S)
        self._slams.sort()

    def _stumble(self, vehicle: int, case: Case, draw: np.random.Generator) -> None:
        stream = _STREAMS[int(draw.integers(len(_STREAMS)))]
        slow = case.event == "slow stream"
        lasts_s = draw.uniform(*(_SLOW_S if slow else _SILENT_S))
        autopilot = self._flight.companions[vehicle].autopilot
        autopilot.stumble(stream, case.at_s + lasts_s, _SLOW if slow else 0)


def _misled(case: Case, draw: np.random.Generator) -> NDArray[np.float64]:
    """(9,) attitude, position, velocity: by how much the autopilot's estimate is off from now on."""
    error = np.zeros(9)
    if case.event == "jump":
        heading, far = draw.uniform(0.0, 2.0 * math.pi), draw.uniform(*_JUMP_M)
        error[3:6] = far * math.cos(heading), far * math.sin(heading), draw.uniform(-0.5, 0.5) * far
        return error
    error[:2] = draw.uniform(-_RESET_TILT_RAD, _RESET_TILT_RAD, 2)
    error[2] = draw.uniform(-_RESET_YAW_RAD, _RESET_YAW_RAD)
    error[6:] = draw.uniform(-_RESET_M_S, _RESET_M_S, 3)
    return error
