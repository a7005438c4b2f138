"""What the estimator is given, remembers and hands out."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from nff_companion.core import sparse
from nff_companion.core.decision import DecisionState, Event, Hypothesis
from nff_companion.core.disturbance import DisturbanceState, Expectation, SideDragState
from nff_companion.core.onset import OnsetState
from nff_companion.core.residual import ResidualState


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
    thrust_shown: np.ndarray  # w, thrust fractions as they show in y
    lateral_m_s2: np.ndarray  # (2,) specific force along x and y, smoothed
    best: Hypothesis | None
    events: list[Event]


@dataclass(frozen=True, slots=True)
class Motion:
    """What the autopilot says of the vehicle's state: NED velocity (3,) m/s, body-to-NED quaternion (4,)."""

    velocity_m_s: np.ndarray
    quaternion: np.ndarray


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """One sample as the estimator takes it (a struct of msgspec: a frozen dataclass costs fifteen times as much)."""

    time_s: float
    dt_s: float  # since the sample before
    gyro: np.ndarray  # (3,) rad/s
    specific_force: np.ndarray  # (3,) m/s^2
    command: np.ndarray  # (m,) thrust fractions asked of the motors
    stopped: np.ndarray | None = None  # (m,) bool: stand still by their rotor speeds
    motion: Motion | None = None  # None: not known, phi stays what it was
    allocation_norm: float = 0.0  # sigma(A) of the matrix in force; 0: none
    failed: np.ndarray | None = None  # (m,) bool: declared; None: as the last step left it
    tracking_error: np.ndarray | None = None  # (n,) s, actual - reference, where the law closes the loop; m/s, rad/s


@dataclass(slots=True)
class Seen:
    """What one sample shows, before anything is made of it."""

    filtered: ResidualState
    side_drag: np.ndarray  # (m,) yaw acceleration per thrust fraction
    effectiveness_matrix: np.ndarray  # B0 (n, m)
    thrust_left: np.ndarray  # (m,) w, without the motors declared
    raw: np.ndarray  # (n,) y
    features: np.ndarray | None
    expectation: Expectation
    residual: np.ndarray  # (n,) y - phi a
    noise_weight: np.ndarray  # (n,) diagonal of W
