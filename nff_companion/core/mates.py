"""Motors above each other: of thrust, roll and pitch they are one, and yaw alone tells which of the two has failed.

In forward flight the yaw torque of one motor is less than what the model may have wrong: what the rotors' side drag
does when one of them stops, and the ratio of torque to thrust. Then the answer is both of them, and what is done is
right for either: the two get the same command, and lift as much together as one of them alone. Pure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import GRAVITY_M_S2, PITCH, ROLL, YAW, Vehicle

HALF = 0.5  # of what the two give together is left


class Mates:
    """``of`` (m,): index of the motor above or below each; -1: there is none, or more than one."""

    def __init__(self, vehicle: Vehicle, tuning: Tuning) -> None:
        matrix = vehicle.acceleration_effectiveness
        columns = matrix[: PITCH + 1] / np.sqrt((matrix[: PITCH + 1] ** 2).mean(axis=1, keepdims=True))
        columns = columns / np.linalg.norm(columns, axis=0)
        alike = columns.T @ columns > tuning.decision.mates_alike
        np.fill_diagonal(alike, False)
        alone = alike.sum(axis=1) == 1
        self.of: tuple[int, ...] = tuple(np.where(alone, alike.argmax(axis=1), -1).tolist())
        self.any = max(self.of) >= 0
        inertia = vehicle.inertia_kg_m2
        self._yaw = np.abs(matrix[YAW])
        self._yaw_share = (inertia[:2] / inertia[2]) ** 2
        self._tuning = tuning

    def place(self, motors: tuple[int, ...]) -> tuple[int, ...]:
        """The two that ``motors`` (indices) may be taken for; empty: it is something else."""
        first = min((motors[0], self.of[motors[0]])) if motors else -1
        both = () if first < 0 else (first, self.of[first])
        return both if set(motors) <= set(both) else ()

    def told_apart(
        self,
        motor: int,
        thrust: NDArray[np.float64],
        residual: NDArray[np.float64],
        lateral_m_s2: float,
        doubtful: NDArray[np.float64],
    ) -> bool:
        """Whether yaw tells ``motor`` from its mate: what it turned, by ``thrust`` (m,), is more than what the model
        may have wrong. ``residual`` (n,); ``lateral_m_s2``: the drag; ``doubtful`` (n,) of what all motors turn."""
        o = self._tuning
        drag = o.disturbance.share_prior_deviation * lateral_m_s2 / GRAVITY_M_S2
        share = self._yaw_share * (o.onset.yaw_error_share**2 + drag**2)
        unknown = float(share.dot(residual[ROLL : PITCH + 1] ** 2)) + float(doubtful[YAW]) ** 2
        both = float(thrust[motor] * self._yaw[motor] + thrust[self.of[motor]] * self._yaw[self.of[motor]])
        return bool(both**2 > o.decision.mates_sure**2 * unknown)
