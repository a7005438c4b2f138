"""What the model does not expect and no motor explains: slow residual, and how noisy the residual usually is.

Neural-Fly's adaptation (Science Robotics 2022, equations 8, 9) with a constant basis, phi = I, at its steady gain: a
follows y at 1/tau, one value an axis (wind, drag, centre of mass, errors of mass and thrust). The spread around it
gives W.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nff_companion.vehicle import Vehicle

MEAN_S = 2.0  # time constant of a
_SPREAD_S = 4.0
_SPREAD_LIMIT = 3.0  # one sample counts at most this many deviations: a fault must not become usual
# Least deviation, as a share of what the loss of one motor at hover gives on that axis: errors of the model that
# scale with the thrusts (mass, inertia, lag) and never show while flying steadily. Thrust, roll, pitch, yaw.
_FLOOR_SHARE = np.array([0.30, 0.07, 0.07, 0.20])
_FLOOR = np.array([0.20, 0.35, 0.35, 0.10])  # sensors: m/s^2, rad/s^2
# The slow residual may not grow into the place of a lost motor: a vehicle already failed when we start shows.
_MEAN_SHARE_MAX = np.array([2.5, 0.40, 0.40, 1.5])
_CEILING_SHARE = np.array([1.0, 0.35, 0.35, 1.0])
CORRELATION_S = 0.025  # of the residual after its filters: samples closer than this are not independent


_SHARE_PRIOR, _SHARE_PRIOR_DEVIATION = 0.5, 0.35
_SHARE_DRIFT_PER_S = 2e-5  # variance


@dataclass(slots=True)
class SideDragState:
    """Share of the lateral drag that acts at the rotors, and its variance: a basis of one function of (x, u)."""

    share: float = _SHARE_PRIOR
    variance: float = _SHARE_PRIOR_DEVIATION**2


def learn_side_drag(state: SideDragState, slope: float, residual: float, variance: float, dt_s: float) -> SideDragState:
    """One Kalman step (Joseph form in one dimension) on the yaw residual.

    ``slope``: yaw acceleration for share 1 at the present thrusts; ``residual``: yaw residual left with the present
    share; ``variance`` of it in steady flight.
    """
    prior = state.variance + _SHARE_DRIFT_PER_S * dt_s
    noise = variance * CORRELATION_S / dt_s
    gain = prior * slope / (slope * slope * prior + noise)
    keep = 1.0 - gain * slope
    share = min(max(state.share + gain * residual, 0.0), 1.2)
    return SideDragState(share, min(keep * prior * keep + gain * noise * gain, _SHARE_PRIOR_DEVIATION**2))


@dataclass(slots=True)
class DisturbanceState:
    """a (n,) and the variance of y - a (n,)."""

    mean: np.ndarray
    variance: np.ndarray


class Disturbance:
    """Constants of one airframe."""

    def __init__(self, vehicle: Vehicle) -> None:
        loss = vehicle.acceleration_effectiveness * vehicle.hover
        self.loss_scale = np.sqrt((loss**2).mean(axis=1))
        self.floor = np.maximum(_FLOOR_SHARE * self.loss_scale, _FLOOR)
        self.ceiling = np.maximum(_CEILING_SHARE * self.loss_scale, self.floor)
        self._floor_squared, self._ceiling_squared = self.floor**2, self.ceiling**2
        self._mean_max = _MEAN_SHARE_MAX * self.loss_scale

    def start(self) -> DisturbanceState:
        """Nothing learnt."""
        return DisturbanceState(np.zeros_like(self.floor), self.floor**2)

    def variance(self, state: DisturbanceState) -> np.ndarray:
        """Variance (n,) of the residual in steady flight, between floor and ceiling."""
        return np.minimum(np.maximum(state.variance, self._floor_squared), self._ceiling_squared)

    def weight(self, state: DisturbanceState) -> np.ndarray:
        """Diagonal of W (n,): inverse of variance times correlation time, so that sums over time are in nats."""
        return 1.0 / (self.variance(state) * CORRELATION_S)

    def step(self, state: DisturbanceState, residual: np.ndarray, dt_s: float, rate: float = 1.0) -> DisturbanceState:
        """One sample of the raw residual y (n,); ``rate`` scales the speed of learning, 0: frozen."""
        if rate <= 0.0:
            return state
        around = residual - state.mean
        mean = state.mean + min(rate * dt_s / MEAN_S, 0.5) * around
        mean = np.minimum(np.maximum(mean, -self._mean_max), self._mean_max)
        spread = np.minimum(around**2, _SPREAD_LIMIT**2 * np.maximum(state.variance, self._floor_squared))
        variance = state.variance + min(rate * dt_s / _SPREAD_S, 0.5) * (spread - state.variance)
        return DisturbanceState(mean, variance)
