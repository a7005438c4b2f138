"""The flying autopilot: modes, the cascade, and whose matrix or outputs are in force. N vehicles in one call."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2, PlantParameters
from sitl.autopilot import mixer
from sitl.autopilot.ardupilot.port import ScriptedPort
from sitl.autopilot.attitude import AttitudeArrays, AttitudeControl, attitude_step, reset_attitude
from sitl.autopilot.companion_port import CompanionPort
from sitl.autopilot.position import PositionArrays, PositionControl, position_step, reset_position
from sitl.autopilot.shaping import clip
from sitl.compiled import kernel, part, prepare
from sitl.rotation import quaternion, vector
from sitl.sensors import Measured, Reading

_MIX_ATTITUDE = 0.5  # ATC_THR_MIX_MAX
_LAND_SPEED_M_S = 0.7
_LANDED_AFTER_S = 1.0


class Mode(IntEnum):
    """Flight modes of the emulation."""

    GROUND = 0
    GUIDED = 1
    LAND = 2


class Allocation(IntEnum):
    """Whose allocation is in force."""

    STOCK = 0
    DECLARATION = 1
    MATRIX = 2
    OVERRIDE = 3


_GROUND, _LAND = int(Mode.GROUND), int(Mode.LAND)


class Mixing(NamedTuple):
    """Arrays between the loops and the motors."""

    factors: NDArray[np.float64]  # (N, m, 4)
    dead: NDArray[np.bool_]  # (N, m) declared failed
    override: NDArray[np.float64]  # (N, m) outputs, nan: of the mixer
    demand: NDArray[np.float64]  # (N, 4) throttle, roll, pitch, yaw
    output: NDArray[np.float64]  # (N, m)
    torque_limited: NDArray[np.bool_]  # (N, 3) of the last cycle
    throttle_limited: NDArray[np.bool_]  # (N,)


class Curve(NamedTuple):
    """The motors' curve as the autopilot knows it."""

    expo: float
    spin_min: float
    spin_max: float


class Loops(NamedTuple):
    """All arrays of the loops."""

    position: PositionArrays
    attitude: AttitudeArrays
    desired: NDArray[np.float64]  # (N, 4)


@part
def _mix(n: int, mixing: Mixing, hover: float, flying: bool, armed: bool, curve: Curve) -> None:
    """Outputs of vehicle ``n`` for its demand."""
    output, demand = mixing.output[n], mixing.demand[n]
    mean_max = max(demand[0], demand[0] * (1 - _MIX_ATTITUDE) + hover * _MIX_ATTITUDE)
    limits = mixer.mix(mixing.factors[n], demand, mean_max, mixing.dead[n], output)
    limited = mixing.torque_limited[n]
    limited[0] = limited[1] = limits.roll_pitch
    limited[2] = limits.yaw
    mixing.throttle_limited[n] = limits.throttle_upper or limits.throttle_lower
    for i in range(len(output)):
        if not flying:
            output[i] = curve.spin_min if armed else 0.0
        elif not np.isnan(mixing.override[n, i]):
            output[i] = mixing.override[n, i]
        elif mixing.dead[n, i]:
            output[i] = 0.0
        else:
            output[i] = mixer.compiled_thrust_to_output(output[i], curve.expo, curve.spin_min, curve.spin_max)


@kernel
def _cycle(
    loops: Loops,
    mixing: Mixing,
    measured: Reading,
    modes: tuple[NDArray[np.bool_], NDArray[np.int64]],
    curve: Curve,
    dt_s: float,
) -> bool:
    """One cycle of all vehicles; ``modes``: armed and mode, (N,) each. Returns whether any vehicle lands."""
    position, landing = loops.position, False
    armed, mode = modes
    for n in range(len(armed)):
        flying = armed[n] and mode[n] != _GROUND
        landing = landing or mode[n] == _LAND
        attitude, place = quaternion(measured.quaternion, n), vector(measured.position_m, n)
        down = rotation.matrix(attitude)[2]
        up = -rotation.dot(down, vector(measured.specific_force_m_s2, n)) - GRAVITY_M_S2
        velocity, gyro = vector(measured.velocity_m_s, n), vector(measured.gyro_rad_s, n)
        vertical = up, mixing.throttle_limited[n]
        desired = position_step(n, position, place, velocity, attitude, vertical, dt_s)
        rotation.put_quaternion(loops.desired, n, desired)
        limited = mixing.torque_limited[n]
        roll, pitch, yaw = attitude_step(n, loops.attitude, desired, attitude, gyro, limited, dt_s)
        throttle = clip(position.throttle[n], 0.0, 1.0)
        rotation.put_quaternion(mixing.demand, n, (throttle, roll, pitch, yaw))
        _mix(n, mixing, position.hover_throttle[n], flying, armed[n], curve)
        if not flying:
            reset_position(n, position, place, 0.0)
            reset_attitude(n, loops.attitude, attitude)
    return landing


@kernel
def _begin(n: int, loops: Loops, measured: Reading, throttle: float) -> None:
    """Vehicle ``n`` flies from here and now."""
    attitude = quaternion(measured.quaternion, n)
    reset_position(n, loops.position, vector(measured.position_m, n), throttle)
    loops.position.goal_yaw[n] = rotation.yaw(attitude)
    reset_attitude(n, loops.attitude, attitude)


class Autopilot:
    """Knows the ``nominal`` airframe only, the same for all, and ``hover_throttle`` (N,), which it goes on learning."""

    def __init__(self, nominal: PlantParameters, dt_s: float, hover_throttle: NDArray[np.float64]) -> None:
        n, m = len(hover_throttle), nominal.motors
        self._p, self._dt = nominal, dt_s
        self._curve = Curve(float(nominal.thrust_expo[0]), float(nominal.spin_min[0]), float(nominal.spin_max))
        self.position = PositionControl(n, hover_throttle)
        self.attitude = AttitudeControl(n)
        self.ports = [CompanionPort(m) for _ in range(n)]
        self.scripted: dict[int, ScriptedPort] = {}  # vehicles whose mixer factors and channels scripts reach
        self.overridden: dict[int, ScriptedPort] = {}  # vehicles whose channels alone they reach
        self.mixers: dict[int, mixer.OwnMixer] = {}  # vehicles that mix in a way of their own
        self.armed = np.zeros(n, bool)
        self.mode = np.full(n, int(Mode.GROUND))
        self.allocation = np.full(n, Allocation.STOCK)
        self.output = np.zeros((n, m))
        self.desired = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        self.throttle = np.zeros(n)
        self._stock = mixer.stock_factors(nominal.frame_m, nominal.spin)
        # Converts a matrix in normalised units into this mixer's units, so that loop gains stay what they were.
        if nominal.alike:
            effectiveness = mixer.normalised_effectiveness(nominal.position_m, nominal.spin)
        else:
            effectiveness = mixer.normalised(nominal.effectiveness_si())
        self._unit = np.diag(effectiveness @ self._stock)
        self._factors = np.tile(self._stock, (n, 1, 1))
        self._dead = np.zeros((n, m), bool)
        self._override = np.full((n, m), np.nan)
        self._next_port_change_s = -np.inf
        self._limited = np.zeros((n, 3), bool)
        self._throttle_limited = np.zeros(n, bool)
        self._landed_s = np.zeros(n)

    def prepare(self, measured: Measured) -> None:
        """Compile, or load, what ``step`` and the beginning of a flight run."""
        loops, reading = self._loops(), measured.reading()
        prepare(_cycle, loops, self._mixing(), reading, (self.armed, self.mode), self._curve, self._dt)
        prepare(_begin, 0, loops, reading, 0.0)

    def _loops(self) -> Loops:
        self.desired = self.desired.copy()
        return Loops(self.position.renewed(), self.attitude.renewed(), self.desired)

    def _mixing(self) -> Mixing:
        n, m = self.output.shape
        limited = self._limited, self._throttle_limited
        return Mixing(self._factors, self._dead, self._override, np.empty((n, 4)), np.empty((n, m)), *limited)

    def arm(self, vehicle: int) -> None:
        """Motors idle, on the ground."""
        self.armed[vehicle] = True
        self.mode[vehicle] = Mode.GROUND

    def disarm(self, vehicle: int) -> None:
        """Motors off; the companion's commands are forgotten."""
        self.armed[vehicle] = False
        self.mode[vehicle] = Mode.GROUND
        self.ports[vehicle].disarmed()
        self.port_changed()

    def take_off(self, vehicle: int, height_m: float, measured: Measured) -> None:
        """Climb to ``height_m`` above the take-off plane at the present position."""
        self._begin(vehicle, measured, throttle=0.5 * float(self.position.hover_throttle[vehicle]))
        self.position.goal[vehicle, 2] = -height_m

    def start_in_air(self, measured: Measured) -> None:
        """Every vehicle flies from here and now (surveys skip the take-off)."""
        self.armed[:] = True
        for vehicle in range(len(self.armed)):
            self._begin(vehicle, measured, throttle=float(self.position.hover_throttle[vehicle]))

    def _begin(self, vehicle: int, measured: Measured, throttle: float) -> None:
        self.mode[vehicle] = Mode.GUIDED
        _begin(vehicle, self._loops(), measured.reading(), throttle)

    def land(self, vehicle: int) -> None:
        """Come down here; disarms on the ground."""
        self.mode[vehicle] = Mode.LAND
        self.position.goal[vehicle] = self.position.path[vehicle]
        self.position.goal_velocity[vehicle] = np.nan
        self.position.goal_velocity[vehicle, 2] = _LAND_SPEED_M_S
        self._landed_s[vehicle] = 0.0

    def port_changed(self) -> None:
        """Something arrived at a port: decide anew whose allocation is in force."""
        self._next_port_change_s = -np.inf

    def _read_ports(self, now_s: float) -> None:
        if now_s < self._next_port_change_s:
            return
        self._next_port_change_s = np.inf
        for vehicle, port in enumerate(self.ports):
            matrix, override = port.matrix_at(now_s), port.override_at(now_s)
            self._dead[vehicle] = port.failed
            self._override[vehicle] = np.nan if override is None else override
            self.allocation[vehicle] = Allocation.STOCK
            self._factors[vehicle] = self._stock
            if matrix is not None:
                self._factors[vehicle] = matrix * self._unit
                self.allocation[vehicle] = Allocation.MATRIX
            elif port.failed.any():
                reduced = mixer.reduced_factors(self._p.frame_m, self._p.spin, port.failed)
                if reduced is not None:
                    self._factors[vehicle] = reduced
                self.allocation[vehicle] = Allocation.DECLARATION
            if override is not None:
                self.allocation[vehicle] = Allocation.OVERRIDE
            self._next_port_change_s = min(self._next_port_change_s, port.next_expiry_s)

    def _read_scripts(self, now_s: float) -> None:
        p = self._p
        for vehicle, port in (*self.scripted.items(), *self.overridden.items()):
            if vehicle in self.scripted and port.factors is not None:
                self._factors[vehicle] = port.factors
            self._override[vehicle] = (port.pwm_at(now_s) - p.pwm_min) / (p.pwm_max - p.pwm_min)

    def step(self, measured: Measured, now_s: float) -> NDArray[np.float64]:
        """One cycle of the loops; returns the motor outputs (N, m) in 0..1."""
        self._read_ports(now_s)
        if self.scripted or self.overridden:
            self._read_scripts(now_s)
        mixing, modes = self._mixing(), (self.armed, self.mode)
        landing = _cycle(self._loops(), mixing, measured.reading(), modes, self._curve, self._dt)
        self.output, self.throttle = mixing.output, self.position.throttle
        for vehicle, own in self.mixers.items():
            self._mix_its_own_way(vehicle, own, mixing, now_s)
        if landing:
            self._detect_landing(measured)
        return self.output

    def _mix_its_own_way(self, vehicle: int, own: mixer.OwnMixer, mixing: Mixing, now_s: float) -> None:
        armed = bool(self.armed[vehicle])
        flying = armed and self.mode[vehicle] != Mode.GROUND
        throttle, asked = mixing.demand[vehicle, 0], flying * mixing.demand[vehicle]  # on the ground the motors idle
        mixed = own.mix(float(asked[0]), asked[1:], armed=armed, now_s=now_s)
        if flying:
            mixing.output[vehicle] = mixed.output
        mixing.torque_limited[vehicle] = mixed.torque_limited
        mixing.throttle_limited[vehicle] = mixed.throttle_limited or not 0.0 < throttle < 1.0

    def _detect_landing(self, measured: Measured) -> None:
        still = (np.abs(measured.velocity_m_s[:, 2]) < 0.3) & (self.throttle < 0.5 * self.position.hover_throttle)
        landing = self.mode == Mode.LAND
        self._landed_s = np.where(landing & still, self._landed_s + self._dt, 0.0)
        for vehicle in np.flatnonzero(self._landed_s > _LANDED_AFTER_S):
            self.position.goal_velocity[vehicle] = np.nan
            self.disarm(int(vehicle))
