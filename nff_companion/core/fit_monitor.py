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

from nff_companion.core.answers import Answers, AnswersState
from nff_companion.core.filters import lag_share
from nff_companion.core.fit import NOTHING, TURNS, Factor, Fit, FitVerdict, Seen, judged
from nff_companion.core.motor_order import orders
from nff_companion.core.residual import ResidualState
from nff_companion.core.tuning import FitTuning
from nff_companion.core.vehicle import PITCH, ROLL, THRUST, Vehicle

_COLUMNS = (*TURNS, "roll rate", "pitch rate", "yaw rate", "up")  # of what is gathered, before the m thrusts
_AXES, _UP, _HEAD = len(TURNS), _COLUMNS.index("up"), len(_COLUMNS)
_SUM_MAX = 1e15  # minutes of what sensors can say, squared, are below


class FitState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """What has been gathered. Columns: roll, pitch, yaw acceleration; rates; upward force; m thrusts; and of ``sums``
    also the derivatives of the three modelled accelerations."""

    fit: Fit = NOTHING  # what is believed: the same several times
    gains: NDArray[np.float64] | None = None  # (n,) rows over the file's, as far as they are known; None: not at all
    proven: bool = False  # it has fitted once: a failure later on does not change that
    wait: int = 0  # samples that are passed over
    looks: tuple[NDArray[np.float64], ...] = ()  # (7 + m,) each, since the last judgement
    settle: int = 0  # looks before the filters have settled
    slow: NDArray[np.float64] | None = None  # (7 + m,) the two lags; None: they start anew
    fast: NDArray[np.float64] | None = None  # (7 + m,)
    alike: int = 0  # judgements in a row of the same verdict
    last: FitVerdict = FitVerdict.UNKNOWN
    sums: NDArray[np.float64]  # (10 + m, 10 + m)
    total: NDArray[np.float64]  # (7 + m,)
    count: float = 0.0
    answers: AnswersState  # of each motor alone


class FitMonitor:
    """Constants of one airframe at one sample time; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, dt_s: float, tuning: FitTuning) -> None:
        o = self._tuning = tuning
        self._skip = max(math.floor(1.0 / (o.look_hz * dt_s)), 1) - 1
        self._look_s = (self._skip + 1) * dt_s
        self._keep = math.exp(-self._look_s / o.memory_s)
        self._settle, self._every = round(o.settle_s / self._look_s), max(round(o.judge_s / self._look_s), 1)
        self._slow, self._fast = (
            _lag(self._every, lag_share(self._look_s, 1.0 / (2.0 * math.pi * hz))) for hz in (o.slow_hz, o.fast_hz)
        )
        self._weights = np.sqrt(self._keep ** np.arange(self._every - 1, -1, -1.0))[:, None]  # (looks, 1)
        nominal = vehicle.acceleration_effectiveness
        self._lift, self._rows = nominal[THRUST], nominal[1:]
        self._orders = orders(self._rows)
        self._others = np.stack([order.rows for order in self._orders], axis=1)  # (3, orders, m)
        self._unit = np.eye(vehicle.motors)
        self._answers = Answers(nominal, _HEAD, tuning)
        self._width = _HEAD + vehicle.motors

    def start(self) -> FitState:
        """Nothing seen."""
        width = self._width
        sums = np.zeros((width + _AXES, width + _AXES))
        return FitState(sums=sums, total=np.zeros(width), answers=self._answers.start())

    def paused(self, state: FitState, *, anew: bool = False) -> FitState:
        """After a break the filters start anew; what was gathered stays. ``anew``: but for how each motor answers."""
        if anew and state.answers.seconds > 0.0:
            state = replace(state, answers=self._answers.start())
        if state.fast is None and not state.looks:
            return state
        return replace(state, fast=None, slow=None, looks=(), wait=0)

    def step(self, state: FitState, shown: ResidualState) -> FitState:
        """One sample of a flight in which nothing is declared."""
        if state.wait:
            return replace(state, wait=state.wait - 1)
        measured = shown.smoothed
        now = np.concatenate((measured[1:4], measured[6:9], measured[:1], shown.thrust_shown))
        looks = (*state.looks, now)
        if len(looks) < self._every:
            return replace(state, looks=looks, wait=self._skip)
        return self._judged(self._gathered(replace(state, looks=(), wait=self._skip), np.array(looks)))

    def _gathered(self, state: FitState, looks: NDArray[np.float64]) -> FitState:
        """With as many ``looks`` (., 7 + m) as a judgement waits for: through both lags, and into the sums."""
        settle = self._settle if state.fast is None else state.settle
        before = looks[0] if state.fast is None else state.fast
        slow = _lagged(self._slow, looks, looks[0] if state.slow is None else state.slow)
        fast = _lagged(self._fast, looks, before)
        change = np.diff(fast[:, _HEAD:], axis=0, prepend=before[None, _HEAD:]) / self._look_s
        skipped = min(settle, len(looks))
        moved = np.hstack([fast - slow, change.dot(self._rows.T)])
        band = (moved * self._weights)[skipped:]
        weights, forgotten = self._weights[skipped:] ** 2, self._keep ** len(looks)
        return replace(
            state,
            slow=slow[-1],
            fast=fast[-1],
            settle=settle - skipped,
            sums=forgotten * state.sums + band.T.dot(band),
            total=forgotten * state.total + (weights * looks[skipped:]).sum(axis=0),
            count=forgotten * state.count + float(weights.sum()),
            answers=self._answers.step(state.answers, moved[skipped:], self._look_s),
        )

    def lifted(self, state: FitState, up_m_s2: float, thrust: NDArray[np.float64]) -> FitState:
        """One sample of a vehicle that is in the air, by less ``thrust`` (m,) than could carry the file's."""
        if state.wait:
            return replace(state, wait=state.wait - 1)
        looks = (*state.looks, np.concatenate((np.zeros(_UP), [up_m_s2], thrust)))
        if len(looks) < self._every:
            return replace(state, looks=looks, wait=self._skip)
        forgotten = self._keep ** len(looks)
        state = replace(
            state,
            looks=(),
            wait=self._skip,
            fast=None,
            slow=None,
            sums=forgotten * state.sums,
            total=forgotten * state.total + np.array(looks).sum(axis=0),
            count=forgotten * state.count + len(looks),
        )
        return self._judged(state)

    def _judged(self, state: FitState) -> FitState:
        """Believed is what is said several times. Where the sums are none of a vehicle it begins anew: it may not know,
        and may not end what flies."""
        anew = replace(self.start(), fit=state.fit, gains=state.gains, proven=state.proven)
        if not float(np.abs(state.sums).max()) + float(np.abs(state.total).max()) < _SUM_MAX:  # NaN is not less
            return anew
        try:
            seen = self.seen(state)
            fit = judged(seen, self._tuning)
        except np.linalg.LinAlgError:
            return anew
        state = replace(state, gains=self._gains(seen))
        if state.proven and fit.verdict == FitVerdict.DOES_NOT_FIT:
            return state  # the vehicle has changed, not its file
        alike = state.alike + 1 if fit.verdict == state.last else 1
        if fit.verdict != state.fit.verdict and alike < self._tuning.alike:
            return replace(state, alike=alike, last=fit.verdict)
        proven = state.proven or fit.verdict == FitVerdict.FITS
        return replace(state, alike=alike, last=fit.verdict, fit=fit, proven=proven)

    def _gains(self, seen: Seen) -> NDArray[np.float64] | None:
        """(n,): motors that lift more than the file says turn as much more; that is believed as much as files are
        right, what was seen of roll and pitch as much as its ends agree. In fast flight side drag looks like yaw."""
        if seen.thrust is None:
            return None
        o, gains, lifted = self._tuning, np.full(1 + _AXES, seen.thrust.middle), math.log(seen.thrust.middle)
        gains[THRUST] = 1.0
        most, prior = o.gain_deviations_max * o.gain_deviation, o.gain_deviation**2
        for axis, factor in zip((ROLL, PITCH), seen.turns[:2], strict=True):
            if factor is not None:
                noise = math.hypot(0.5 * math.log(factor.high / factor.low), o.gain_noise)
                beside = (math.log(factor.middle) - lifted) * prior / (prior + noise**2)
                gains[axis] = math.exp(lifted + min(max(beside, -most), most))
        return gains

    def seen(self, state: FitState) -> Seen:
        """The numbers of what has been gathered."""
        o, seconds = self._tuning, state.count * self._look_s
        thrust, enough = None, seconds >= o.settled_s
        if enough:
            up, modelled_up = float(state.total[_UP]), float(self._lift.dot(state.total[_HEAD:]))
            thrust = Factor(up / modelled_up, up / modelled_up) if up > 0.0 and modelled_up > 0.0 else None
        sums = state.sums
        modelled = self._rows.dot(sums[_HEAD : self._width])  # (3, 10 + m)
        turns, explained, later = zip(*(self._turn(sums, modelled, axis) for axis in range(_AXES)), strict=True)
        turns = turns if enough else (None, None, None)
        clear = [late for late, share in zip(later[:2], explained[:2], strict=True) if share >= o.lag_explained]
        chi = self._misfits(sums, seconds)
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
            turned=self._orders[other].turned_deg != 0.0,
            ambiguous=bool(wrong[1] - wrong[0] < 0.5 * o.order_margin),
            misfit=float(chi[0]),
            least_misfit=float(chi[other]),
        )

    def _turn(
        self, sums: NDArray[np.float64], modelled: NDArray[np.float64], axis: int
    ) -> tuple[Factor | None, float, float]:
        """Gain of one axis, share that the commands explain, and how much later than modelled it turns, s.

        ``modelled`` (3, 10 + m): the modelled accelerations with everything else.
        """
        rate, slope = _AXES + axis, self._width + axis
        with_model, motors = modelled[axis], slice(_HEAD, self._width)
        energy, model = float(sums[axis, axis]), float(with_model[motors].dot(self._rows[axis]))
        turned = float(sums[rate, rate])
        if energy <= 0.0 or model <= 0.0 or turned <= 0.0:
            return None, 0.0, 0.0
        both, braked, driven = float(with_model[axis]), float(sums[axis, rate]), float(with_model[rate])
        ahead, damping = _of_two(model, driven, turned, both, braked)
        back, _ = _of_two(energy, braked, turned, both, driven)
        explained = (ahead * both + damping * braked) / energy
        if explained < self._tuning.explained_min or ahead <= 0.0 or back <= 0.0:
            return None, explained, 0.0
        gram = np.array(
            [
                [model, driven, with_model[slope]],
                [driven, turned, sums[rate, slope]],
                [with_model[slope], sums[rate, slope], sums[slope, slope]],
            ]
        )
        gram[[0, 1, 2], [0, 1, 2]] *= 1.0 + self._tuning.ridge
        right = np.array([both, braked, sums[slope, axis]])
        gain, _, shift = np.linalg.lstsq(gram, right, rcond=1e-12)[0].tolist()  # the thrusts may have stood still
        ends = sorted((ahead, 1.0 / back))
        return Factor(ends[0], ends[1]), explained, -shift / gain if gain > 0.0 else 0.0

    def _misfits(self, sums: NDArray[np.float64], seconds: float) -> NDArray[np.float64]:
        """Chi squared (orders,) of each order's shares, each row with a factor above 0 of its own."""
        o, motors = self._tuning, slice(_HEAD, self._width)
        turning, both, thrusts = sums[:_AXES, :_AXES], sums[:_AXES, motors], sums[motors, motors]
        energy = np.diagonal(turning)
        if seconds <= 0.0 or not (energy > 0.0).all():
            return np.zeros(len(self._orders))
        inverse = np.linalg.inv(turning + np.diag(o.ridge * energy))
        shares = inverse.dot(both)  # (3, m)
        rest = (thrusts - both.T.dot(shares)) / max(seconds * o.independent_hz, 1.0)
        own = o.mixer_error**2 * (shares * shares).mean(axis=1) + o.ridge * np.diagonal(inverse) * np.trace(thrusts)
        covariance = np.diagonal(inverse)[:, None, None] * rest + own[:, None, None] * self._unit
        weight = np.linalg.pinv(covariance, hermitian=True)  # (3, m, m)
        whole = ((shares[:, None] @ weight)[:, 0] * shares).sum(axis=1)
        weighed = self._others @ weight  # (3, orders, m)
        along = np.maximum((weighed * shares[:, None]).sum(axis=2), 0.0)
        chi = whole[:, None] - along**2 / np.maximum((weighed * self._others).sum(axis=2), 1e-30)
        return np.asarray(chi.sum(axis=0))


def _lag(looks: int, share: float) -> NDArray[np.float64]:
    """(looks, looks + 1) what a first-order lag of ``share`` a look makes of its state before, and of the looks."""
    age = np.arange(looks)[:, None] - np.arange(looks)[None, :]
    kernel = np.where(age >= 0, share * (1.0 - share) ** np.maximum(age, 0), 0.0)
    return np.hstack([(1.0 - share) ** np.arange(1.0, looks + 1.0)[:, None], kernel])


def _lagged(lag: NDArray[np.float64], looks: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """``looks`` after the lag, of state ``before`` the first one."""
    return np.asarray(lag.dot(np.vstack([before, looks])))


def _of_two(one: float, mixed: float, other: float, with_one: float, with_other: float) -> tuple[float, float]:
    """Least squares of two columns by their products with each other and with the right side; of the first alone where
    the two go together."""
    determinant = one * other - mixed * mixed
    if determinant <= 1e-9 * one * other:
        return with_one / one, 0.0
    return (other * with_one - mixed * with_other) / determinant, (one * with_other - mixed * with_one) / determinant
