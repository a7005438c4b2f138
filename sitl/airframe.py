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


@dataclass(frozen=True, kw_only=True)
class PlantParameters:
    """What the plant is made of. Arrays carry a leading vehicle axis N, so that each vehicle may differ.

    Where two shapes are given the shorter is the same for all, and is computed with just as it stands. The IMU is taken
    to lie in the centre of mass, wherever that is.
    """

    name: str
    mass_kg: NDArray[np.float64]  # (N,)
    inertia_kg_m2: NDArray[np.float64]  # (N, 3)
    position_m: NDArray[np.float64]  # (m, 2) or (N, m, 2) from the centre of mass: x forward, y right
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
    gyro_filter_hz: float
    accelerometer_filter_hz: float
    drag_area_m2: NDArray[np.float64]  # (2, 3) flying towards +x, +y, +z; towards -x, -y, -z
    pressure_centre_m: NDArray[np.float64]  # (3,) or (N, 3)
    rotor_radius_m: float
    rotor_drag_n_s_per_m: float  # force of one rotor at full speed per m/s of its hub through the air
    hub_height_m: float  # of the rotors above the centre of mass
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


def load(path: Path, *, vehicles: int = 1, thrust_to_weight: float | None = None) -> PlantParameters:
    """Read an airframe TOML for ``vehicles`` identical plants.

    ``thrust_to_weight`` replaces the file's maximum thrust. Raises OSError or KeyError on an unreadable file.
    """
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    frame, motor, command = data["airframe"], data["motor"], data["command"]
    telemetry, aero, rotors = data["telemetry"], data["aerodynamics"], data["rotor"]
    max_thrust = float(motor["max_thrust_n"])
    if thrust_to_weight is not None:
        max_thrust = thrust_to_weight * frame["mass_kg"] * GRAVITY_M_S2 / len(rotors)

    def per_vehicle(value: float) -> NDArray[np.float64]:
        return np.full(vehicles, float(value))

    return PlantParameters(
        name=frame["name"],
        mass_kg=per_vehicle(frame["mass_kg"]),
        inertia_kg_m2=np.tile(np.asarray(frame["inertia_kg_m2"], float), (vehicles, 1)),
        position_m=np.array([_rotor_position(r) for r in rotors]),
        spin=np.array([{"ccw": 1.0, "cw": -1.0}[r["spin"]] for r in rotors]),
        max_thrust_n=np.full((vehicles, len(rotors)), max_thrust),
        time_constant_up_s=per_vehicle(motor["time_constant_up_s"]),
        time_constant_down_s=per_vehicle(motor["time_constant_down_s"]),
        torque_per_thrust_m=per_vehicle(motor["torque_per_thrust_m"]),
        output_delay_s=per_vehicle(0.0),
        rotor_inertia_kg_m2=float(motor["rotor_inertia_kg_m2"]),
        max_speed_rad_s=float(motor["max_speed_rad_s"]),
        thrust_expo=per_vehicle(command["thrust_expo"]),
        spin_min=per_vehicle(command["spin_min"]),
        spin_max=float(command["spin_max"]),
        pwm_min=float(command["pwm_min"]),
        pwm_max=float(command["pwm_max"]),
        gyro_filter_hz=float(telemetry["gyro_filter_hz"]),
        accelerometer_filter_hz=float(telemetry["accelerometer_filter_hz"]),
        drag_area_m2=np.array([aero["drag_area_forward_m2"], aero["drag_area_backward_m2"]], float),
        pressure_centre_m=np.asarray(aero["pressure_centre_m"], float),
        rotor_radius_m=float(aero["rotor_radius_m"]),
        rotor_drag_n_s_per_m=float(aero["rotor_drag_n_s_per_m"]),
        hub_height_m=float(aero["hub_height_m"]),
        hub_above_ground_m=float(aero["hub_above_ground_m"]),
        translational_lift=float(aero["translational_lift"]),
        wake_loss=float(aero["wake_loss"]),
        flap_back_n_m_s_per_m=float(aero["flap_back_n_m_s_per_m"]),
        flap_side_n_m_s_per_m=float(aero["flap_side_n_m_s_per_m"]),
    )
