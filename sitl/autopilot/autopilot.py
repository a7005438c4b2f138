"""The flying autopilot: modes, the cascade, and whose matrix or outputs are in force. N vehicles in one call."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.airframe import GRAVITY_M_S2, PlantParameters
from sitl.autopilot import mixer
from sitl.autopilot.ardupilot.port import ScriptedPort
from sitl.autopilot.attitude import AttitudeControl
from sitl.autopilot.companion_port import CompanionPort
from sitl.autopilot.position import PositionControl
from sitl.autopilot.shaping import clip
from sitl.sensors import Measured

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


class Autopilot:
    """Knows the ``nominal`` airframe only, the same for all, and ``hover_throttle`` (N,), which it goes on learning."""

    def __init__(self, nominal: PlantParameters, dt_s: float, hover_throttle: NDArray[np.float64]) -> None:
        n, m = len(hover_throttle), nominal.motors
        self._p, self._dt = nominal, dt_s
        self._expo, self._spin_min = float(nominal.thrust_expo[0]), float(nominal.spin_min[0])
        self.position = PositionControl(n, dt_s, hover_throttle)
        self.attitude = AttitudeControl(n, dt_s)
        self.ports = [CompanionPort(m) for _ in range(n)]
        self.scripted: dict[int, ScriptedPort] = {}  # vehicles whose mixer factors and channels scripts reach
        self.overridden: dict[int, ScriptedPort] = {}  # vehicles whose channels alone they reach
        self.mixers: dict[int, mixer.OwnMixer] = {}  # vehicles that mix in a way of their own
        self.armed = np.zeros(n, bool)
        self.mode = np.full(n, Mode.GROUND)
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
        mask = np.zeros(len(self.armed), bool)
        mask[vehicle] = True
        self.mode[vehicle] = Mode.GUIDED
        self.position.reset(mask, measured.position_m, np.zeros_like(measured.velocity_m_s), throttle)
        self.position.goal_yaw[vehicle] = rotation.yaw_of(measured.quaternion[vehicle])
        self.attitude.reset(mask, measured.quaternion)

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
        flying = self.armed & (self.mode != Mode.GROUND)
        matrix = rotation.to_matrix(measured.quaternion)
        up = -np.vecdot(matrix[:, 2, :], measured.specific_force_m_s2) - GRAVITY_M_S2
        self.desired, self.throttle = self.position.step(
            measured.position_m, measured.velocity_m_s, up, measured.quaternion, self._throttle_limited
        )
        torque = self.attitude.step(self.desired, measured.quaternion, measured.gyro_rad_s, self._limited)
        hover = self.position.hover_throttle
        throttle = clip(self.throttle, 0.0, 1.0)
        mean_max = np.maximum(throttle, throttle * (1 - _MIX_ATTITUDE) + hover * _MIX_ATTITUDE)
        demand = np.concatenate([throttle[:, None], torque], axis=1)
        thrust, limits = mixer.mix(self._factors, demand, mean_max, self._dead)
        self._limited = np.array([limits.roll_pitch, limits.roll_pitch, limits.yaw]).T
        self._throttle_limited = limits.throttle_upper | limits.throttle_lower
        output = mixer.thrust_to_output(thrust, self._expo, self._spin_min, self._p.spin_max)
        output = np.where(self._dead, 0.0, output)
        output = np.where(np.isnan(self._override), output, self._override)
        for vehicle, own in self.mixers.items():
            asked = flying[vehicle] * demand[vehicle]  # on the ground the motors idle
            mixed = own.mix(float(asked[0]), asked[1:], armed=bool(self.armed[vehicle]), now_s=now_s)
            output[vehicle], self._limited[vehicle] = mixed.output, mixed.torque_limited
            self._throttle_limited[vehicle] = mixed.throttle_limited or not 0.0 < self.throttle[vehicle] < 1.0
        output = np.where(flying[:, None], output, np.where(self.armed[:, None], self._spin_min, 0.0))
        self.output = output
        if not flying.all():
            idle = ~flying
            self.position.reset(idle, measured.position_m, np.zeros_like(measured.velocity_m_s), 0.0)
            self.attitude.reset(idle, measured.quaternion)
        if (self.mode == Mode.LAND).any():
            self._detect_landing(measured)
        return output

    def _detect_landing(self, measured: Measured) -> None:
        still = (np.abs(measured.velocity_m_s[:, 2]) < 0.3) & (self.throttle < 0.5 * self.position.hover_throttle)
        landing = self.mode == Mode.LAND
        self._landed_s = np.where(landing & still, self._landed_s + self._dt, 0.0)
        for vehicle in np.flatnonzero(self._landed_s > _LANDED_AFTER_S):
            self.position.goal_velocity[vehicle] = np.nan
            self.disarm(int(vehicle))
