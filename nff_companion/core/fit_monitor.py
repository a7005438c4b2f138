"""Does the airframe file fit the vehicle that flies? From the motion and the thrusts behind the residual's chain.

Four questions, each asked of what a healthy flight shows, none of the air's steady pushes:

  thrust  the mean upward specific force, over what the file makes of the mean thrusts
  order   A mixer gives each motor shares of the torques that it wants, and what it wants it gets where the vehicle
          flies well: the thrusts w follow the angular accelerations A with just those shares, S = (A A')^-1 A w'.
          They are compared with the file's rows, with two motors swapped, spins reversed or the nose elsewhere,
          weighed by how well they are known: the covariance of S is that of what A does not explain of w, over the
          independent looks
  gains   A = g B0 w - d r, forward and backward; r, the body rates, take what the air brakes. The truth lies between
          the two: the forward one is too small by what the air moves, the backward one too large by it
  lag     the same with the derivative of B0 w: motors that answer later than the file says

Angular accelerations, rates and thrusts pass the same band, the difference of two first-order lags. One matrix of sums
is gathered, forgotten slowly; judgements are some hundred times rarer than samples. Pure; states are replaced.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core.filters import lag_share
from nff_companion.core.fit import NOTHING, Factor, Fit, FitVerdict, Seen, judged
from nff_companion.core.motor_order import orders
from nff_companion.core.residual import ResidualState
from nff_companion.core.tuning import FitTuning
from nff_companion.core.vehicle import THRUST, Vehicle

_AXES = 3  # of turning: what is gathered begins with as many accelerations, then rates, then upward force, then thrusts
_UP = 2 * _AXES
_HEAD = _UP + 1


class FitState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """What has been gathered. Columns: roll, pitch, yaw acceleration; rates; upward force; m thrusts; and of ``sums``
    also the derivatives of the three modelled accelerations."""

    fit: Fit = NOTHING  # what is believed: the same several times
    proven: bool = False  # it has fitted once: a failure later on does not change that
    wait: int = 0  # samples that are passed over
    settle: int = 0  # looks before the filters have settled; they start anew after a break
    looks: int = 0  # until the next judgement
    alike: int = 0  # judgements in a row of the same verdict
    last: FitVerdict = FitVerdict.UNKNOWN
    slow: NDArray[np.float64] | None = None  # (7 + m,)
    fast: NDArray[np.float64] | None = None  # (7 + m,)
    sums: NDArray[np.float64]  # (10 + m, 10 + m)
    total: NDArray[np.float64]  # (7 + m,)
    count: float = 0.0


class FitMonitor:
    """Constants of one airframe at one sample time; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, dt_s: float, tuning: FitTuning) -> None:
        o = self._tuning = tuning
        self._skip = max(math.floor(1.0 / (o.look_hz * dt_s)), 1) - 1
        self._look_s = (self._skip + 1) * dt_s
        self._slow, self._fast = (lag_share(self._look_s, 1.0 / (2.0 * math.pi * f)) for f in (o.slow_hz, o.fast_hz))
        self._keep = math.exp(-self._look_s / o.memory_s)
        self._settle, self._every = round(o.settle_s / self._look_s), max(round(o.judge_s / self._look_s), 1)
        nominal = vehicle.acceleration_effectiveness
        self._lift, self._rows = nominal[THRUST], nominal[1:]
        self._derivative = self._rows / self._look_s
        self._orders = orders(self._rows)
        self._others = np.array([order.rows for order in self._orders])  # (orders, 3, m)
        self._width = _HEAD + vehicle.motors

    def start(self) -> FitState:
        """Nothing seen."""
        width = self._width
        return FitState(sums=np.zeros((width + _AXES, width + _AXES)), total=np.zeros(width))

    @staticmethod
    def paused(state: FitState) -> FitState:
        """After a break the filters start anew; what was gathered stays."""
        return state if state.fast is None else replace(state, fast=None, slow=None, wait=0)

    def step(self, state: FitState, shown: ResidualState) -> FitState:
        """One sample of a flight in which nothing is declared."""
        if state.wait:
            return replace(state, wait=state.wait - 1)
        measured = shown.smoothed
        now = np.concatenate((measured[1:4], measured[6:9], measured[:1], shown.thrust_shown))
        slow, fast = state.slow, state.fast
        if slow is None or fast is None:
            return replace(state, slow=now, fast=now, settle=self._settle, wait=self._skip)
        slow, before = slow + self._slow * (now - slow), fast
        fast = fast + self._fast * (now - fast)
        if state.settle:
            return replace(state, slow=slow, fast=fast, settle=state.settle - 1, wait=self._skip)
        band = np.concatenate((fast - slow, self._derivative.dot((fast - before)[_HEAD:])))
        state = replace(
            state,
            wait=self._skip,
            slow=slow,
            fast=fast,
            sums=self._keep * state.sums + band[:, None] * band,
            total=self._keep * state.total + now,
            count=self._keep * state.count + 1.0,
            looks=state.looks + 1,
        )
        return self._judged(state) if state.looks >= self._every else state

    def lifted(self, state: FitState, up_m_s2: float, thrust: NDArray[np.float64]) -> FitState:
        """One sample of a vehicle that is in the air, by less ``thrust`` (m,) than could carry the file's."""
        if state.wait:
            return replace(state, wait=state.wait - 1)
        now = np.concatenate((np.zeros(_UP), [up_m_s2], thrust))
        state = replace(
            self.paused(state),
            wait=self._skip,
            sums=self._keep * state.sums,
            total=self._keep * state.total + now,
            count=self._keep * state.count + 1.0,
            looks=state.looks + 1,
        )
        return self._judged(state) if state.looks >= self._every else state

    def _judged(self, state: FitState) -> FitState:
        """Believed is what is said several times."""
        fit = judged(self.seen(state), self._tuning)
        if state.proven and fit.verdict == FitVerdict.DOES_NOT_FIT:
            return replace(state, looks=0)  # the vehicle has changed, not its file
        alike = state.alike + 1 if fit.verdict == state.last else 1
        believed = fit.verdict == state.fit.verdict or alike >= self._tuning.alike
        if not believed:
            return replace(state, looks=0, alike=alike, last=fit.verdict)
        proven = state.proven or fit.verdict == FitVerdict.FITS
        return replace(state, looks=0, alike=alike, last=fit.verdict, fit=fit, proven=proven)

    def seen(self, state: FitState) -> Seen:
        """The numbers of what has been gathered."""
        o, seconds = self._tuning, state.count * self._look_s
        thrust, enough = None, seconds >= o.settled_s
        if enough:
            ratio = float(state.total[_UP] / self._lift.dot(state.total[_HEAD:]))
            thrust = Factor(ratio, ratio) if ratio > 0.0 else None
        turns, explained, later = zip(*(self._turn(state.sums, axis) for axis in range(_AXES)), strict=True)
        turns = turns if enough else (None, None, None)
        clear = [late for late, share in zip(later[:2], explained[:2], strict=True) if share >= o.lag_explained]
        chi = self._misfits(state.sums, seconds)
        other = 1 + int(np.argmin(chi[1:]))
        wrong = np.sort(chi[1:])
        return Seen(
            seconds=seconds,
            thrust=thrust,
            turns=turns,
            explained=explained,
            later_s=min(clear, key=abs) + o.early_s if enough and clear else None,
            order=self._orders[other].text if chi[other] < chi[0] else "",
            margin=float(chi[other] - chi[0]),
            ambiguous=bool(wrong[1] - wrong[0] < 0.5 * o.order_margin),
            misfit=float(chi[0]),
            least_misfit=float(chi[other]),
        )

    def _turn(self, sums: NDArray[np.float64], axis: int) -> tuple[Factor | None, float, float]:
        """Gain of one axis, share that the commands explain, and how much later than modelled it turns, s."""
        rows, motors = self._rows[axis], slice(_HEAD, self._width)
        take = np.zeros((4, len(sums)))  # acceleration, modelled, rate, derivative of the modelled
        take[0, axis] = take[2, _AXES + axis] = take[3, self._width + axis] = 1.0
        take[1, motors] = rows
        gram = take @ sums @ take.T
        energy = float(gram[0, 0])
        if energy <= 0.0 or gram[1, 1] <= 0.0 or gram[2, 2] <= 0.0:
            return None, 0.0, 0.0
        ahead = _solved(gram[1:3, 1:3], gram[1:3, 0])
        back = _solved(gram[[[0], [2]], [0, 2]], gram[[0, 2], 1])
        explained = float(ahead @ gram[1:3, 0]) / energy
        if explained < self._tuning.explained_min or ahead[0] <= 0.0 or back[0] <= 0.0:
            return None, explained, 0.0
        with_lag = _solved(gram[1:, 1:], gram[1:, 0])
        later = -float(with_lag[2] / with_lag[0]) if with_lag[0] > 0.0 else 0.0
        ends = sorted((float(ahead[0]), 1.0 / float(back[0])))
        return Factor(ends[0], ends[1]), explained, later

    def _misfits(self, sums: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
        """Chi squared (orders,) of each order's shares, each row with a factor above 0 of its own."""
        motors = slice(_HEAD, self._width)
        turning, both, thrusts = sums[:_AXES, :_AXES], sums[:_AXES, motors], sums[motors, motors]
        chi = np.zeros(len(self._orders))
        if seconds <= 0.0 or not (np.diagonal(turning) > 0.0).all():
            return chi
        inverse = np.linalg.pinv(turning)
        shares = inverse @ both  # (3, m)
        rest = (thrusts - both.T @ shares) / max(seconds * self._tuning.independent_hz, 1.0)
        for axis in range(_AXES):
            share = shares[axis]
            own = self._tuning.mixer_error**2 * float(np.mean(share**2))
            covariance = rest * inverse[axis, axis] + own * np.eye(len(share))
            weight = np.linalg.pinv(covariance, hermitian=True)
            rows = self._others[:, axis]
            weighed = rows @ weight
            along = np.maximum(weighed @ share, 0.0)
            chi += share @ weight @ share - along**2 / np.einsum("om,om->o", weighed, rows)
        return chi


def _solved(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least squares, also where the columns go with each other."""
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])
