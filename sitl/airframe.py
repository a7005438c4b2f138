"""The plant's own reading of an airframe file, and its perturbation."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

GRAVITY_M_S2 = 9.80665
_SPIN = {"ccw": 1.0, "cw": -1.0}


@dataclass(frozen=True, kw_only=True)
class PlantParameters:
    """What the plant is made of. Arrays carry a leading vehicle axis N, so that each vehicle may differ.

    Where two shapes are given the shorter is the same for all, and is computed with just as it stands.
    """

    name: str
    mass_kg: NDArray[np.float64]  # (N,)
    inertia_kg_m2: NDArray[np.float64]  # (N, 3)
    position_m: NDArray[np.float64]  # (m, 2) or (N, m, 2) from the centre of mass: x forward, y right
    frame_m: NDArray[np.float64]  # (m, 2) the same as an autopilot is told: from the middle of the frame
    down_m: NDArray[np.float64]  # (m,) z of the hubs, where their thrust acts
    # (m, 3) unit vector along which each pushes, FRD; None: all of them straight up
    axis: NDArray[np.float64] | None
    # (m,) +1: torque on the airframe about +z (rotor turns counter-clockwise seen from above)
    spin: NDArray[np.float64]
    max_thrust_n: NDArray[np.float64]  # (N, m)
    time_constant_up_s: NDArray[np.float64]  # (N,) or (N, m)
    time_constant_down_s: NDArray[np.float64]  # (N,) or (N, m)
    torque_per_thrust_m: NDArray[np.float64]  # (N,) or (N, m)
    output_delay_s: NDArray[np.float64]  # (N,) from the output as telemetry tells it until the motor hears it
    rotor_inertia_kg_m2: float
    max_speed_rad_s: float
    thrust_expo: NDArray[np.float64]  # (N,)
    spin_min: NDArray[np.float64]  # (N,)
    spin_max: float
    pwm_min: float
    pwm_max: float
    gyro_filter_hz: NDArray[np.float64]  # (N,)
    accelerometer_filter_hz: NDArray[np.float64]  # (N,)
    imu_m: NDArray[np.float64]  # (N, 3) where the accelerometer is, from the centre of mass, FRD
    gyro_turn_rad: NDArray[np.float64]  # (N, 3) rotation vector by which it is not mounted straight, FRD
    accelerometer_turn_rad: NDArray[np.float64]  # (N, 3)
    drag_area_m2: NDArray[np.float64]  # (2, 3) flying towards +x, +y, +z; towards -x, -y, -z
    pressure_centre_m: NDArray[np.float64]  # (3,) or (N, 3)
    rotor_radius_m: float
    rotor_drag_n_s_per_m: float  # force of one rotor at full speed per m/s of its hub through the air
    hub_height_m: float | NDArray[np.float64]  # of the rotors above the centre of mass, one for all or (m,)
    hub_above_ground_m: float  # standing
    translational_lift: float  # share of thrust gained when all induced velocity is gone
    wake_loss: float  # share of thrust lost in the wake of a rotor ahead, at the induced velocity of hover
    flap_back_n_m_s_per_m: float  # hub moment away from the wind, of one rotor at full speed per m/s
    flap_side_n_m_s_per_m: float  # and across it, with the sign of the spin

    @property
    def vehicles(self) -> int:
        """N."""
        return int(self.mass_kg.shape[0])

    @property
    def motors(self) -> int:
        """m."""
        return int(self.position_m.shape[-2])

    @property
    def alike(self) -> bool:
        """Whether all rotors push alike and straight up."""
        return self.axis is None and self.torque_per_thrust_m.ndim == 1 and bool(np.ptp(self.max_thrust_n[0]) == 0.0)

    @property
    def lift_n(self) -> NDArray[np.float64]:
        """(N,) upwards, of all motors at full output in still air."""
        return np.asarray(
            (self.max_thrust_n if self.axis is None else self.max_thrust_n * -self.axis[:, 2]).sum(axis=1)
        )

    def effectiveness_si(self) -> NDArray[np.float64]:
        """(4, m) thrust N, roll, pitch, yaw N m of the first vehicle's motors at full output in still air."""
        x, y = self.position_m.reshape(-1, self.motors, 2)[0].T
        drag = np.broadcast_to(self.torque_per_thrust_m.T, (self.motors, self.vehicles))[:, 0] * self.spin
        axis = np.tile([0.0, 0.0, -1.0], (self.motors, 1)) if self.axis is None else self.axis
        torque = np.cross(np.stack([x, y, self.down_m], axis=1), axis) - drag[:, None] * axis
        return np.concatenate([-axis[:, 2:], torque], axis=1).T * self.max_thrust_n[0]

    def perturbed(self, *, fraction: float, generators: list[np.random.Generator]) -> PlantParameters:
        """Mass, each inertia and each motor's thrust drawn uniformly within +- ``fraction`` for every vehicle.

        The thrust error is one factor for all motors of a vehicle (air density, propellers of one kind), as a
        weighing scale and a thrust stand would miss it.
        """
        scale = np.array([1.0 + fraction * g.uniform(-1.0, 1.0, 5) for g in generators])
        return replace(
            self,
            mass_kg=self.mass_kg * scale[:, 0],
            inertia_kg_m2=self.inertia_kg_m2 * scale[:, 1:4],
            max_thrust_n=self.max_thrust_n * scale[:, 4:5],
        )


def _rotor_position(rotor: dict[str, Any]) -> tuple[float, float]:
    if "angle_deg" in rotor:
        angle = math.radians(rotor["angle_deg"])
        return rotor["arm_m"] * math.cos(angle), rotor["arm_m"] * math.sin(angle)
    return rotor["x_m"], rotor["y_m"]


def _axes(rotors: list[dict[str, Any]]) -> NDArray[np.float64] | None:
    if not any("axis" in rotor for rotor in rotors):
        return None
    axis = np.array([rotor.get("axis", [0.0, 0.0, -1.0]) for rotor in rotors], float)
    return axis / np.linalg.norm(axis, axis=1, keepdims=True)


def _hub_heights(rotors: list[dict[str, Any]], down: NDArray[np.float64], otherwise: float) -> NDArray[np.float64]:
    """(m,) above the centre of mass: of those that say how high they are, what they say."""
    return np.array([-z if "z_m" in rotor else otherwise for rotor, z in zip(rotors, down.tolist(), strict=True)])


def _as_upright(data: dict[str, Any]) -> dict[str, Any]:
    """A file that gives each rotor's ``acceleration``, as one whose upright rotors stand where they would do that.

    Wind and wakes then find them there too.
    """
    mass, (ix, iy, iz) = data["airframe"]["mass_kg"], data["airframe"]["inertia_kg_m2"]
    rotors = []
    for rotor in data["rotor"]:
        up, roll, pitch, yaw = rotor["acceleration"]
        lift = mass * up
        turned = {
            "x_m": iy * pitch / lift,
            "y_m": -ix * roll / lift,
            "thrust": lift / data["motor"]["max_thrust_n"],
            "torque_per_thrust_m": _SPIN[rotor["spin"]] * iz * yaw / lift,
            "frame_m": _rotor_position(rotor),
        }
        lags = {key: value for key, value in rotor.items() if key.startswith("time_constant")}
        rotors.append({"spin": rotor["spin"], **turned, **lags})
    frame = data["airframe"] | {"centre_of_mass_m": [0.0, 0.0, 0.0]}
    return data | {"airframe": frame, "rotor": rotors}


def load(path: Path, *, vehicles: int = 1, thrust_to_weight: float | None = None) -> PlantParameters:
    """Read an airframe TOML for ``vehicles`` identical plants.

    ``thrust_to_weight`` replaces the file's maximum thrust. Raises OSError or KeyError on an unreadable file.
    """
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    if "acceleration" in data["rotor"][0]:
        data = _as_upright(data)
    frame, motor, command = data["airframe"], data["motor"], data["command"]
    telemetry, aero, rotors = data["telemetry"], data["aerodynamics"], data["rotor"]
    axis, strength = _axes(rotors), np.array([rotor.get("thrust", 1.0) for rotor in rotors])
    lift = strength if axis is None else -axis[:, 2] * strength
    max_thrust = float(motor["max_thrust_n"])
    if thrust_to_weight is not None:
        max_thrust = thrust_to_weight * frame["mass_kg"] * GRAVITY_M_S2 / float(lift.sum())
    place = np.array([_rotor_position(r) for r in rotors])
    cx, cy, cz = frame.get("centre_of_mass_m", [0.0, 0.0, 0.0])
    down = np.array([r.get("z_m", 0.0) for r in rotors]) - cz
    hub_height = float(aero["hub_height_m"])

    def per_vehicle(value: float) -> NDArray[np.float64]:
        return np.full(vehicles, float(value))

    def per_motor(key: str) -> NDArray[np.float64]:
        """(N,) when no rotor has its own, else (N, m)."""
        if not any(key in rotor for rotor in rotors):
            return per_vehicle(motor[key])
        return np.tile(np.array([rotor.get(key, motor[key]) for rotor in rotors], float), (vehicles, 1))

    return PlantParameters(
        name=frame["name"],
        mass_kg=per_vehicle(frame["mass_kg"]),
        inertia_kg_m2=np.tile(np.asarray(frame["inertia_kg_m2"], float), (vehicles, 1)),
        position_m=place - np.array([cx, cy]),
        frame_m=np.array([r.get("frame_m", at) for r, at in zip(rotors, place.tolist(), strict=True)]),
        down_m=down,
        axis=axis,
        spin=np.array([_SPIN[r["spin"]] for r in rotors]),
        max_thrust_n=np.tile(max_thrust * strength, (vehicles, 1)),
        time_constant_up_s=per_motor("time_constant_up_s"),
        time_constant_down_s=per_motor("time_constant_down_s"),
        torque_per_thrust_m=per_motor("torque_per_thrust_m"),
        output_delay_s=per_vehicle(telemetry.get("output_delay_s", 0.0)),
        rotor_inertia_kg_m2=float(motor["rotor_inertia_kg_m2"]),
        max_speed_rad_s=float(motor["max_speed_rad_s"]),
        thrust_expo=per_vehicle(command["thrust_expo"]),
        spin_min=per_vehicle(command["spin_min"]),
        spin_max=float(command["spin_max"]),
        pwm_min=float(command["pwm_min"]),
        pwm_max=float(command["pwm_max"]),
        gyro_filter_hz=per_vehicle(telemetry["gyro_filter_hz"]),
        accelerometer_filter_hz=per_vehicle(telemetry["accelerometer_filter_hz"]),
        imu_m=np.zeros((vehicles, 3)),
        gyro_turn_rad=np.zeros((vehicles, 3)),
        accelerometer_turn_rad=np.zeros((vehicles, 3)),
        drag_area_m2=np.array([aero["drag_area_forward_m2"], aero["drag_area_backward_m2"]], float),
        pressure_centre_m=np.asarray(aero["pressure_centre_m"], float),
        rotor_radius_m=float(aero["rotor_radius_m"]),
        rotor_drag_n_s_per_m=float(aero["rotor_drag_n_s_per_m"]),
        hub_height_m=hub_height if not any("z_m" in r for r in rotors) else _hub_heights(rotors, down, hub_height),
        hub_above_ground_m=float(aero["hub_above_ground_m"]),
        translational_lift=float(aero["translational_lift"]),
        wake_loss=float(aero["wake_loss"]),
        flap_back_n_m_s_per_m=float(aero["flap_back_n_m_s_per_m"]),
        flap_side_n_m_s_per_m=float(aero["flap_side_n_m_s_per_m"]),
    )
