"""What the compiled plant reads of ``PlantParameters``: a record for each vehicle and one for each of its rotors."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sitl.airframe import PlantParameters

AIR_DENSITY_KG_M3 = 1.225
Record: TypeAlias = Any  # one entry of a structured array: its fields are attributes to what is compiled

BODY = np.dtype(
    [
        ("inertia_kg_m2", "f8", (3,)),
        ("lift_n", "f8"),  # of all motors at full output
        ("spin_min", "f8"),
        ("spin_max", "f8"),
        ("thrust_expo", "f8"),
        ("rotor_momentum", "f8"),  # N m s of one rotor at full speed
        ("rotor_drag_n_s_per_m", "f8"),
        ("rotor_radius_m", "f8"),
        ("disc_kg_m", "f8"),  # twice the air's density times the area of one disc
        ("hub_above_ground_m", "f8"),
        ("translational_lift", "f8"),
        ("wake_loss", "f8"),
        ("flap_back_n_m_s_per_m", "f8"),
        ("flap_side_n_m_s_per_m", "f8"),
        ("drag_area_m2", "f8", (2, 3)),  # flying towards +x, +y, +z; towards -x, -y, -z
        ("pressure_centre_m", "f8", (3,)),
        ("late_steps", "i8"),  # whole steps that outputs are under way to the motors
        ("late_share", "f8"),  # and what is left of them, in steps
    ]
)
ROTOR = np.dtype(
    [
        ("x_m", "f8"),  # hub, from the centre of mass, FRD
        ("y_m", "f8"),
        ("z_m", "f8"),
        ("axis_x", "f8"),  # unit vector along which it pushes
        ("axis_y", "f8"),
        ("axis_z", "f8"),
        ("spin", "f8"),
        ("max_thrust_n", "f8"),
        ("torque_per_thrust_m", "f8"),
        ("hub_height_m", "f8"),  # where side forces act, above the centre of mass
        ("share_up", "f8"),  # of the way to its target that the thrust makes in a step
        ("share_down", "f8"),
        ("speed", "f8"),  # over the full one; the last step's, and its rate
        ("speed_rate_per_s", "f8"),
    ]
)


def _per_motor(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) or (N, m) as (N, 1) or (N, m)."""
    return value[:, None] if value.ndim == 1 else value


def bodies(p: PlantParameters, dt_s: float) -> NDArray[np.void]:
    """(N,) of BODY, for steps of ``dt_s``."""
    out = np.zeros(p.vehicles, BODY)
    for name in ("inertia_kg_m2", "spin_min", "spin_max", "thrust_expo", "rotor_drag_n_s_per_m", "rotor_radius_m"):
        out[name] = getattr(p, name)
    for name in ("hub_above_ground_m", "translational_lift", "wake_loss", "drag_area_m2", "pressure_centre_m"):
        out[name] = getattr(p, name)
    out["flap_back_n_m_s_per_m"], out["flap_side_n_m_s_per_m"] = p.flap_back_n_m_s_per_m, p.flap_side_n_m_s_per_m
    out["lift_n"] = p.max_thrust_n.sum(axis=1)
    out["rotor_momentum"] = p.rotor_inertia_kg_m2 * p.max_speed_rad_s
    out["disc_kg_m"] = 2.0 * AIR_DENSITY_KG_M3 * np.pi * p.rotor_radius_m**2
    steps = p.output_delay_s / dt_s
    out["late_steps"] = np.floor(steps).astype(int)
    out["late_share"] = steps - out["late_steps"]
    return out


def rotors(p: PlantParameters, dt_s: float) -> NDArray[np.void]:
    """(N, m) of ROTOR, for steps of ``dt_s``."""
    out = np.zeros((p.vehicles, p.motors), ROTOR)
    out["x_m"], out["y_m"], out["z_m"] = p.position_m[..., 0], p.position_m[..., 1], p.down_m
    axis = np.array([0.0, 0.0, -1.0]) if p.axis is None else p.axis
    out["axis_x"], out["axis_y"], out["axis_z"] = axis[..., 0], axis[..., 1], axis[..., 2]
    out["spin"], out["hub_height_m"] = p.spin, p.hub_height_m
    out["max_thrust_n"] = p.max_thrust_n
    out["torque_per_thrust_m"] = _per_motor(p.torque_per_thrust_m)
    with np.errstate(divide="ignore"):
        out["share_up"] = 1 - np.exp(-dt_s / _per_motor(p.time_constant_up_s))
        out["share_down"] = 1 - np.exp(-dt_s / _per_motor(p.time_constant_down_s))
    return out
