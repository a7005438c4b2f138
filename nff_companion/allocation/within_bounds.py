"""Motor thrusts within 0..1 for one demand, where u = A demand leaves the bounds.

While all motors are believed to work, ``desaturate`` cuts the demand along the columns of A, as autopilots do: it asks
nothing of a motor that A would not, so that a motor that has just died costs what A gives it and no more. Once the
motors left are known, ``constrain`` finds the best that they can do:

    min |Omega (B u - demand)|^2 + eps |u - A demand|^2,   0 <= u <= 1

a box quadratic program, solved exactly (daqp). Omega puts roll and pitch before thrust, and thrust before yaw: heading
is what a vehicle can do without for longest. (With a wrong B it is worse than ``desaturate``: it
makes up for bounds with motors that may be dead.)
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import DEFAULT, OverrideTuning


def constrain(
    matrix: NDArray[np.float64],
    effectiveness: NDArray[np.float64],
    demand: NDArray[np.float64],
    tuning: OverrideTuning = DEFAULT.override,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thrusts u (m,) for ``demand`` (n,), and the demand that they serve.

    ``matrix`` A (m, n), ``effectiveness`` B (n, m) that A is a right inverse of; motors with a zero column are not
    driven; an axis given up (zero column of A) does not count.
    """
    out = matrix @ demand
    if _within(out):
        return out, demand
    used = effectiveness.any(axis=0)
    wanted = matrix.any(axis=0)
    omega = np.array(tuning.priority) * wanted
    scaled = effectiveness[:, used] * omega[:, None]
    count = int(used.sum())
    hessian = scaled.T @ scaled + tuning.close_to_matrix * np.eye(count)
    linear = -scaled.T @ (omega * demand) - tuning.close_to_matrix * out[used]
    part, _, flag, _ = daqp.solve(hessian, linear, np.zeros((0, count)), np.ones(count), np.zeros(count))
    # Should the program ever fail, what A asks for is cut: worse, but within bounds.
    clipped = np.minimum(np.maximum(out, 0.0), 1.0)
    if flag == 1 and np.isfinite(part).all():
        clipped[used] = np.minimum(np.maximum(part, 0.0), 1.0)
    served = np.where(wanted, effectiveness @ clipped, demand)
    return clipped, served


def _within(thrust: NDArray[np.float64]) -> bool:
    values = thrust.tolist()
    return min(values) >= 0.0 and max(values) <= 1.0


def _room(values: list[float], parts: list[float]) -> float:
    """Largest share of ``parts`` in 0..1 that ``values`` + share * parts keeps within 0..1."""
    room = min(
        ((1.0 - value) if part > 0.0 else value) / max(abs(part), 1e-12)
        for value, part in zip(values, parts, strict=True)
    )
    return max(min(room, 1.0), 0.0)


def desaturate(
    matrix: NDArray[np.float64], demand: NDArray[np.float64], tuning: OverrideTuning = DEFAULT.override
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Motor thrusts (m,) in 0..1 for ``demand`` (n,): yaw is cut first, then thrust moves, then roll and pitch.

    Returns the thrusts and the demand that was served. In plain numbers: arrays take half as long again for so few.
    """
    out = matrix @ demand
    if _within(out):
        return out, demand
    asked, roll, pitch, yaw = demand.tolist()
    thrust = asked
    collective, of_roll, of_pitch, of_yaw = matrix.T.tolist()
    attitude = [a * roll + b * pitch for a, b in zip(of_roll, of_pitch, strict=True)]
    span = max(attitude) - min(attitude)
    if span > 1.0:
        roll, pitch = roll / span, pitch / span
        attitude = [value / span for value in attitude]
    base = [c * thrust + value for c, value in zip(collective, attitude, strict=True)]
    yaw *= _room(base, [c * yaw for c in of_yaw])
    turned = [value + c * yaw for value, c in zip(attitude, of_yaw, strict=True)]
    wanted = [c * thrust + value for c, value in zip(collective, turned, strict=True)]
    largest = max(*collective, 1e-6)
    if max(wanted) > 1.0:
        thrust -= (max(wanted) - 1.0) / largest
    elif min(wanted) < 0.0:
        thrust += min(-min(wanted) / largest, tuning.thrust_raise_max * asked)
    cut = [min(max(c * thrust + value, 0.0), 1.0) for c, value in zip(collective, turned, strict=True)]
    return np.array(cut), np.array([thrust, roll, pitch, yaw])
