"""A test of which motors are lost: outputs moved so that a whole vehicle would feel nothing of it.

Of sets of motors that explain the residual alike, each says something else of what a movement v of the motors in the
null space of B does: -B diag(loss) v. The movement is the one that tells the sets apart best for what it tilts,
whichever of them is true; it goes forth, back, back and forth, after which rate and attitude are what they were. It is
as large as a stated certainty asks for, and no larger than tilt, thrust and what the motors have left allow.
"""

from __future__ import annotations

import math
from itertools import combinations

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.condition import read_only
from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import PITCH, ROLL, Vehicle

_PATTERN = (1.0, -1.0, -1.0, 1.0)
_NULL = 1e-9  # singular values below it, over the largest, are nought
_ROUNDS = 8  # of weighing the pair of sets that is told apart worst more


class ProbeState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``move`` (m,) thrust fractions, read-only, of the test that runs, None: none does; ``sign`` with which it is in
    force now; ``tests`` in a row; ``next_s``: no sooner. Times of the autopilot's clock."""

    move: NDArray[np.float64] | None = None
    sign: float = 0.0
    begun_s: float = -math.inf
    next_s: float = -math.inf
    tests: int = 0

    def ended(self, next_s: float) -> ProbeState:
        """Without the test that runs, and none before ``next_s``."""
        return replace(self, move=None, sign=0.0, next_s=next_s)


class Prober:
    """Constants of one vehicle."""

    def __init__(self, vehicle: Vehicle, tuning: Tuning) -> None:
        self._tuning, self._correlation_s = tuning.probe, tuning.disturbance.correlation_s
        self._matrix = vehicle.acceleration_effectiveness
        self._turned, self._square = _response(vehicle.lag_s[0], tuning.probe.part_s)

    def step(
        self,
        state: ProbeState,
        time_s: float,
        estimate: Estimate,
        effectiveness: NDArray[np.float64],
        *,
        asked: bool = True,
    ) -> ProbeState:
        """One sample; ``effectiveness`` (m,) that is allocated for, without what is being asked. ``asked`` False: none
        is made, and the one that runs ends."""
        o = self._tuning
        variance = estimate.variance if estimate.among and asked else None
        if state.move is not None:
            part = int((time_s - state.begun_s) / o.part_s + 1e-9)
            if variance is not None and 0 <= part < len(_PATTERN):
                sign = _PATTERN[part]
                return state if sign == state.sign else replace(state, sign=sign)
            state = state.ended(time_s + o.rest_s if state.tests >= o.tests_max else time_s)
        if variance is None or time_s < state.next_s:
            return state
        losses = _losses(estimate, len(effectiveness))
        move = self.movement(losses, estimate.thrust_shown, variance, effectiveness)
        if move is None:
            return state.ended(time_s + len(_PATTERN) * o.part_s)
        in_a_row = state.tests < o.tests_max and time_s - state.begun_s < o.rest_s
        tests = state.tests + 1 if in_a_row else 1
        return ProbeState(move=read_only(move), sign=_PATTERN[0], begun_s=time_s, tests=tests)

    def refused(self, state: ProbeState, time_s: float) -> ProbeState:
        """A test that cannot be made as it should be is not made again soon."""
        return state.ended(time_s + self._tuning.rest_s)

    def movement(
        self,
        losses: list[NDArray[np.float64]],
        thrust: NDArray[np.float64],
        variance: NDArray[np.float64],
        effectiveness: NDArray[np.float64],
    ) -> NDArray[np.float64] | None:
        """Movement (m,) of thrust fractions that tells ``losses`` (m,) each apart, from ``thrust`` (m,) of now on; None
        where none does. ``variance`` (n,) of the residual; ``effectiveness`` (m,) with which the motors are mixed."""
        o = self._tuning
        matrix = self._matrix * effectiveness
        free = _null_space(matrix, effectiveness > 0.0)
        if free.shape[1] == 0 or o.thrust_max <= 0.0 or len(losses) < 2:
            return None
        felt = [(matrix * loss).dot(free) for loss in losses]  # (n, f) of each: minus what it does
        weight = len(_PATTERN) * o.part_s * self._square / (self._correlation_s * variance)
        apart = [(a - b).T.dot((a - b) * weight[:, None]) for a, b in combinations(felt, 2)]
        tilt = [self._turned * o.part_s**2 * effect[ROLL : PITCH + 1] for effect in felt]
        most_rad = math.radians(o.tilt_max_deg)
        cost = sum((t.T.dot(t) for t in tilt), np.zeros((free.shape[1],) * 2)) / most_rad**2
        cost += np.eye(free.shape[1]) / o.thrust_max**2
        z = _telling(apart, cost)
        v = free.dot(z)
        sure = math.sqrt(max(min(float(z.dot(part).dot(z)) for part in apart), 0.0))
        if sure <= 0.0:
            return None
        tilted, largest = max(float(np.linalg.norm(t.dot(z))) for t in tilt), np.abs(v)
        room = np.maximum(np.minimum(thrust, 1.0 - thrust) - o.thrust_left, 0.0)
        moved = largest > 1e-6 * largest.max()
        size = min(
            o.deviations / sure,
            most_rad / max(tilted, 1e-12),
            o.thrust_max / float(largest.max()),
            float((room[moved] / largest[moved]).min()),
        )
        return None if size * sure < o.deviations_min else np.asarray(size * v)


def _response(lag_s: float, part_s: float) -> tuple[float, float]:
    """Of a vehicle whose motors follow with the lag and that is turned by a movement of size 1: the largest angle, over
    the square of a part, and the mean square of the acceleration."""
    steps = 50 * len(_PATTERN)
    dt_s = len(_PATTERN) * part_s / steps
    asked = np.repeat(_PATTERN, 50)
    share = -math.expm1(-dt_s / max(lag_s, 1e-3))
    acceleration, value = np.zeros(2 * steps), 0.0
    for k in range(2 * steps):  # it goes on turning when the last part is over
        value += share * ((asked[k] if k < steps else 0.0) - value)
        acceleration[k] = value
    angle = np.cumsum(np.cumsum(acceleration)) * dt_s**2
    return float(np.abs(angle).max()) / part_s**2, float((acceleration[:steps] ** 2).mean())


def _null_space(matrix: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(m, f) directions of the motors ``used`` that turn and lift nothing."""
    scaled = matrix[:, used] / np.maximum(np.abs(matrix).max(axis=1), 1e-12)[:, None]
    _, values, rows = np.linalg.svd(scaled)
    rank = int((values > _NULL * values[0]).sum())
    out = np.zeros((len(used), rows.shape[0] - rank))
    out[used] = rows[rank:].T
    return out


def _losses(estimate: Estimate, motors: int) -> list[NDArray[np.float64]]:
    """Loss (m,) of each explanation that cannot be told from the others: as the residual shows it now, or in full."""
    now = () if estimate.best is None else estimate.best.alike
    out = []
    for chosen, loss in now if len(now) > 1 else [(chosen, (1.0,) * len(chosen)) for chosen in estimate.among]:
        each = np.zeros(motors)
        each[list(chosen)] = loss
        out.append(each)
    return out if len(out) > 1 else [*out, np.zeros(motors)]  # of one, whether it is lost


def _telling(apart: list[NDArray[np.float64]], cost: NDArray[np.float64]) -> NDArray[np.float64]:
    """z (f,) for which the least z' M z of the matrices ``apart`` is large at z' ``cost`` z = 1."""
    root = np.linalg.inv(np.linalg.cholesky(cost))
    whitened = [root.dot(part).dot(root.T) for part in apart]
    weights = np.ones(len(apart))
    best, most = np.zeros(len(cost)), -1.0
    for _ in range(_ROUNDS):
        _, vectors = np.linalg.eigh(
            sum((w * part for w, part in zip(weights, whitened, strict=True)), np.zeros_like(cost))
        )
        z = vectors[:, -1]
        told = np.array([z.dot(part).dot(z) for part in whitened])
        if float(told.min()) > most:
            best, most = z, float(told.min())
        weights = weights / np.sqrt(np.maximum(told, 1e-9 * max(float(told.max()), 1e-12)))
        weights = weights / weights.sum()
    return root.T.dot(best)
