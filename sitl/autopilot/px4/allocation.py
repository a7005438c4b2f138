"""From rotors as parameters describe them to motor thrusts: what PX4 does between its controllers and its outputs.

After ActuatorEffectivenessRotors, ControlAllocationPseudoInverse, ControlAllocationSequentialDesaturation and
ControlAllocator (src/modules/control_allocator of v1.16). A demand is torque x, y, z and thrust x, y, z in FRD, as the
controllers give them: 1 is the most that they ask for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

AXES = 6
ROLL, PITCH, YAW, THRUST_X, THRUST_Y, THRUST_Z = range(AXES)
_FLOAT_EPSILON = 1.1920929e-07
_WEAK = 0.05  # of an axis: no motor does more there, and it is not controlled
_NEGLIGIBLE = 1e-3  # of a gain
_STEERS_MIN = 0.2  # a motor with a smaller gain is not looked at when saturation is taken out
_YAW_MARGIN = 0.15  # of the range, by which yaw may go beyond it


@dataclass(frozen=True, kw_only=True)
class Rotors:
    """CA_ROTORn_PX, PY, PZ (m, 3) m; AX, AY, AZ (m, 3) of any length; CT (m,); KM (m,), positive for ccw."""

    position_m: NDArray[np.float64]
    axis: NDArray[np.float64]
    thrust: NDArray[np.float64]
    moment: NDArray[np.float64]

    def without(self, removed: NDArray[np.bool_]) -> Rotors:
        """Motors ``removed`` (m,) give nothing."""
        return replace(self, thrust=np.where(removed, 0.0, self.thrust))


def effectiveness(rotors: Rotors) -> NDArray[np.float64]:
    """(6, m) what each motor does at full output; axes on which all are weak are 0."""
    columns = []
    for place, axis, ct, km in zip(rotors.position_m, rotors.axis, rotors.thrust, rotors.moment, strict=True):
        length = float(np.sqrt(axis @ axis))
        if length < _FLOAT_EPSILON or abs(ct) < _FLOAT_EPSILON:
            columns.append(np.zeros(AXES))  # switched off
            continue
        push = ct * axis / length
        columns.append(np.concatenate([np.cross(place, push) - km * push, push]))
    matrix = np.array(columns).T
    for row in matrix:
        if np.abs(row).max() <= _WEAK:
            row[:] = 0.0
    return matrix


def _spread(column: NDArray[np.float64]) -> float:
    """Of a torque's gains: their root mean square over half of the motors that have one."""
    count = np.count_nonzero(np.abs(column) > _NEGLIGIBLE)
    return float(np.sqrt((column**2).sum() / (0.5 * count))) if count else 1.0


def scale_of(inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) by which the columns of a pseudo-inverse (m, 6) are divided: roll and pitch alike, yaw by its largest gain,
    thrust by its mean over the motors that give some."""
    scale = np.ones(AXES)
    scale[ROLL] = scale[PITCH] = max(_spread(inverse[:, ROLL]), _spread(inverse[:, PITCH]))
    scale[YAW] = inverse[:, YAW].max()
    for axis in (THRUST_Z, THRUST_Y, THRUST_X):
        size = np.abs(inverse[:, axis])
        count = np.count_nonzero(size > _FLOAT_EPSILON)
        scale[axis] = size.sum() / count if count else scale[THRUST_Z]
    return scale


@dataclass(frozen=True, kw_only=True)
class Allocation:
    """``effect`` (6, m) of the motors; ``mix`` (m, 6) thrusts per demand; ``scale`` (6,) that mix was divided by."""

    effect: NDArray[np.float64]
    mix: NDArray[np.float64]
    scale: NDArray[np.float64]

    def given(self, thrust: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6,) demand that motor thrusts (m,) meet."""
        return np.asarray(self.scale * (self.effect @ thrust))


def allocation(rotors: Rotors, scale: NDArray[np.float64] | None = None) -> Allocation:
    """``scale``: of before, where motors were removed since; None: of these rotors, as after each configuration."""
    effect = effectiveness(rotors)
    inverse = np.asarray(np.linalg.pinv(effect, rcond=1e-6), float)
    own = scale_of(inverse) if scale is None else scale
    # Roll's scale stands for pitch's too, and that of thrust x for all of thrust.
    usable = own[[ROLL, ROLL, YAW, THRUST_X, THRUST_X, THRUST_X]] > _FLOAT_EPSILON
    own = np.where(usable, own, 1.0)
    mix = np.asarray(inverse / own)
    mix[np.abs(mix) < _NEGLIGIBLE] = 0.0
    return Allocation(effect=effect, mix=mix, scale=own)


def _excess(thrust: NDArray[np.float64], along: NDArray[np.float64], highest: float) -> float:
    """How far along a column (m,) the thrusts (m,) are to be moved, so that their saturation is the least."""
    least = most = 0.0
    for value, gain in zip(thrust.tolist(), along.tolist(), strict=True):
        if abs(gain) < _STEERS_MIN:
            continue
        for bound, beyond in ((0.0, value < 0.0), (highest, value > highest)):
            if beyond:
                least, most = min(least, (bound - value) / gain), max(most, (bound - value) / gain)
    return least + most


def _relieved(
    thrust: NDArray[np.float64], along: NDArray[np.float64], *, only_up: bool = False, highest: float = 1.0
) -> NDArray[np.float64]:
    """Moved along a column, and half a step more; ``only_up``: never against it."""
    first = _excess(thrust, along, highest)
    if only_up and first < 0.0:
        return thrust
    moved = thrust + first * along
    return np.asarray(moved + 0.5 * _excess(moved, along, highest) * along)


def thrusts(found: Allocation, demand: NDArray[np.float64], *, airmode: int, desaturate: bool) -> NDArray[np.float64]:
    """(m,) in 0..1. ``airmode`` of MC_AIRMODE: 0 off, 1 roll and pitch, 2 yaw too; ``desaturate``: CA_METHOD is not 0.

    The column of thrust z points down: against it is more thrust.
    """
    mix = found.mix
    if not desaturate:
        return np.clip(mix @ demand, 0.0, 1.0)
    down, yaw = mix[:, THRUST_Z], mix[:, YAW]
    if airmode == 2:
        return np.clip(_relieved(_relieved(mix @ demand, down), yaw), 0.0, 1.0)
    turning = yaw * demand[YAW]
    level = mix @ demand - turning
    if airmode == 1:
        level = _relieved(level, down)
    else:
        level = _relieved(level, down, only_up=True)
        level = _relieved(level, mix[:, ROLL])
        level = _relieved(level, mix[:, PITCH])
    turned = _relieved(level + turning, yaw, highest=1.0 + _YAW_MARGIN)
    return np.clip(_relieved(turned, down, only_up=True), 0.0, 1.0)
