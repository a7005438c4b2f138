"""What moving air does to rotors and airframe, of one vehicle, compiled.

Each effect is the simplest form that has the right shape:

- induced velocity in edgewise flow by Glauert's momentum theory, v_i^2 = -V^2/2 + sqrt(V^4/4 + v_h^4); as it falls the
  same rotor speed gives more thrust (translational lift);
- a rotor behind another in the air stream flies in its sinking wake and loses thrust;
- blade flapping: a hub moment that tilts the vehicle away from the wind, and one across it that turns with the spin;
- ground effect after Cheeseman and Bennett, T / T_free = 1 / (1 - (R / 4 z)^2);
- airframe drag, quadratic, with its own area on each side.

``air`` is the velocity through the air in the body frame, m/s; ``body`` a record BODY, ``rotors`` (N, m) of them ROTOR.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl.compiled import part
from sitl.records import AIR_DENSITY_KG_M3, Record
from sitl.rotation import Vector

_STILL_M_S = 0.5  # below it the wake goes straight down, onto no other rotor
_WAKE_DEPTH_RADII = 1.3  # how far below the disc the wake still matters
_BEHIND_RADII = 0.5  # a rotor nearer than this along the stream is beside, not behind
_GROUND_MIN_RADII = 0.6  # the formula's pole is never reached: legs are longer
_GROUND_MAX_RADII = 4.0


class Stream(NamedTuple):
    """The air through the mean rotor: speed m/s, direction and slope of the wake, and what it makes of all thrust."""

    along_x: float  # direction in which the vehicle moves through the air
    along_y: float
    sink: float  # of the wake, per metre along the stream
    wakes: float  # share of thrust lost in the middle of a wake; 0: no rotor is in one
    lift: float  # factor of all thrust before wakes
    cushion: float  # factor of all thrust by the ground


@part
def stream(body: Record, static_n: float, air: Vector, height_m: float) -> Stream:
    """``static_n``: mean thrust of the rotors in still air; ``height_m`` above ground."""
    across = math.sqrt(air[0] * air[0] + air[1] * air[1])
    hover_squared = static_n / body.disc_kg_m  # v_h^2
    half = 0.5 * across * across
    induced_squared = math.sqrt(half * half + hover_squared * hover_squared) - half
    share = math.sqrt(induced_squared / max(hover_squared, 1e-6))  # v_i / v_h
    cushion, radius = 1.0, body.rotor_radius_m
    if height_m < _GROUND_MAX_RADII * radius:
        z = max(height_m + body.hub_above_ground_m, _GROUND_MIN_RADII * radius)
        # The air stream carries the cushion away.
        cushion = 1.0 / (1.0 - (radius / (4.0 * z)) ** 2 * share * share)
    speed = max(across, _STILL_M_S)
    return Stream(
        air[0] / speed,
        air[1] / speed,
        (math.sqrt(induced_squared) - air[2]) / speed,  # descending (z down) lifts the wake
        body.wake_loss * share if across > _STILL_M_S else 0.0,
        1.0 + body.translational_lift * (1.0 - share),
        cushion,
    )


@part
def thrust_factor(body: Record, rotors: NDArray[np.void], n: int, rotor: int, flow: Stream) -> float:
    """Thrust of ``rotors[n, rotor]`` over that in still air far from the ground; no axial speed is in it."""
    if flow.wakes == 0.0:
        return flow.lift * flow.cushion
    x, y, radius = rotors[n, rotor].x_m, rotors[n, rotor].y_m, body.rotor_radius_m
    across, steep = 1.0 / radius, flow.sink / (_WAKE_DEPTH_RADII * radius)
    nearest = math.inf  # to the middle of a wake: squared, over its widths
    for other in range(rotors.shape[1]):
        dx, dy = rotors[n, other].x_m - x, rotors[n, other].y_m - y
        distance = flow.along_x * dx + flow.along_y * dy  # of the other ahead of this one, along the stream
        if distance > _BEHIND_RADII * radius:
            offset = (flow.along_x * dy - flow.along_y * dx) * across
            depth = distance * steep
            nearest = min(nearest, depth * depth + offset * offset)
    return (flow.lift - flow.wakes * math.exp(-nearest)) * flow.cushion


@part
def hub_moment(body: Record, rotor: Record, speed: float, hub_x: float, hub_y: float) -> tuple[float, float]:
    """Roll and pitch moment of one hub by flapping; ``speed`` over full, hub air speeds m/s."""
    back, side = body.flap_back_n_m_s_per_m, body.flap_side_n_m_s_per_m * rotor.spin
    return -speed * (back * hub_y + side * hub_x), speed * (back * hub_x - side * hub_y)


@part
def airframe_drag(body: Record, air: Vector) -> Vector:
    """Drag force in N, body frame."""
    area = body.drag_area_m2
    half = -0.5 * AIR_DENSITY_KG_M3
    return (
        half * area[0 if air[0] > 0.0 else 1, 0] * abs(air[0]) * air[0],
        half * area[0 if air[1] > 0.0 else 1, 1] * abs(air[1]) * air[1],
        half * area[0 if air[2] > 0.0 else 1, 2] * abs(air[2]) * air[2],
    )
