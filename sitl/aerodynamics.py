"""What moving air does to rotors and airframe; N vehicles with m rotors in one call.

Each effect is the simplest form that has the right shape:

- induced velocity in edgewise flow by Glauert's momentum theory, v_i^2 = -V^2/2 + sqrt(V^4/4 + v_h^4); as it falls the
  same rotor speed gives more thrust (translational lift);
- a rotor behind another in the air stream flies in its sinking wake and loses thrust;
- blade flapping: a hub moment that tilts the vehicle away from the wind, and one across it that turns with the spin;
- ground effect after Cheeseman and Bennett, T / T_free = 1 / (1 - (R / 4 z)^2);
- airframe drag, quadratic, with its own area on each side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sitl.airframe import PlantParameters

AIR_DENSITY_KG_M3 = 1.225
_STILL_M_S = 0.5  # below it the wake goes straight down, onto no other rotor
_WAKE_DEPTH_RADII = 1.3  # how far below the disc the wake still matters
_BEHIND_RADII = 0.5  # a rotor nearer than this along the stream is beside, not behind
_GROUND_MIN_RADII = 0.6  # the formula's pole is never reached: legs are longer
_GROUND_MAX_RADII = 4.0


class Aerodynamics:
    """Constants of a fleet."""

    def __init__(self, parameters: PlantParameters) -> None:
        p = parameters
        self._p = p
        place = p.position_m
        ahead = place[..., :, None, :] - place[..., None, :, :]
        self._ahead = ahead[..., 0], ahead[..., 1]  # [j, i] or [n, j, i]: from rotor i to rotor j
        self._disc = 2.0 * AIR_DENSITY_KG_M3 * np.pi * p.rotor_radius_m**2

    def rotor_thrust(
        self, static_n: NDArray[np.float64], air: NDArray[np.float64], height_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Thrust (N, m) at the rotor speeds that give ``static_n`` (N, m) in still air far from the ground.

        ``air`` (N, 3): velocity through the air, body frame; ``height_m`` (N,) above ground. The axial speed is not
        dealt with here.
        """
        p = self._p
        across = np.hypot(air[:, 0], air[:, 1])
        hover_squared = static_n.sum(axis=1) / (p.motors * self._disc)  # v_h^2 of the mean rotor
        half = 0.5 * across**2
        induced_squared = np.sqrt(half * half + hover_squared**2) - half
        share = np.sqrt(induced_squared / np.maximum(hover_squared, 1e-6))  # v_i / v_h
        factor = (1.0 + p.translational_lift * (1.0 - share))[:, None] - self._wake(air, across, induced_squared, share)
        near = height_m < _GROUND_MAX_RADII * p.rotor_radius_m
        if near.any():
            z = np.maximum(height_m + p.hub_above_ground_m, _GROUND_MIN_RADII * p.rotor_radius_m)
            # The air stream carries the cushion away.
            cushion = (p.rotor_radius_m / (4.0 * z)) ** 2 * share**2
            factor = factor * np.where(near, 1.0 / (1.0 - cushion), 1.0)[:, None]
        return static_n * factor

    def _wake(
        self,
        air: NDArray[np.float64],
        across: NDArray[np.float64],
        induced_squared: NDArray[np.float64],
        share: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Share of thrust (N, m) that each rotor loses in the wakes of those ahead of it."""
        p = self._p
        moving = across > _STILL_M_S
        if p.wake_loss == 0.0 or not moving.any():
            return np.zeros((len(across), p.motors))
        speed = np.maximum(across, _STILL_M_S)
        c, s = (air[:, 0] / speed)[:, None, None], (air[:, 1] / speed)[:, None, None]
        dx, dy = self._ahead
        distance = c * dx + s * dy  # [n, j, i] of rotor j ahead of rotor i, along the stream
        offset = c * dy - s * dx
        sink = ((np.sqrt(induced_squared) - air[:, 2]) / speed)[:, None, None]  # descending (z down) lifts the wake
        r = p.rotor_radius_m
        depth = distance * sink / (_WAKE_DEPTH_RADII * r)
        hit = np.exp(-(depth**2) - (offset / r) ** 2) * (distance > _BEHIND_RADII * r)
        loss = p.wake_loss * share[:, None] * hit.max(axis=1)
        return np.where(moving[:, None], loss, 0.0)

    def hub_moment(
        self, speed: NDArray[np.float64], hub_x: NDArray[np.float64], hub_y: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Roll and pitch moment (N,) of all hubs by flapping; ``speed`` (N, m) over full, hub air speeds (N, m) m/s."""
        p = self._p
        back, side = p.flap_back_n_m_s_per_m, p.flap_side_n_m_s_per_m
        turned = side * p.spin
        roll = -(speed * (back * hub_y + turned * hub_x)).sum(axis=1)
        pitch = (speed * (back * hub_x - turned * hub_y)).sum(axis=1)
        return roll, pitch

    def airframe_drag(self, air: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drag force (N, 3) in N, body frame."""
        area = np.where(air > 0.0, self._p.drag_area_m2[0], self._p.drag_area_m2[1])
        return -0.5 * AIR_DENSITY_KG_M3 * area * np.abs(air) * air
