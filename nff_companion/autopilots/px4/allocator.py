"""PX4's own control allocation, to know beforehand what it will do with a geometry that it is told.

After ActuatorEffectivenessRotors, ControlAllocationPseudoInverse and ControlAllocationSequentialDesaturation
(v1.14 to v1.17). Demands: torque x, y, z and thrust x, y, z in FRD, normalised as PX4's controllers give them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

_WEAK_ROW = 0.05  # an axis on which every motor does less is not controlled at all
_SMALL = 1e-3
_DESATURATION_MIN = 0.2
_YAW_MARGIN = 0.15  # MINIMUM_YAW_MARGIN
ROLL, PITCH, YAW, THRUST_X, THRUST_Y, THRUST_Z = range(6)


@dataclass(frozen=True)
class Geometry:
    """CA_ROTORn_*: positions (m, 3), axes (m, 3), CT (m,), KM (m,); ``desaturate`` False: plain pseudo-inverse."""

    position_m: NDArray[np.float64]
    axis: NDArray[np.float64]
    thrust_coefficient: NDArray[np.float64]
    moment_ratio: NDArray[np.float64]
    airmode: int = 0
    desaturate: bool = True

    def scaled(
        self, effectiveness: NDArray[np.float64], *, yaw_released: bool = False, still: tuple[int, ...] = ()
    ) -> Geometry:
        """The geometry with each CT times ``effectiveness`` (m,), and no moments when yaw is released, nor of the
        motors ``still`` (indices)."""
        moment = np.zeros_like(self.moment_ratio) if yaw_released else self.moment_ratio.copy()
        moment[list(still)] = 0.0
        return replace(self, thrust_coefficient=self.thrust_coefficient * effectiveness, moment_ratio=moment)


def effectiveness_matrix(geometry: Geometry) -> NDArray[np.float64]:
    """(6, m) torques and thrusts of the motors at full output, weak rows zeroed."""
    norm = np.linalg.norm(geometry.axis, axis=1)
    used = (norm > 1e-7) & (np.abs(geometry.thrust_coefficient) > 1e-7)
    axis = geometry.axis / np.where(norm > 1e-7, norm, 1.0)[:, None]
    ct = np.where(used, geometry.thrust_coefficient, 0.0)[:, None]
    thrust = ct * axis
    moment = ct * np.cross(geometry.position_m, axis) - ct * geometry.moment_ratio[:, None] * axis
    matrix = np.vstack([moment.T, thrust.T])
    matrix[np.abs(matrix).max(axis=1) <= _WEAK_ROW] = 0.0
    return matrix


def mix_matrix(geometry: Geometry) -> NDArray[np.float64]:
    """(m, 6): pseudo-inverse, normalised as PX4 does after a change of configuration."""
    mix = np.linalg.pinv(effectiveness_matrix(geometry), rcond=1e-6)
    scale = np.ones(6)
    for axis in (ROLL, PITCH):
        column = mix[:, axis]
        count = int((np.abs(column) > _SMALL).sum())
        scale[axis] = np.sqrt((column @ column) / (count / 2.0)) if count else 1.0
    scale[ROLL] = scale[PITCH] = max(scale[ROLL], scale[PITCH])
    scale[YAW] = mix[:, YAW].max()
    for axis in (THRUST_Z, THRUST_Y, THRUST_X):
        norm = np.abs(mix[:, axis])
        count = int((norm > 1e-7).sum())
        scale[axis] = norm.sum() / count if count else scale[THRUST_Z]
    scale = np.where(scale > 1e-7, scale, 1.0)
    mix = mix / scale
    mix[np.abs(mix) < _SMALL] = 0.0
    return np.asarray(mix)


def _gain(vector: NDArray[np.float64], output: NDArray[np.float64], low: float, high: float) -> float:
    strong = np.abs(vector) >= _DESATURATION_MIN
    k = np.zeros(1)
    for bound, wrong in ((low, output < low), (high, output > high)):
        which = strong & wrong
        if which.any():
            k = np.concatenate([k, (bound - output[which]) / vector[which]])
    return float(k.min() + k.max())


def _desaturate(
    output: NDArray[np.float64], vector: NDArray[np.float64], *, reduce_only: bool = False, high: float = 1.0
) -> NDArray[np.float64]:
    gain = _gain(vector, output, 0.0, high)
    if reduce_only and gain < 0.0:
        return output
    output = output + gain * vector
    return np.asarray(output + 0.5 * _gain(vector, output, 0.0, high) * vector)


def allocate(mix: NDArray[np.float64], demand: NDArray[np.float64], geometry: Geometry) -> NDArray[np.float64]:
    """(m,) motor outputs 0..1 for a demand (6,)."""
    if not geometry.desaturate:
        return np.clip(mix @ demand, 0.0, 1.0)
    thrust, yaw = mix[:, THRUST_Z], mix[:, YAW]
    if geometry.airmode == 2:
        output = _desaturate(mix @ demand, thrust)
        return np.clip(_desaturate(output, yaw), 0.0, 1.0)
    without_yaw = demand.copy()
    without_yaw[YAW] = 0.0
    output = mix @ without_yaw
    if geometry.airmode == 1:
        output = _desaturate(output, thrust)
    else:
        # Thrust points down in z: "increase only" along this vector is less thrust.
        output = _desaturate(output, thrust, reduce_only=True)
        output = _desaturate(output, mix[:, ROLL])
        output = _desaturate(output, mix[:, PITCH])
    output = output + yaw * demand[YAW]
    output = _desaturate(output, yaw, high=1.0 + _YAW_MARGIN)
    output = _desaturate(output, thrust, reduce_only=True)
    return np.clip(output, 0.0, 1.0)
