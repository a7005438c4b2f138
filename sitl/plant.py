"""The rigid body with its rotors: semi-implicit Euler at a fixed step, N vehicles in one call."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.aerodynamics import Aerodynamics
from sitl.airframe import GRAVITY_M_S2, PlantParameters

_BATTERY_SAG = 0.06  # loss of full-charge voltage at full load
_BATTERY_DRAIN_PER_S = 3.0e-5  # of full-charge voltage, per second at full load


@dataclass(slots=True)
class PlantState:
    """NED position and velocity, body-to-NED quaternion, body rates, thrust of each rotor, battery."""

    position_m: NDArray[np.float64]  # (N, 3)
    velocity_m_s: NDArray[np.float64]  # (N, 3)
    quaternion: NDArray[np.float64]  # (N, 4)
    rate_rad_s: NDArray[np.float64]  # (N, 3)
    thrust_n: NDArray[np.float64]  # (N, m)
    held_command: NDArray[np.float64]  # (N, m) last command while the motor was not stuck
    battery: NDArray[np.float64]  # (N,) open-circuit voltage over full charge
    acceleration_m_s2: NDArray[np.float64]  # (N, 3) NED, gravity included, of the last step
    on_ground: NDArray[np.bool_]  # (N,) bool
    crashed: NDArray[np.bool_]  # (N,) bool, latched


def full_load_share() -> float:
    """Thrust that a full battery's sag leaves at full throttle, over that of full voltage."""
    return (1.0 - _BATTERY_SAG) ** 2


def initial_state(parameters: PlantParameters, *, height_m: float = 0.0, yaw_rad: float = 0.0) -> PlantState:
    """Vehicles at rest at ``height_m`` above the ground; at height 0 they stand on it."""
    n, m = parameters.vehicles, parameters.motors
    position = np.zeros((n, 3))
    position[:, 2] = -height_m
    return PlantState(
        position_m=position,
        velocity_m_s=np.zeros((n, 3)),
        quaternion=rotation.from_yaw(np.full(n, yaw_rad)),
        rate_rad_s=np.zeros((n, 3)),
        thrust_n=np.zeros((n, m)),
        held_command=np.zeros((n, m)),
        battery=np.ones(n),
        acceleration_m_s2=np.zeros((n, 3)),
        on_ground=np.full(n, height_m <= 0.0),
        crashed=np.zeros(n, bool),
    )


def _per_motor(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) or (N, m) as (N, 1) or (N, m)."""
    return value[:, None] if value.ndim == 1 else value


def _moment(push: NDArray[np.float64], arm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum over motors (N,) of ``push`` (N, m) times ``arm``, (m,) for all or (N, m)."""
    return push @ arm if arm.ndim == 1 else np.vecdot(push, arm)


class _DelayLine:
    """Motor outputs ``delay_s`` (N,) later, linear between steps; what was before the first is like the first."""

    def __init__(self, delay_s: NDArray[np.float64], dt_s: float) -> None:
        steps = delay_s / dt_s
        whole = np.floor(steps).astype(int)
        self._vehicle = np.arange(len(steps))
        self._late, self._share = whole, (steps - whole)[:, None]
        self._kept: NDArray[np.float64] | None = None  # (steps, N, m), newest first

    def step(self, output: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the motors hear (N, m) while ``output`` (N, m) is sent."""
        if self._kept is None:
            self._kept = np.tile(output, (int(self._late.max()) + 2, 1, 1))
        self._kept = np.concatenate([output[None], self._kept[:-1]])
        younger, older = self._kept[self._late, self._vehicle], self._kept[self._late + 1, self._vehicle]
        return younger + self._share * (older - younger)


class Plant:
    """Steps the state; holds only constants, the mass, which may change in flight (a dropped payload), and the outputs
    that are under way to the motors.
    """

    def __init__(self, parameters: PlantParameters, dt_s: float) -> None:
        self.parameters, self.dt_s = parameters, dt_s
        self.mass_kg = parameters.mass_kg.copy()
        self._x, self._y = parameters.position_m[..., 0], parameters.position_m[..., 1]
        self._arm = np.stack([-self._y, self._x], axis=-1)  # roll, pitch torque per N of thrust, (m, 2) or (N, m, 2)
        down = np.broadcast_to(parameters.down_m, self._x.shape)
        self._hub = np.stack([self._x, self._y, down], axis=-1)  # (m, 3) or (N, m, 3)
        self._lift = parameters.max_thrust_n.sum(axis=1)  # (N,) N
        self._spin_min, self._expo = parameters.spin_min[:, None], parameters.thrust_expo[:, None]
        self._rotor_momentum = parameters.rotor_inertia_kg_m2 * parameters.max_speed_rad_s  # of one at full speed
        self._torque_per_thrust = _per_motor(parameters.torque_per_thrust_m)
        self._line = _DelayLine(parameters.output_delay_s, dt_s) if parameters.output_delay_s.any() else None
        self._aerodynamics = Aerodynamics(parameters)
        with np.errstate(divide="ignore"):
            self._share_up = 1 - np.exp(-dt_s / _per_motor(parameters.time_constant_up_s))
            self._share_down = 1 - np.exp(-dt_s / _per_motor(parameters.time_constant_down_s))

    def thrust_fraction(self, output: NDArray[np.float64]) -> NDArray[np.float64]:
        """Thrust over full thrust of the motor output (N, m) in 0..1 (command to thrust curve)."""
        idle, expo = self._spin_min, self._expo
        c = np.minimum(np.maximum((output - idle) / (self.parameters.spin_max - idle), 0.0), 1.0)
        return (1 - expo) * c + expo * c * c

    def _climb_of_hubs(self, rate_rad_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Speed (N, m) of the hubs against +z by roll and pitch."""
        if self._arm.ndim == 2:
            return rate_rad_s[:, :2] @ self._arm.T
        return np.matvec(self._arm, rate_rad_s[:, :2])

    def step(
        self,
        state: PlantState,
        output: NDArray[np.float64],
        effectiveness: NDArray[np.float64],
        stuck: NDArray[np.bool_],
        wind_m_s: NDArray[np.float64],
    ) -> None:
        """Advance ``state`` in place by one step. ``output`` (N, m) is what the autopilot drives the motors with."""
        p, dt = self.parameters, self.dt_s
        if self._line is not None:
            output = self._line.step(output)
        state.held_command = np.where(stuck, state.held_command, output)
        load = state.thrust_n.sum(axis=1) / self._lift
        state.battery = state.battery - _BATTERY_DRAIN_PER_S * load * dt
        voltage = state.battery - _BATTERY_SAG * load
        target = p.max_thrust_n * self.thrust_fraction(state.held_command) * effectiveness * (voltage**2)[:, None]
        share = np.where(target > state.thrust_n, self._share_up, self._share_down)
        thrust_before = state.thrust_n
        state.thrust_n = thrust_before + share * (target - thrust_before)

        matrix = rotation.to_matrix(state.quaternion)
        air = np.vecmat(state.velocity_m_s - wind_m_s, matrix)  # air speed in the body frame
        speed = np.sqrt(state.thrust_n / p.max_thrust_n)  # rotor speed over full speed
        speed_rate = (speed - np.sqrt(thrust_before / p.max_thrust_n)) / dt
        force, torque = self._wrench(state, air, speed, speed_rate)
        # Rotors turn against their reaction torque: spin +1 spins about -z, or along the axis.
        momentum = p.inertia_kg_m2 * state.rate_rad_s
        if p.axis is None:
            momentum[:, 2] -= self._rotor_momentum * (speed @ p.spin)
        else:
            momentum += self._rotor_momentum * ((speed * p.spin) @ p.axis)
        rate_dot = (torque - rotation.cross(state.rate_rad_s, momentum)) / p.inertia_kg_m2

        acceleration = np.matvec(matrix, force) / self.mass_kg[:, None]
        acceleration[:, 2] += GRAVITY_M_S2
        flying = ~(state.on_ground & (acceleration[:, 2] >= 0.0)) & ~state.crashed
        fly = flying[:, None]
        state.acceleration_m_s2 = np.where(fly, acceleration, 0.0)
        state.velocity_m_s = np.where(fly, state.velocity_m_s + dt * acceleration, 0.0)
        state.position_m = state.position_m + dt * state.velocity_m_s
        state.rate_rad_s = np.where(fly, state.rate_rad_s + dt * rate_dot, 0.0)
        turned = rotation.multiply(state.quaternion, rotation.from_rotation_vector(dt * state.rate_rad_s))
        state.quaternion = rotation.normalise(turned)
        state.on_ground = state.position_m[:, 2] >= 0.0
        # The ground holds what stands on it, level as it stood.
        state.position_m[:, 2] = np.minimum(state.position_m[:, 2], 0.0)

    def _wrench(
        self,
        state: PlantState,
        air: NDArray[np.float64],
        speed: NDArray[np.float64],
        speed_rate: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Force without weight, and torque, (N, 3) each in the body frame.

        ``air`` (N, 3): velocity through it; ``speed`` (N, m) of the rotors over the full one, and its rate.
        """
        p = self.parameters
        # Momentum drag: a rotor resists motion through the air along its disc and along its axis, where it is the
        # damping of climb, roll and pitch; the axial speed is that of the hub.
        braking = -p.rotor_drag_n_s_per_m * speed
        axial = air[:, 2:3] - self._climb_of_hubs(state.rate_rad_s)
        drawn = self._aerodynamics.rotor_thrust(state.thrust_n, air, -state.position_m[:, 2])
        thrust = drawn - braking * axial

        drag = self._aerodynamics.airframe_drag(air)
        hub_x = air[:, :1] - state.rate_rad_s[:, 2:] * self._y
        hub_y = air[:, 1:2] + state.rate_rad_s[:, 2:] * self._x
        push_x, push_y = braking * hub_x, braking * hub_y
        side_x, side_y = push_x.sum(axis=1), push_y.sum(axis=1)
        force = drag.copy()
        force[:, 0] += side_x
        force[:, 1] += side_y
        reaction = self._torque_per_thrust * thrust + self._rotor_momentum * speed_rate
        torque = np.empty_like(state.rate_rad_s)
        if p.axis is None:
            force[:, 2] -= thrust.sum(axis=1)
            torque[:, :2] = thrust @ self._arm if self._arm.ndim == 2 else np.vecmat(thrust, self._arm)
            torque[:, 2] = reaction @ p.spin
        else:
            push = thrust[..., None] * p.axis
            force += push.sum(axis=1)
            torque[:] = (rotation.cross(self._hub, push) - (reaction * p.spin)[..., None] * p.axis).sum(axis=1)
        flap_roll, flap_pitch = self._aerodynamics.hub_moment(speed, hub_x, hub_y)
        if isinstance(p.hub_height_m, float):
            torque[:, 0] += p.hub_height_m * side_y + flap_roll
            torque[:, 1] += flap_pitch - p.hub_height_m * side_x
        else:
            torque[:, 0] += push_y @ p.hub_height_m + flap_roll
            torque[:, 1] += flap_pitch - push_x @ p.hub_height_m
        torque[:, 2] = torque[:, 2] + _moment(push_y, self._x) - _moment(push_x, self._y)
        torque += rotation.cross(p.pressure_centre_m, drag)
        return force, torque

    def specific_force(self, state: PlantState) -> NDArray[np.float64]:
        """What an ideal accelerometer in the centre of mass reads, (N, 3), body frame, m/s^2."""
        without_gravity = state.acceleration_m_s2.copy()
        without_gravity[:, 2] -= GRAVITY_M_S2
        return np.vecmat(without_gravity, rotation.to_matrix(state.quaternion))
