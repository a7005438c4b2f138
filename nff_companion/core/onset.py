"""Sudden losses: sums over windows that begin at each possible onset, weighted by how a loss would show.

A motor that stops at t0 loses its thrust by its lag, and the residual shows it through the filters. With
g(t - t0) that response, y = B0 diag(w) g(t - t0) e for t > t0: a matched filter for the final loss e, which needs
not wait until the rotor has stopped. All onsets are evaluated at once: a likelihood ratio over onset and motors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.filters import LowPass, loss_response
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import PITCH, ROLL, YAW, Vehicle


@dataclass(slots=True)
class OnsetState:
    """The last L samples, in a ring written twice: rows ``next`` and ``next + L`` are the same sample, so that any L
    rows that follow each other are a window. The arrays change in place."""

    thrust_shown: NDArray[np.float64]  # (2 L, m) w
    steady: NDArray[np.float64]  # (2 L, m) slow part of w
    residual: NDArray[np.float64]  # (2 L, n) y
    effectiveness_matrix: NDArray[np.float64]  # (2 L, n, m) B0 of that moment
    next: int = 0


@dataclass(frozen=True, slots=True)
class OnsetSums:
    """Statistics of each window: S (K, m, m), q (K, m), energy (K,), and its age (K,) in s; ``more``, ``more_square``
    (K, m): q and the diagonal of S for a motor that pulls by a part of its full thrust more than it is asked to."""

    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]
    energy: NDArray[np.float64]
    age_s: NDArray[np.float64]
    more: NDArray[np.float64] | None = None
    more_square: NDArray[np.float64] | None = None


class OnsetBank:
    """Constants for one airframe (n axes, m motors) and sample time."""

    def __init__(
        self, vehicle: Vehicle, dt_s: float, low_pass: LowPass | None, tuning: Tuning, *, joint: float = 0.0
    ) -> None:
        """``joint``: 0, y - phi a is taken as it is; else phi a may be off by so many deviations of the residual, and
        is estimated together with the losses."""
        o = self._tuning = tuning.onset
        counts = sorted({max(round(age / dt_s), 2) for age in o.ages_s})
        self._axes, self._motors, self._joint = vehicle.axes, vehicle.motors, joint
        self.length, self._dt = counts[-1], dt_s
        standing = [max(round(age / dt_s), 2) for age in o.standing_s]
        (_, lag_s), smoothing_s = vehicle.lag_s, tuning.residual.smoothing_s
        response = loss_response(dt_s, self.length, lag_s, low_pass, smoothing_s)
        rows = len(counts) + len(standing)
        self._response = np.zeros((rows, self.length))
        self._inside = np.zeros((rows, self.length))
        for row, count in enumerate(counts):
            self._response[row, self.length - count :] = response[:count]
            self._inside[row, self.length - count :] = 1.0
        for row, count in enumerate(standing, start=len(counts)):
            self._response[row, self.length - count :] = 1.0
            self._inside[row, self.length - count :] = 1.0
        self._squared = self._response**2
        self._response_square = self._squared.sum(axis=1)
        self._counts = np.array(counts + standing)
        self._mean = self._inside / self._counts[:, None]
        self.age_s = self._counts * dt_s
        self._correlation_s = tuning.disturbance.correlation_s
        self._error = o.model_error_share**2 * np.eye(self._axes)
        inertia = vehicle.inertia_kg_m2
        self._together_squared = np.array(o.together_error_share) ** 2
        self._yaw_share = (inertia[:2] / inertia[2]) ** 2

    def start(self) -> OnsetState:
        """Empty history."""
        rows, n, m = 2 * self.length, self._axes, self._motors
        return OnsetState(
            thrust_shown=np.zeros((rows, m)),
            steady=np.zeros((rows, m)),
            residual=np.zeros((rows, n)),
            effectiveness_matrix=np.zeros((rows, n, m)),
        )

    def push(
        self,
        state: OnsetState,
        thrust_shown: NDArray[np.float64],
        residual: NDArray[np.float64],
        effectiveness_matrix: NDArray[np.float64],
        steady: NDArray[np.float64],
    ) -> OnsetState:
        """Keep one sample: w (m,), y (n,), B0 (n, m) in accelerations and the slow part (m,) of w. What they amount to
        is computed when it is asked for: most flights never ask."""
        first = state.next
        second = first + self.length
        state.thrust_shown[first] = state.thrust_shown[second] = thrust_shown
        state.steady[first] = state.steady[second] = steady
        state.residual[first] = state.residual[second] = residual
        state.effectiveness_matrix[first] = state.effectiveness_matrix[second] = effectiveness_matrix
        state.next = (first + 1) % self.length
        return state

    def worked(self, state: OnsetState) -> NDArray[np.float64]:
        """Mean of w (m,) over as much of the memory as there is."""
        w = state.thrust_shown[state.next : state.next + self.length]
        return np.asarray(np.add.reduce(w, axis=0) / max(int(np.count_nonzero(w.any(axis=1))), 1))

    def sums(
        self,
        state: OnsetState,
        effectiveness_matrix: NDArray[np.float64],
        variance: NDArray[np.float64],
        yaw_error: float,
    ) -> OnsetSums:
        """Statistics of all windows; ``effectiveness_matrix`` (n, m) in accelerations, ``variance`` (n,) of y in steady
        flight; ``yaw_error``: yaw torque not modelled, as a share of roll and pitch torque."""
        n, m, b = self._axes, self._motors, effectiveness_matrix
        last = slice(state.next, state.next + self.length)
        w, y = state.thrust_shown[last], state.residual[last]
        squared = y * y
        total = self._total_variance(state, last, squared, variance, yaw_error)
        noise_weight = self._dt / (self._correlation_s * total)  # (n,)
        weighted = b * noise_weight[:, None]
        outer = self._squared.dot((w[:, :, None] * w[:, None, :]).reshape(-1, m * m))  # (K, m m)
        product = self._response.dot((y[:, :, None] * w[:, None, :]).reshape(-1, n * m))  # (K, n m)
        matrix = (outer * weighted.T.dot(b).ravel()).reshape(-1, m, m)
        vector = np.add.reduce((product * weighted.ravel()).reshape(-1, n, m), axis=1)
        more = self._response.dot(y).dot(weighted)
        more_square = self._response_square[:, None] * np.add.reduce(weighted * b, axis=0)
        energy = self._inside.dot(squared.dot(noise_weight))
        sums = OnsetSums(matrix, vector, energy, self.age_s, more, more_square)
        return self._marginal(sums, w, y, b, noise_weight, variance) if self._joint else sums

    def _total_variance(
        self,
        state: OnsetState,
        last: slice,
        squared: NDArray[np.float64],
        variance: NDArray[np.float64],
        yaw_error: float,
    ) -> NDArray[np.float64]:
        """Variance (n,) of y by noise and by errors of the model. One for all windows: their improvements are then
        likelihoods of the same data. ``squared`` (L, n) y^2."""
        o, error = self._tuning, self._error.copy()
        error[YAW, ROLL : PITCH + 1] = self._yaw_share * (o.yaw_error_share**2 + yaw_error**2)
        unsteady = state.thrust_shown[last] - state.steady[last]
        beyond = state.effectiveness_matrix[last] * unsteady[:, None, :]
        together, single = np.add.reduce(beyond, axis=2), np.add.reduce(beyond * beyond, axis=2)
        doubtful = self._together_squared * together * together + o.single_error_share**2 * single
        level, doubt = (np.maximum.reduce(self._mean.dot(part), axis=0) for part in (squared, doubtful))
        return np.asarray(variance + error.dot(level) + doubt)

    def _marginal(
        self,
        sums: OnsetSums,
        thrust_shown: NDArray[np.float64],
        residual: NDArray[np.float64],
        effectiveness_matrix: NDArray[np.float64],
        noise_weight: NDArray[np.float64],
        variance: NDArray[np.float64],
    ) -> OnsetSums:
        """phi a may be wrong by a constant in the window, of the residual's own variance: integrated out."""
        shift = self._joint**2 * variance
        share = noise_weight * shift * noise_weight / (1.0 + self._counts[:, None] * noise_weight * shift)  # (K, n)
        moment = effectiveness_matrix * self._response.dot(thrust_shown)[:, None, :]  # (K, n, m)
        total = self._inside.dot(residual)  # (K, n)
        return OnsetSums(
            sums.matrix - np.einsum("ka,kai,kaj->kij", share, moment, moment),
            sums.vector - np.einsum("ka,kai,ka->ki", share, moment, total),
            sums.energy - (share * total * total).sum(axis=1),
            sums.age_s,
        )
