"""One step of estimation: telemetry in; residual, sparse effectiveness and decisions out. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from nff_companion.core import hypotheses, sparse
from nff_companion.core.adaptation import AdaptationOptions
from nff_companion.core.decision import Decision, DecisionOptions, DecisionState, Event, Hypothesis
from nff_companion.core.disturbance import (
    CORRELATION_S,
    Basis,
    Disturbance,
    DisturbanceState,
    SideDragState,
    learn_side_drag,
)
from nff_companion.core.features import features
from nff_companion.core.filters import lag_share
from nff_companion.core.onset import OnsetBank, OnsetState
from nff_companion.core.residual import ResidualFilter, ResidualState
from nff_companion.core.vehicle import GRAVITY_M_S2, YAW, Vehicle
from nff_companion.errors import SolverError

_SUSPICIOUS = 3.0  # deviations of the residual on one axis from which hypotheses are compared
_LEARN_FAST_S = 1.0  # after the start of a flight the disturbance is learnt quickly
_LEARN_FAST_RATE = 6.0
_FREEZE_MAX_S = 1.0
# What a few motors explain this well is theirs, and not learnt for longer, although they may not be told apart yet.
_SURE_EXPLAINED, _FREEZE_SURE_S = 0.9, 8.0
_STEADY_S = 0.4  # what the motors do for longer than this is steady flight
_CLEAR_LOSS, _FEW = 0.12, 2  # a loss that counts as one, and of how many motors at most: more is a disturbance


class EstimatorOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tuning of the estimator; one set for all airframes (losses and noises are scaled by the airframe)."""

    forgetting_per_s: float = 8.0  # w_f of the sparse estimate
    gamma: float = 20.0  # l1 weight, nats
    solve_interval_s: float = 0.01  # of the sparse program; its sums take every sample
    gamma_onset: float = 1.0
    identify: bool = True  # False: no loss is looked for, total or partial
    network: str = "airframe"  # basis: what the airframe file names; none; a shipped name or a path to an .npz file
    joint: float = 0.0  # 0: phi a first, then losses; else together, phi a off by so many deviations (docs/learning.md)
    adaptation: AdaptationOptions = AdaptationOptions()
    decision: DecisionOptions = DecisionOptions()


@dataclass(slots=True)
class EstimatorState:
    """Everything remembered between samples."""

    residual: ResidualState
    disturbance: DisturbanceState
    side_drag: SideDragState
    information: sparse.Information
    onset: OnsetState
    steady: np.ndarray  # (m,) w, slow
    decision: DecisionState
    started_s: float
    suspicious_since_s: float | None
    solved_s: float
    effectiveness: np.ndarray
    deviation: np.ndarray


@dataclass(slots=True)
class Estimate:
    """Result of one sample. Arrays (m,) unless said otherwise."""

    effectiveness: np.ndarray  # eta, 1: healthy; of declared motors what the data still say
    deviation: np.ndarray
    failed: np.ndarray  # bool, latched
    raw: np.ndarray  # (n,) y, without the motors declared, m/s^2 and rad/s^2
    residual: np.ndarray  # (n,) y - phi a
    disturbance: np.ndarray  # (n,) phi a
    features: np.ndarray | None  # (d,) that phi was fed with
    weight: np.ndarray  # w, thrust fractions as they show in y
    push: np.ndarray  # (2,) specific force along x and y, m/s^2
    best: Hypothesis | None
    events: list[Event]


@dataclass(frozen=True, slots=True)
class Motion:
    """What the autopilot says of the vehicle's state: NED velocity (3,) m/s, body-to-NED quaternion (4,)."""

    velocity_m_s: np.ndarray
    quaternion: np.ndarray


class Estimator:
    """Constants of one airframe and sample time; ``network`` None: a constant basis."""

    def __init__(self, vehicle: Vehicle, dt_s: float, options: EstimatorOptions, network: Basis | None = None) -> None:
        self.vehicle, self.dt_s, self.options, self.network = vehicle, dt_s, options, network
        self._filter = ResidualFilter(vehicle, dt_s)
        self._disturbance = Disturbance(vehicle, network, options.adaptation, bounded=options.identify)
        self._onset = OnsetBank(
            vehicle.axes,
            vehicle.motors,
            vehicle.inertia_kg_m2,
            dt_s,
            vehicle.motor.time_constant_down_s,
            self._filter.low_pass,
            options.joint,
        )
        self._steady = lag_share(dt_s, _STEADY_S)
        self._decision = Decision(vehicle.motors, vehicle.axes, options.decision)

    def start(
        self,
        time_s: float,
        gyro: np.ndarray,
        specific_force: np.ndarray,
        command: np.ndarray,
        failed: np.ndarray | None = None,
    ) -> EstimatorState:
        """State at the first sample of a flight; ``failed`` (m,) bool are declarations taken over."""
        m = self.vehicle.motors
        decision = DecisionState.start(m)
        if failed is not None:
            decision.failed = failed.copy()
        return EstimatorState(
            residual=self._filter.start(gyro, specific_force, command),
            disturbance=self._disturbance.start(),
            side_drag=SideDragState(),
            information=sparse.Information.empty(m),
            onset=self._onset.start(),
            steady=command.copy(),
            decision=decision,
            started_s=time_s,
            suspicious_since_s=None,
            solved_s=-np.inf,
            effectiveness=np.ones(m),
            deviation=np.ones(m),
        )

    def step(
        self,
        state: EstimatorState,
        time_s: float,
        gyro: np.ndarray,
        specific_force: np.ndarray,
        command: np.ndarray,
        dt_s: float,
        stopped: np.ndarray | None = None,
        motion: Motion | None = None,
        allocation_norm: float = 0.0,
    ) -> tuple[EstimatorState, Estimate]:
        """One sample; ``command`` (m,) thrust fractions asked of the motors, ``stopped`` (m,) bool those that stand
        still by their rotor speeds; ``motion`` None: not known, phi stays what it was. Raises SolverError."""
        o = self.options
        filtered = self._filter.step(state.residual, gyro, specific_force, command, dt_s)
        side_drag = self._filter.side_drag(filtered)
        matrix = self._filter.effectiveness(side_drag, state.side_drag.share)
        decision = state.decision
        nominal = filtered.weight if not decision.failed.any() else np.where(decision.failed, 0.0, filtered.weight)
        commanded = matrix @ nominal
        raw = filtered.measured - commanded
        seen = None
        if motion is not None:
            seen = features(motion.velocity_m_s, motion.quaternion, filtered.push, filtered.rate, commanded)
        basis = self._disturbance.basis(state.disturbance, seen, dt_s)
        expected = self._disturbance.predict(state.disturbance, basis)
        residual = raw - expected
        if not math.isfinite(float(residual.sum())):
            raise SolverError(f"residual {residual} is not finite; the estimate starts anew")
        weight = self._disturbance.weight(state.disturbance)

        regressor = matrix * filtered.weight
        information = sparse.update(state.information, regressor, residual, weight, dt_s, o.forgetting_per_s)
        steady = state.steady + self._steady * (filtered.weight - state.steady)
        onset = self._onset.push(state.onset, filtered.weight, residual, matrix, steady)
        best = direct = None
        hint = () if stopped is None else tuple(int(i) for i in np.flatnonzero(stopped & ~decision.failed))
        if o.identify and (hint or float((residual * residual * weight).max()) * CORRELATION_S > _SUSPICIOUS**2):
            lateral = float(np.hypot(filtered.lateral[0], filtered.lateral[1]))
            yaw_error = state.side_drag.variance**0.5 * lateral / GRAVITY_M_S2
            sums = self._onset.sums(onset, matrix, self._disturbance.variance(state.disturbance), yaw_error)
            best = self._decision.best(sums, decision.failed, o.gamma_onset)
            if 1 <= len(hint) <= 2:
                direct = self._decision.direct(sums, decision.failed, hint, o.gamma_onset)
        suspicious_since = (time_s if state.suspicious_since_s is None else state.suspicious_since_s) if best else None
        solved_s, effectiveness, deviation = state.solved_s, state.effectiveness, state.deviation
        if o.identify and time_s - solved_s >= o.solve_interval_s - 1e-9:
            solved_s = time_s
            effectiveness, deviation = self._effectiveness(information, decision.failed)
        events: list[Event] = []
        if o.identify:
            decision, events = self._decision.step(decision, time_s, best, effectiveness, deviation, command, direct)
        if any(event.declared for event in events):
            # What is left of the old residual belongs to the motors just declared; a new failure starts afresh.
            information, onset = sparse.Information.empty(len(command)), self._onset.start()
        sure = best is not None and best.explained > _SURE_EXPLAINED
        rate = self._learning_rate(time_s, state.started_s, suspicious_since, sure)
        explained = self._explained(effectiveness, decision.failed) if o.identify else None
        rest = raw if explained is None else raw - matrix @ (filtered.weight * explained)
        disturbance = self._disturbance.step(state.disturbance, basis, rest, dt_s, rate, allocation_norm)
        learnt = state.side_drag
        if rate == 1.0:
            learnt = learn_side_drag(
                learnt, float(side_drag @ nominal), float(residual[YAW]), float(disturbance.variance[YAW]), dt_s
            )
        new = EstimatorState(
            filtered,
            disturbance,
            learnt,
            information,
            onset,
            steady,
            decision,
            state.started_s,
            suspicious_since,
            solved_s,
            effectiveness,
            deviation,
        )
        return new, Estimate(
            effectiveness,
            deviation,
            decision.failed,
            raw,
            residual,
            expected,
            seen,
            filtered.weight,
            filtered.lateral,
            best,
            events,
        )

    def _effectiveness(self, information: sparse.Information, failed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """eta and deviation (m,); motors already declared have a free coefficient instead of a loss."""
        if not failed.any():
            return 1.0 + sparse.solve(information, self.options.gamma), sparse.deviation(information)
        nuisance = np.flatnonzero(failed)
        matrix, vector, energy, free = hypotheses.without_nuisance(
            information.matrix[None], information.vector[None], np.array([information.energy]), nuisance
        )
        rest = sparse.Information(matrix[0], vector[0], float(energy[0]))
        eta = 1.0 + sparse.solve(rest, self.options.gamma)
        eta[nuisance] = np.clip(free[0], 0.0, 1.2)
        return eta, sparse.deviation(information)

    @staticmethod
    def _explained(effectiveness: np.ndarray, failed: np.ndarray) -> np.ndarray | None:
        """Share (m,) of each motor's thrust that the motors explain, so that the disturbance does not learn it
        too: the loss of a few, and what declared motors still give. None: nothing."""
        loss = effectiveness - 1.0
        low = (loss < -_CLEAR_LOSS) & ~failed
        few = 0 < int(low.sum()) <= _FEW
        if not few and not failed.any():
            return None
        return np.where(failed, effectiveness, np.where(low & few, loss, 0.0))

    @staticmethod
    def _learning_rate(time_s: float, started_s: float, suspicious_since_s: float | None, sure: bool) -> float:
        """Speed of learning phi a: fast after the start, frozen while a failure is being weighed."""
        if suspicious_since_s is not None:
            longest = _FREEZE_SURE_S if sure else _FREEZE_MAX_S
            return 0.0 if time_s - suspicious_since_s < longest else 0.3
        return _LEARN_FAST_RATE if time_s - started_s < _LEARN_FAST_S else 1.0
