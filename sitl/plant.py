"""The rigid body with its rotors: semi-implicit Euler at a fixed step, N vehicles in one call."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl import rotation
from sitl.aerodynamics import airframe_drag, hub_moment, stream, thrust_factor
from sitl.airframe import GRAVITY_M_S2, PlantParameters
from sitl.compiled import flat, kernel, part, prepare
from sitl.faults import Faulty
from sitl.records import bodies, rotors
from sitl.rotation import Vector, add_scaled, components, cross, put, scaled, to_body, to_ned, vector

_BATTERY_SAG = 0.06  # loss of full-charge voltage at full load
_BATTERY_DRAIN_PER_S = 3.0e-5  # of full-charge voltage, per second at full load


@dataclass(slots=True)
class PlantState:
    """NED position and velocity, body-to-NED quaternion, body rates, thrust of each rotor, battery.

    A step gives each field a new array: who keeps one keeps what it was.
    """

    position_m: NDArray[np.float64]  # (N, 3)
    velocity_m_s: NDArray[np.float64]  # (N, 3)
    quaternion: NDArray[np.float64]  # (N, 4)
    rate_rad_s: NDArray[np.float64]  # (N, 3)
    thrust_n: NDArray[np.float64]  # (N, m)
    held_command: NDArray[np.float64]  # (N, m) last command while the motor was not stuck
    battery: NDArray[np.float64]  # (N,) open-circuit voltage over full charge
    acceleration_m_s2: NDArray[np.float64]  # (N, 3) NED, gravity included, of the last step
    turning_rad_s2: NDArray[np.float64]  # (N, 3) angular acceleration, body, of the last step
    on_ground: NDArray[np.bool_]  # (N,) bool
    crashed: NDArray[np.bool_]  # (N,) bool, latched

    def renewed(self) -> Motion:
        """Its arrays after each was replaced by a copy, to be written."""
        self.position_m, self.velocity_m_s = self.position_m.copy(), self.velocity_m_s.copy()
        self.quaternion, self.rate_rad_s = self.quaternion.copy(), self.rate_rad_s.copy()
        self.thrust_n, self.held_command = self.thrust_n.copy(), self.held_command.copy()
        self.battery, self.acceleration_m_s2 = self.battery.copy(), self.acceleration_m_s2.copy()
        self.turning_rad_s2 = self.turning_rad_s2.copy()
        self.on_ground, self.crashed = self.on_ground.copy(), self.crashed.copy()
        return self.motion()

    def motion(self) -> Motion:
        """Its arrays."""
        return Motion(
            self.position_m,
            self.velocity_m_s,
            self.quaternion,
            self.rate_rad_s,
            self.thrust_n,
            self.held_command,
            self.battery,
            self.acceleration_m_s2,
            self.turning_rad_s2,
            self.on_ground,
            self.crashed,
        )


class Motion(NamedTuple):
    """The arrays of ``PlantState``."""

    position_m: NDArray[np.float64]
    velocity_m_s: NDArray[np.float64]
    quaternion: NDArray[np.float64]
    rate_rad_s: NDArray[np.float64]
    thrust_n: NDArray[np.float64]
    held_command: NDArray[np.float64]
    battery: NDArray[np.float64]
    acceleration_m_s2: NDArray[np.float64]
    turning_rad_s2: NDArray[np.float64]
    on_ground: NDArray[np.bool_]
    crashed: NDArray[np.bool_]


class Makings(NamedTuple):
    """What the plant is made of, and what is under way in it."""

    bodies: NDArray[np.void]  # (N,) of BODY
    rotors: NDArray[np.void]  # (N, m) of ROTOR
    mass_kg: NDArray[np.float64]  # (N,)
    outputs: NDArray[np.float64]  # (N, steps, m) a ring of those under way to the motors
    dt_s: float


def full_load_share() -> float:
    """Thrust that a full battery's sag leaves at full throttle, over that of full voltage."""
    return (1.0 - _BATTERY_SAG) ** 2


def battery_voltage(state: PlantState, parameters: PlantParameters) -> NDArray[np.float64]:
    """(N,) at the battery's terminals, over that of a full one without load."""
    return np.asarray(state.battery - _BATTERY_SAG * state.thrust_n.sum(axis=1) / parameters.max_thrust_n.sum(axis=1))


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
        turning_rad_s2=np.zeros((n, 3)),
        on_ground=np.full(n, height_m <= 0.0),
        crashed=np.zeros(n, bool),
    )


def _fraction(output: Any, idle: Any, full: Any, expo: Any) -> Any:
    """Thrust over full thrust of outputs, numbers or arrays."""
    c = np.minimum(np.maximum((output - idle) / (full - idle), 0.0), 1.0)
    return (1 - expo) * c + expo * c * c


_compiled_fraction = part(_fraction)


@part
def _send(n: int, makings: Makings, output: NDArray[np.float64], step: int) -> None:
    """Send ``output[n]`` to the motors; what was before the first is like the first."""
    ring = makings.outputs
    for place in range(ring.shape[1]):
        if step == 0 or place == step % ring.shape[1]:
            for i in range(output.shape[1]):
                ring[n, place, i] = output[n, i]


@part
def _speed(share: float) -> float:
    """Of a rotor over its full one, by its thrust over full thrust; below 0: it turns the other way."""
    return math.sqrt(share) if share >= 0.0 else -math.sqrt(-share)


@part
def _spin_up(n: int, makings: Makings, motion: Motion, step: int, faults: Faulty, k: int) -> float:
    """Thrust and speed of each rotor, towards what the motors hear now; returns the mean thrust in N."""
    body, ring, thrust, held = makings.bodies[n], makings.outputs, motion.thrust_n, motion.held_command
    size, late, share_late, motors = ring.shape[1], body.late_steps, body.late_share, thrust.shape[1]
    younger, older = (step - late) % size, (step - late - 1) % size
    load = 0.0
    for i in range(motors):
        load += thrust[n, i]
    load /= body.lift_n
    motion.battery[n] -= _BATTERY_DRAIN_PER_S * load * makings.dt_s
    voltage = motion.battery[n] - _BATTERY_SAG * load
    total = 0.0
    for i in range(motors):
        rotor, before = makings.rotors[n, i], thrust[n, i]
        if not faults.stuck[k, n, i]:
            held[n, i] = ring[n, younger, i] + share_late * (ring[n, older, i] - ring[n, younger, i])
        elif not math.isnan(faults.held[k, n, i]):
            held[n, i] = faults.held[k, n, i]
        fraction = _compiled_fraction(held[n, i], body.spin_min, body.spin_max, body.thrust_expo)
        target = rotor.max_thrust_n * fraction * faults.effectiveness[k, n, i] * (voltage * voltage)
        share = rotor.share_up if target > before else rotor.share_down
        if faults.slower[k, n, i] != 1.0:
            share = 1.0 - (1.0 - share) ** (1.0 / faults.slower[k, n, i])
        after = before + share * (target - before)
        thrust[n, i] = after
        total += after
        rotor.speed = _speed(after / rotor.max_thrust_n)
        rotor.speed_rate_per_s = (rotor.speed - _speed(before / rotor.max_thrust_n)) / makings.dt_s
    return total / motors


@part
def _wrench(n: int, makings: Makings, motion: Motion, air: Vector, mean_n: float) -> tuple[Vector, Vector, Vector]:
    """Force without weight, torque, and angular momentum of the rotors, in the body frame.

    ``air``: velocity through it; ``mean_n``: mean thrust.
    """
    body, rate = makings.bodies[n], vector(motion.rate_rad_s, n)
    flow = stream(body, mean_n, air, -motion.position_m[n, 2])
    drag = airframe_drag(body, air)
    force, torque, momentum = drag, cross(components(body.pressure_centre_m), drag), (0.0, 0.0, 0.0)
    for i in range(motion.thrust_n.shape[1]):
        rotor = makings.rotors[n, i]
        x, y, axis, speed = rotor.x_m, rotor.y_m, (rotor.axis_x, rotor.axis_y, rotor.axis_z), abs(rotor.speed)
        # Momentum drag: a rotor resists motion through the air along its disc and along its axis, where it is the
        # damping of climb, roll and pitch; the axial speed is that of the hub.
        braking = -body.rotor_drag_n_s_per_m * speed
        axial = air[2] - (x * rate[1] - y * rate[0])
        push = motion.thrust_n[n, i] * thrust_factor(body, makings.rotors, n, i, flow) - braking * axial
        hub_x, hub_y = air[0] - rate[2] * y, air[1] + rate[2] * x
        side_x, side_y = braking * hub_x, braking * hub_y
        flap_roll, flap_pitch = hub_moment(body, rotor, speed, hub_x, hub_y)
        # Rotors turn against their reaction torque: spin +1 spins about -z, or along the axis.
        reaction = rotor.torque_per_thrust_m * push + body.rotor_momentum * rotor.speed_rate_per_s
        force = add_scaled((force[0] + side_x, force[1] + side_y, force[2]), push, axis)
        torque = add_scaled(torque, push, cross((x, y, rotor.z_m), axis))
        torque = add_scaled(torque, -reaction * rotor.spin, axis)
        torque = (
            torque[0] + rotor.hub_height_m * side_y + flap_roll,
            torque[1] - rotor.hub_height_m * side_x + flap_pitch,
            torque[2] + side_y * x - side_x * y,
        )
        momentum = add_scaled(momentum, body.rotor_momentum * rotor.speed * rotor.spin, axis)
    return force, torque, momentum


@part
def advance(
    n: int,
    makings: Makings,
    motion: Motion,
    output: NDArray[np.float64],
    step: int,
    faults: Faulty,
    k: int,
    wind: Vector,
) -> None:
    """One step of vehicle ``n``, the ``step``-th.

    ``output`` (N, m) is what the autopilot drives the motors with; ``k``: which of the ``faults``.
    """
    dt, body = makings.dt_s, makings.bodies[n]
    _send(n, makings, output, step)
    mean_n = _spin_up(n, makings, motion, step, faults, k)
    q = rotation.quaternion(motion.quaternion, n)
    rows = rotation.matrix(q)
    velocity, rate = vector(motion.velocity_m_s, n), vector(motion.rate_rad_s, n)
    air = to_body(rows, add_scaled(velocity, -1.0, wind))
    force, torque, momentum = _wrench(n, makings, motion, air, mean_n)
    acceleration = to_ned(rows, force)
    mass = makings.mass_kg[n]
    acceleration = acceleration[0] / mass, acceleration[1] / mass, acceleration[2] / mass + GRAVITY_M_S2
    if motion.crashed[n] or (motion.on_ground[n] and acceleration[2] >= 0.0):
        acceleration = velocity = rate = turning = (0.0, 0.0, 0.0)
    else:
        inertia = components(body.inertia_kg_m2)
        momentum = (
            inertia[0] * rate[0] + momentum[0],
            inertia[1] * rate[1] + momentum[1],
            inertia[2] * rate[2] + momentum[2],
        )
        turning = add_scaled(torque, -1.0, cross(rate, momentum))
        turning = turning[0] / inertia[0], turning[1] / inertia[1], turning[2] / inertia[2]
        rate = add_scaled(rate, dt, turning)
        velocity = add_scaled(velocity, dt, acceleration)
    position = add_scaled(vector(motion.position_m, n), dt, velocity)
    put(motion.acceleration_m_s2, n, acceleration)
    put(motion.velocity_m_s, n, velocity)
    put(motion.rate_rad_s, n, rate)
    put(motion.turning_rad_s2, n, turning)
    rotation.put_quaternion(motion.quaternion, n, rotation.turned(q, scaled(dt, rate)))
    # The ground holds what stands on it, level as it stood.
    motion.on_ground[n] = position[2] >= 0.0
    put(motion.position_m, n, (position[0], position[1], min(position[2], 0.0)))


@part
def specific_force(n: int, motion: Motion) -> Vector:
    """What an ideal accelerometer in the centre of mass reads, body frame, m/s^2."""
    x, y, z = vector(motion.acceleration_m_s2, n)
    return to_body(rotation.matrix(rotation.quaternion(motion.quaternion, n)), (x, y, z - GRAVITY_M_S2))


@part
def specific_force_at(n: int, motion: Motion, place: Vector) -> Vector:
    """The same of one at ``place``, body frame, m from the centre of mass."""
    rate = vector(motion.rate_rad_s, n)
    swung = add_scaled(cross(vector(motion.turning_rad_s2, n), place), 1.0, cross(rate, cross(rate, place)))
    return add_scaled(specific_force(n, motion), 1.0, swung)


@kernel
def _advance_all(
    makings: Makings,
    motion: Motion,
    output: NDArray[np.float64],
    step: int,
    faults: Faulty,
    wind: NDArray[np.float64],
) -> None:
    for n in range(len(output)):
        advance(n, makings, motion, output, step, faults, 0, vector(wind, n))


@kernel
def _specific_forces(motion: Motion, out: NDArray[np.float64]) -> None:
    for n in range(len(out)):
        put(out, n, specific_force(n, motion))


class Plant:
    """Steps the state; holds only constants, the mass, which may change in flight (a dropped payload), and the outputs
    that are under way to the motors.
    """

    def __init__(self, parameters: PlantParameters, dt_s: float) -> None:
        self.parameters, self.dt_s = parameters, dt_s
        self.mass_kg = parameters.mass_kg.copy()
        self._bodies, self._rotors = bodies(parameters, dt_s), rotors(parameters, dt_s)
        late = int(self._bodies["late_steps"].max())
        self._outputs = np.zeros((parameters.vehicles, late + 2, parameters.motors))
        self._step = 0

    def thrust_fraction(self, output: NDArray[np.float64]) -> NDArray[np.float64]:
        """Thrust over full thrust of the motor output (N, m) in 0..1 (command to thrust curve)."""
        p = self.parameters
        return np.asarray(_fraction(output, p.spin_min[:, None], p.spin_max, p.thrust_expo[:, None]))

    def shift_mass(self, vehicle: int, forward: float, right: float) -> None:
        """Move the centre of mass by these shares of the longest arm: a load has slid."""
        rotors, body = self._rotors[vehicle], self._bodies[vehicle]
        arm_m = float(np.hypot(rotors["x_m"], rotors["y_m"]).max())
        rotors["x_m"] -= forward * arm_m
        rotors["y_m"] -= right * arm_m
        body["pressure_centre_m"][:2] -= np.array([forward, right]) * arm_m

    def take(self, steps: int) -> tuple[Makings, int]:
        """For ``advance`` over that many steps: what it needs, and the number of the first."""
        self._step += steps
        return Makings(self._bodies, self._rotors, flat(self.mass_kg), self._outputs, self.dt_s), self._step - steps

    def prepare(self, state: PlantState) -> None:
        """Compile, or load, what ``step`` and ``specific_force`` run."""
        n, m = state.thrust_n.shape
        faults = Faulty.over([Faulty.none(n, m)])
        prepare(_advance_all, self.take(0)[0], state.motion(), np.zeros((n, m)), 0, faults, np.zeros((n, 3)))
        prepare(_specific_forces, state.motion(), np.zeros((n, 3)))

    def step(
        self,
        state: PlantState,
        output: NDArray[np.float64],
        wind_m_s: NDArray[np.float64],
        faulty: Faulty | None = None,
    ) -> None:
        """Advance ``state`` by one step. ``output`` (N, m) is what the autopilot drives the motors with."""
        makings, step = self.take(1)
        faults = Faulty.over([faulty or Faulty.none(len(output), output.shape[1])])
        _advance_all(makings, state.renewed(), flat(output), step, faults, flat(wind_m_s))

    def specific_force(self, state: PlantState) -> NDArray[np.float64]:
        """What an ideal accelerometer in the centre of mass reads, (N, 3), body frame, m/s^2."""
        out = np.empty((state.battery.size, 3))
        _specific_forces(state.motion(), out)
        return out
