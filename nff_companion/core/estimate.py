"""What the estimator is given, remembers and hands out."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core import sparse
from nff_companion.core.balance import BalanceState
from nff_companion.core.curve import CurveState
from nff_companion.core.decision import DecisionState, Event
from nff_companion.core.disturbance import DisturbanceState, Expectation, SideDragState
from nff_companion.core.evidence import Evidence
from nff_companion.core.onset import OnsetState
from nff_companion.core.partial_loss import NOTHING, PartialLossState
from nff_companion.core.residual import ResidualState
from nff_companion.core.second_look import SecondLook
from nff_companion.core.slid_load import SlidLoadState
from nff_companion.core.weighing import Hypothesis


@dataclass(slots=True)
class EstimatorState:
    """Everything remembered between samples."""

    residual: ResidualState
    disturbance: DisturbanceState
    side_drag: SideDragState
    balance: BalanceState
    curve: CurveState
    information: sparse.Information
    onset: OnsetState
    steady: NDArray[np.float64]  # (m,) w, slow
    decision: DecisionState
    started_s: float
    fast_until_s: float  # the disturbance is learnt quickly
    begin_until_s: float  # after a take-off: what is off is off by the file, and no failure
    anew_until_s: float  # the same, after losses that nothing answered to
    quiet_since_s: float | None  # y has been small, in that time
    suspicious_since_s: float | None
    solved_s: float
    effectiveness: NDArray[np.float64]
    deviation: NDArray[np.float64]
    evidence: Evidence | None = None  # while a set of losses cannot be told apart
    second_look: SecondLook | None = None  # for a moment after a declaration
    slid_load: SlidLoadState | None = None  # while a loss is seen that may be none
    partial_loss: PartialLossState = NOTHING


@dataclass(slots=True)
class Estimate:
    """Result of one sample. Arrays (m,) unless said otherwise."""

    effectiveness: NDArray[np.float64]  # eta, 1: healthy; of declared motors what the data still say
    deviation: NDArray[np.float64]
    failed: NDArray[np.bool_]  # bool, latched
    raw: NDArray[np.float64]  # (n,) y by the file, without the motors declared, m/s^2 and rad/s^2
    residual: NDArray[np.float64]  # (n,) y - disturbance
    disturbance: NDArray[np.float64]  # (n,) phi a, and what the file says wrongly of lift and centre of mass
    features: NDArray[np.float64] | None  # (d,) that phi was fed with
    thrust_shown: NDArray[np.float64]  # w, thrust fractions as they show in y
    lateral_m_s2: NDArray[np.float64]  # (2,) specific force along x and y, smoothed
    best: Hypothesis | None
    events: list[Event]
    settled: bool = True  # what the file has wrong in steady flight has been learnt: what looks partly lost may be
    either: tuple[int, ...] = ()  # indices of two motors above each other, of which one has failed
    among: tuple[tuple[int, ...], ...] = ()  # sets of indices, of which one has failed: which is not known
    weak: tuple[int, ...] = ()  # index of the motor that has lost a part; of two above each other: one of them
    weak_left: float = 1.0  # effectiveness that it has left
    weak_shows: bool = False  # it does at this moment, and has not been learnt
    more: tuple[int, ...] = ()  # index of the motor that pulls more than asked; of two above each other: one of them
    balance: NDArray[np.float64] | None = None  # (n,) shares of core/balance.py; None: a peer that learns none
    gain: NDArray[np.float64] | None = None  # (n,) factors of the rows; None: the file's
    bend: float = 0.0  # of the thrust curve (core/curve.py)
    variance: NDArray[np.float64] | None = None  # (n,) of the residual in steady flight; None: a peer that has none


@dataclass(frozen=True, slots=True)
class Weighed:
    """What was made of the hypotheses: whether lost motors explain the last moments, the best such hypothesis, and the
    one that rotor speeds name; None: none, or it does not matter which. ``evidence`` while a set stands."""

    suspected: bool = False
    best: Hypothesis | None = None
    direct: Hypothesis | None = None
    evidence: Evidence | None = None
    refuted: bool = False  # the residual does not move with what explains it: no motor is lost
    alike: bool = False  # all motors give less by the same share: battery or load, and no motor is lost
    again: float = 0.0  # nats by which a motor that has lost a part gives more again


@dataclass(frozen=True, slots=True)
class Motion:
    """What the autopilot says of the vehicle's state: NED velocity (3,) m/s, body-to-NED quaternion (4,)."""

    velocity_m_s: NDArray[np.float64]
    quaternion: NDArray[np.float64]


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """One sample as the estimator takes it (a struct of msgspec: a frozen dataclass costs fifteen times as much)."""

    time_s: float
    dt_s: float  # since the sample before
    gyro: NDArray[np.float64]  # (3,) rad/s
    specific_force: NDArray[np.float64]  # (3,) m/s^2
    command: NDArray[np.float64]  # (m,) thrust fractions asked of the motors
    stopped: NDArray[np.bool_] | None = None  # (m,) bool: stand still by their rotor speeds
    motion: Motion | None = None  # None: not known, phi stays what it was
    allocation_norm: float = 0.0  # sigma(A) of the matrix in force; 0: none
    gains: NDArray[np.float64] | None = None  # (n,) how many times the file's its rows are; None: as the file says
    failed: NDArray[np.bool_] | None = None  # (m,) bool: declared; None: as the last step left it
    either: tuple[int, ...] = ()  # indices of two motors above each other, of which one is believed lost
    # (n,) s, actual - reference, where the law closes the loop; m/s, rad/s
    tracking_error: NDArray[np.float64] | None = None


@dataclass(slots=True)
class Seen:
    """What one sample shows, before anything is made of it."""

    filtered: ResidualState
    side_drag: NDArray[np.float64]  # (m,) yaw acceleration per thrust fraction
    effectiveness_matrix: NDArray[np.float64]  # (n, m) B0 and what of it the file has wrong
    thrust_left: NDArray[np.float64]  # (m,) w, without the motors declared
    lift_m_s2: float  # of it, as the file says
    unbalanced: NDArray[np.float64]  # (n,) what that turns and lifts beyond the file
    bent: NDArray[np.float64]  # (n,) g, what a thrust curve bent by 1 more would turn and lift; 0 while all work
    turned: NDArray[np.float64] | float  # (n,) what the motors' differences turn beyond the file
    balanced: NDArray[np.float64]  # (n,) y
    features: NDArray[np.float64] | None
    expectation: Expectation
    residual: NDArray[np.float64]  # (n,) y - phi a
    variance: NDArray[np.float64]  # (n,) of y - phi a in steady flight
    noise_weight: NDArray[np.float64]  # (n,) diagonal of W
