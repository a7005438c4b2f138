"""What moving air brings into a record beside the motors: columns whose size nobody knows, taken off each axis.

Rotors in the wind drag sideways, each by its speed; the accelerometer has the sum of it (``core/residual.py``). What
steers roll and pitch makes the rotors' speeds uneven, and so turns the vehicle about its yaw axis: between 0.4 and 3 Hz
that is most of what is left of yaw.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration import chain, model
from nff_companion.calibration.model import Layout

_WIND_S = 0.3  # of the side force: the wind that it shows is no quicker
_STILL = 1e-3  # least thrust of a rotor over the mean that its speed is taken from


def columns(
    values: NDArray[np.float64], thrust: NDArray[np.float64], layout: Layout, dt_s: float, *, climbs: bool
) -> list[NDArray[np.float64]]:
    """(N, c) of each axis: damping by the rate, what side wind and speed do, Euler's part that wrong inertias leave; of
    yaw, damping by the rotors' speed, and by how much more its drag follows the outputs while the vehicle climbs.

    ``values`` (N, 12) as ``chain.measured`` has them, ``dt_s`` apart, ``thrust`` (N, m) of the rotors, of any scale.
    ``climbs``: the velocity is known.
    """
    one, side, rate, velocity = np.ones(len(values)), values[:, 4:6], values[:, 6:9], values[:, 9:12]
    thrust = thrust / thrust.mean()
    speed = np.sqrt(np.maximum(thrust, _STILL))
    damped = rate * speed.mean(axis=1, keepdims=True)
    climbing = velocity[:, 2] * (thrust @ layout.rows[model.YAW])
    moved = np.column_stack([velocity, climbing]) if climbs else np.zeros((len(values), 0))
    (p, q, r), level, up = rate.T, slice(0, 2), slice(2, 3)
    return [
        np.column_stack([one, _of_lift(values, dt_s), moved[:, up]]),
        np.column_stack([damped[:, 0], q * r, side[:, 1], moved[:, level]]),
        np.column_stack([damped[:, 1], r * p, side[:, 0], moved[:, level]]),
        np.column_stack([one, damped[:, 2], p * q, side, moved[:, level], moved[:, 3:], side * _uneven(speed, layout)]),
    ]


def _of_lift(values: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """(N, 9) Side wind; an accelerometer that is not upright has a share of it, and one beside the middle has what
    turning does there. The noise of the side force, squared, would hide what the wind does."""
    side = chain.smoothed_both_ways(values[:, 4:6], dt_s, _WIND_S)
    p, q, r = values[:, 6:9].T
    return np.column_stack([(side**2).sum(axis=1), side, values[:, 1:3], p * p, q * q, p * r, q * r])


def taken_off(values: NDArray[np.float64], air: NDArray[np.float64]) -> NDArray[np.float64]:
    """``values`` (N,) without what the columns ``air`` (N, c) explain of them."""
    scale = np.sqrt(np.mean(air * air, axis=0))
    scaled = air / np.where(scale > 0.0, scale, 1.0)
    return np.asarray(values - scaled @ np.linalg.lstsq(scaled, values, rcond=1e-9)[0])


def _uneven(speed: NDArray[np.float64], layout: Layout) -> NDArray[np.float64]:
    """(N, 2) Where the rotors' ``speed`` (N, m) has its middle, over the farthest arm, to the left and forwards: a push
    along x and y turns the vehicle by its place there."""
    place = layout.rows[[model.ROLL, model.PITCH]] / layout.thrust
    return np.asarray((speed @ place.T) / speed.sum(axis=1, keepdims=True))
