"""What the model does not expect and no motor explains: phi(x, u) a, and how noisy the residual usually is.

Without a network the basis is the constant 1: a follows y at 1/tau, one value an axis (wind, drag, centre of mass,
errors of mass and thrust). With one, phi a knows what forward flight does, and a what this vehicle and this wind do
differently. The spread around phi a gives W.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.adaptation import Adaptation, AdaptationState
from nff_companion.core.filters import lag_share
from nff_companion.core.tuning import DisturbanceTuning, Tuning
from nff_companion.core.vehicle import PITCH, ROLL, Vehicle


@dataclass(slots=True)
class SideDragState:
    """Share of the lateral drag that acts at the rotors, and its variance: a basis of one function of (x, u)."""

    share: float
    variance: float

    @staticmethod
    def start(tuning: DisturbanceTuning) -> SideDragState:
        """Before any of it was seen."""
        return SideDragState(share=tuning.share_prior, variance=tuning.share_prior_deviation**2)


def learn_side_drag(
    state: SideDragState, slope: float, residual: float, variance: float, dt_s: float, tuning: DisturbanceTuning
) -> SideDragState:
    """One Kalman step (Joseph form in one dimension) on the yaw residual.

    ``slope``: yaw acceleration for share 1 at the present thrusts; ``residual``: yaw residual left with the present
    share; ``variance`` of it in steady flight.
    """
    prior = state.variance + tuning.share_drift_per_s * dt_s
    noise = variance * tuning.correlation_s / dt_s
    gain = prior * slope / (slope * slope * prior + noise)
    keep = 1.0 - gain * slope
    return SideDragState(
        share=min(max(state.share + gain * residual, 0.0), tuning.share_max),
        variance=min(keep * prior * keep + gain * noise * gain, tuning.share_prior_deviation**2),
    )


class Basis(Protocol):
    """A basis network, as far as it matters here (basis_network.py)."""

    @property
    def axis_scale(self) -> NDArray[np.float64]:
        """(n,) SI."""

    @property
    def prior(self) -> NDArray[np.float64]:
        """a0 (k + 1, n)."""

    def __call__(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """phi (k + 1,)."""

    def project(self, a: NDArray[np.float64], vehicle: Vehicle, allocation_norm: float) -> NDArray[np.float64]:
        """a within (6.8)."""


@dataclass(slots=True)
class DisturbanceState:
    """The adaptation, the last phi (k + 1,), and the variance of y - phi a (n,)."""

    adaptation: AdaptationState
    basis: NDArray[np.float64]
    variance: NDArray[np.float64]


@dataclass(slots=True)
class Expectation:
    """phi a at one sample, SI: as far as it is believed (n,), and as it was learnt (n,); with its phi (k + 1,).

    ``excess`` (n,): what of it is beyond belief. Exactly 0 within, where learnt - believed is a rounding error whose
    sign is the machine's.
    """

    basis: NDArray[np.float64]
    believed: NDArray[np.float64]
    learnt: NDArray[np.float64]
    excess: NDArray[np.float64]


class Disturbance:
    """Constants of one airframe; ``network`` None: a constant basis; ``bounded`` False: phi a may explain everything,
    where no motor is looked for."""

    def __init__(
        self,
        vehicle: Vehicle,
        network: Basis | None = None,
        tuning: Tuning | None = None,
        *,
        bounded: bool = True,
    ) -> None:
        whole = tuning or Tuning()
        o = self._tuning = whole.disturbance
        self._step_max_s = whole.adaptation.step_max_s
        loss = vehicle.acceleration_effectiveness * vehicle.hover
        self.loss_scale = np.sqrt((loss**2).mean(axis=1))
        self.floor = np.maximum(np.array(o.floor_share) * self.loss_scale, o.floor)
        self.ceiling = np.maximum(np.array(o.ceiling_share) * self.loss_scale, self.floor)
        self._floor_squared, self._ceiling_squared = self.floor**2, self.ceiling**2
        self._adapted_max = (np.array(o.mean_share_max) if bounded else np.inf) * self.loss_scale
        self._adapted_min = -self._adapted_max
        self._vehicle, self.network = vehicle, network
        constant = np.zeros((1, vehicle.axes))
        self._scale = np.ones(vehicle.axes) if network is None else network.axis_scale
        self._adaptation = Adaptation(constant if network is None else network.prior, whole.adaptation)
        # Torques turn, and a is in accelerations over the axes' scale: sqrt(J_y s_y / (J_x s_x)).
        jx, jy = (vehicle.inertia_kg_m2[:2] * self._scale[[ROLL, PITCH]]).tolist()
        self._across = math.sqrt(jy / jx)
        self._steady: tuple[float, float] = tuple(self._adaptation.prior[-1, [ROLL, PITCH]].tolist())
        # Until the network is given what it looks at, the constant stands alone.
        self._blind = np.eye(len(self._adaptation.prior))[-1]

    def start(self) -> DisturbanceState:
        """Nothing learnt in this flight."""
        return DisturbanceState(adaptation=self._adaptation.start(), basis=self._blind, variance=self.floor**2)

    def variance(self, state: DisturbanceState) -> NDArray[np.float64]:
        """Variance (n,) of the residual in steady flight, between floor and ceiling."""
        return np.minimum(np.maximum(state.variance, self._floor_squared), self._ceiling_squared)

    def basis(self, state: DisturbanceState, features: NDArray[np.float64] | None, dt_s: float) -> NDArray[np.float64]:
        """phi (k + 1,); without ``features`` the last one fades: what it said of the speed grows old, and a jump to the
        constant would look like a failure."""
        if self.network is None:
            return state.basis
        if features is None:
            return state.basis + lag_share(dt_s, self._tuning.stale_s) * (self._blind - state.basis)
        return self.network(features)

    def expect(self, state: DisturbanceState, basis: NDArray[np.float64]) -> Expectation:
        """phi a; what was learnt in this flight, beyond a0, may not grow into the place of a motor."""
        known = self._scale * basis.dot(self._adaptation.prior)
        learnt = self._scale * basis.dot(state.adaptation.a)
        beyond = learnt - known
        within = np.minimum(np.maximum(beyond, self._adapted_min), self._adapted_max)
        return Expectation(basis=basis, believed=known + within, learnt=learnt, excess=beyond - within)

    def predict(self, state: DisturbanceState, basis: NDArray[np.float64]) -> NDArray[np.float64]:
        """phi a (n,) in SI, as far as it is believed."""
        return self.expect(state, basis).believed

    def step(
        self,
        state: DisturbanceState,
        basis: NDArray[np.float64],
        residual: NDArray[np.float64],
        dt_s: float,
        rate: float = 1.0,
        allocation_norm: float = 0.0,
    ) -> DisturbanceState:
        """``expect`` and ``learn`` of one sample."""
        return self.learn(state, self.expect(state, basis), residual, dt_s, rate, allocation_norm)

    def learn(
        self,
        state: DisturbanceState,
        expectation: Expectation,
        residual: NDArray[np.float64],
        dt_s: float,
        rate: float = 1.0,
        allocation_norm: float = 0.0,
        tracking_error: NDArray[np.float64] | None = None,
        turned_rad: float = 0.0,
    ) -> DisturbanceState:
        """One sample of the raw residual y (n,), of which ``expectation`` was expected in ``state``; ``rate`` scales
        the speed of learning, 0: frozen; ``allocation_norm`` is that of the matrix in force, for (6.8);
        ``tracking_error`` s (n,) in m/s and rad/s, of the composite law."""
        o, adaptation, variance = self._tuning, state.adaptation, state.variance
        if rate > 0.0:
            step_s = min(rate * dt_s, self._step_max_s)
            adaptation = self._adapted(adaptation, expectation, residual, step_s, tracking_error)
            around = residual - expectation.believed
            most = o.spread_limit**2 * np.maximum(variance, self._floor_squared)
            share = min(rate * dt_s / o.spread_s, o.spread_step_max)
            variance = variance + share * (np.minimum(around * around, most) - variance)
        if turned_rad:
            adaptation = self._turned(adaptation, turned_rad)
        adaptation = self._projected(adaptation, allocation_norm)
        return DisturbanceState(adaptation=adaptation, basis=expectation.basis, variance=variance)

    def _adapted(
        self,
        state: AdaptationState,
        expectation: Expectation,
        residual: NDArray[np.float64],
        dt_s: float,
        tracking_error: NDArray[np.float64] | None,
    ) -> AdaptationState:
        """One step of a. At the limit of what may be learnt y is taken for what is learnt already, so that a does not
        wind up."""
        innovation = residual - expectation.learnt
        held = innovation * expectation.excess > 0.0
        seen = np.where(held, expectation.learnt, residual) if True in held.tolist() else residual
        error = None if tracking_error is None else tracking_error / self._scale
        return self._adaptation.step(state, expectation.basis, seen / self._scale, dt_s, error)

    def _turned(self, state: AdaptationState, turned_rad: float) -> AdaptationState:
        """What is steady in roll and pitch, beyond a0, is the wind's, which does not turn with the vehicle."""
        roll0, pitch0 = self._steady
        cosine, sine = math.cos(turned_rad), math.sin(turned_rad)
        a = state.a.copy()
        roll, pitch = (a[-1, ROLL] - roll0) / self._across, (a[-1, PITCH] - pitch0) * self._across
        a[-1, ROLL] = roll0 + self._across * (cosine * roll + sine * pitch)
        a[-1, PITCH] = pitch0 + (cosine * pitch - sine * roll) / self._across
        return AdaptationState(a=a, covariance=state.covariance)

    def _projected(self, state: AdaptationState, allocation_norm: float) -> AdaptationState:
        """Within (6.8), whose bound moves with the allocation in force."""
        if self.network is None or not allocation_norm:
            return state
        a = self.network.project(state.a, self._vehicle, allocation_norm)
        return state if a is state.a else AdaptationState(a=a, covariance=state.covariance)
