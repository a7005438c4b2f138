"""A motor that gives less than it did earlier in the flight, though far too little to be declared: early warning.

Within seconds what is steady is learnt (core/balance.py, core/disturbance.py), a tenth of a motor's thrust with it. So
the means of blocks of flight are kept as they were measured, less what the file foretells,

    z = x' - f(x) - B0 w = C x + b_i loss + noise,   x = (lift, side force, yaw rate),   b_i = - B0[:, i] w_i

with C (n, k) learnt by recursive least squares (Ljung, System Identification, 2nd ed., 11.2) from blocks that are some
seconds old: what file, centre of mass and wind do. The newest blocks are compared with it. One motor must explain them
better than none, than any other, than what turns the vehicle about its yaw axis alone (the air), and than a load that
was moved or dropped: that turns it about the yaw axis only as far as the side force acts elsewhere by then, beside the
centre of mass.
What is found is said and never acted upon. Pure; states are replaced.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core.mates import Mates
from nff_companion.core.residual import ResidualState
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import PITCH, ROLL, THRUST, YAW, Vehicle

_REGRESSORS = ("lift", "side x", "side y", "yaw rate")
_TINY = 1e-6
_LIFT, _SIDE = _REGRESSORS.index("lift"), slice(_REGRESSORS.index("side x"), _REGRESSORS.index("yaw rate"))


class Block(Struct, frozen=True, eq=False):
    """Means: ``z`` (n,), ``x`` (k,), thrust fractions (m,)."""

    z: NDArray[np.float64]
    x: NDArray[np.float64]
    thrust: NDArray[np.float64]


class WearState(Struct, frozen=True, kw_only=True, eq=False):
    """Sums of the block under way; the newest blocks, and the ``oldest`` before them; what was learnt; what is said.

    ``known`` blocks were learnt: ``coefficients`` C (n, k), ``covariance`` (n, k, k), ``scatter`` (n,) variance of a
    block. Some motor may give less for ``suspected`` blocks; ``motors`` (indices; two: one of these above each other)
    seem to, for ``alike`` blocks; ``told`` are said, for ``held`` blocks so far, with their ``loss``, and whether it is
    ``sure`` that it is no load that moved.
    """

    seconds: float = 0.0
    moved: NDArray[np.float64] | None = None  # (11,) sums of ResidualState.smoothed
    thrust: NDArray[np.float64] | None = None  # (m,)
    blocks: tuple[Block, ...] = ()
    oldest: Block | None = None
    known: int = 0
    coefficients: NDArray[np.float64]
    covariance: NDArray[np.float64]
    scatter: NDArray[np.float64]
    suspected: int = 0
    motors: tuple[int, ...] = ()
    alike: int = 0
    told: tuple[int, ...] = ()
    held: int = 0
    loss: float = 0.0
    sure: bool = False


class Wear:
    """Constants of one airframe."""

    def __init__(self, vehicle: Vehicle, tuning: Tuning) -> None:
        o = self._tuning = tuning.wear
        self._mates = Mates(vehicle, tuning)
        self._matrix = matrix = vehicle.acceleration_effectiveness
        one = np.sqrt((matrix**2).mean(axis=1)) * vehicle.hover  # what the loss of a motor does to each axis
        self._scatter = (np.array(o.scatter) * one) ** 2
        lift_m_s2 = float(matrix[THRUST].sum()) * vehicle.hover
        width = np.array([o.steady_deviation / lift_m_s2, o.side_deviation, o.side_deviation, o.rate_deviation])
        self._prior = (one**2)[:, None, None] * np.diag(width**2)
        self._error = np.array(o.model_error)[:, None]
        jx, jy, jz = vehicle.inertia_kg_m2.tolist()
        # Of what a load beside the middle does to roll and pitch, for each side force over the lift, to yaw.
        self._aside = np.array([jx, jy]) / jz
        # (2, m) yaw by the side force at each rotor, were it all at the rotors
        x, y = vehicle.position_m[:, :2].T
        self._drag = vehicle.mass_kg / jz * np.stack([-y, x]) / vehicle.motors

    def start(self) -> WearState:
        """Nothing seen in this flight."""
        nothing = np.zeros((len(self._matrix), len(_REGRESSORS)))
        return WearState(coefficients=nothing, covariance=self._prior, scatter=self._scatter)

    def paused(self, state: WearState) -> WearState:
        """The block under way is dropped: not all of it is healthy flight."""
        return state if state.moved is None else replace(state, seconds=0.0, moved=None, thrust=None)

    def anew(self, state: WearState) -> WearState:
        """Something else is said of the motors: what the newest blocks show is of that, what was learnt stays."""
        state = self.paused(state)
        if not state.blocks and not state.told:
            return state
        return replace(state, blocks=(), oldest=None, suspected=0, motors=(), alike=0, told=(), loss=0.0, sure=False)

    def step(self, state: WearState, seen: ResidualState, dt_s: float) -> WearState:
        """One sample in flight, while no motor is lost."""
        seconds = state.seconds + dt_s
        moved, thrust = dt_s * seen.smoothed, dt_s * seen.thrust_shown
        if state.moved is not None and state.thrust is not None:
            moved, thrust = state.moved + moved, state.thrust + thrust
        if seconds < self._tuning.block_s:
            return replace(state, seconds=seconds, moved=moved, thrust=thrust)
        means = dataclasses.replace(seen, smoothed=moved / seconds, thrust_shown=thrust / seconds)
        state = self.paused(state)
        if float(np.hypot(*means.lateral_m_s2)) > self._tuning.side_max_m_s2:
            return state  # fast flight: what the air does is not linear in its push
        return self._looked(state, self._block(means))

    def _block(self, means: ResidualState) -> Block:
        foretold = self._matrix.dot(means.thrust_shown)
        x = np.array([foretold[THRUST], *means.lateral_m_s2, means.rate_rad_s[-1]])
        return Block(means.measured - foretold, x, means.thrust_shown)

    def _looked(self, state: WearState, block: Block) -> WearState:
        """One more ``block``, and what the newest ones say."""
        o = self._tuning
        blocks = (*state.blocks, block)
        if len(blocks) > o.recent:
            # What is being weighed is not learnt for some time, and what was found stays what it was compared with.
            held = bool(state.told) or 0 < state.suspected <= o.hold_blocks
            state = state if held else self._learnt(state, blocks[0], state.oldest)
            state, blocks = replace(state, oldest=blocks[0]), blocks[1:]
        state = replace(state, blocks=blocks)
        if state.known < o.known_blocks or len(blocks) < o.recent:
            return state
        if state.told:
            return self._held(state)
        motors, loss, sure, suspected = self._less(state)
        alike = 0 if not motors else state.alike + 1 if set(motors) & set(state.motors) else 1
        told = motors if alike >= o.alike else ()
        state = replace(state, suspected=state.suspected + 1 if suspected else 0)
        loss = loss if told else 0.0
        return replace(state, motors=motors, alike=alike, told=told, held=0, loss=loss, sure=sure)

    def _held(self, state: WearState) -> WearState:
        """The same while a motor is said to give less: how much less by now, and whether it gives as before."""
        compared = self._compared(state, len(state.blocks))
        o, gain = self._tuning, compared.improvement
        if not state.sure and state.held >= o.hold_blocks:
            return self._usual(state)
        state = replace(state, held=state.held + 1)
        place = {*state.told, *(self._mates.of[motor] for motor in state.told)} - {-1}
        motor = max(place, key=lambda i: float(gain[i]))
        loss, deviation = float(compared.loss[motor]), float(compared.deviation[motor])
        if loss + deviation < o.loss_ends and float(gain.max()) < o.improvement_min:
            return self.anew(state)
        motors, rival = self._place(compared, motor)
        if gain[motor] <= rival or deviation > o.deviation_max:
            return state  # more than one gives less, or the air is rough
        # In a turn yaw misleads: where it speaks for the other of two above each other, both are said from then on.
        other = len(motors) == 1 and motor not in state.told
        loss = state.loss + (loss - state.loss) / len(state.blocks)
        sure = state.sure or bool(gain[motor] - compared.load >= o.load_margin_min)
        return replace(state, told=tuple(sorted(place)) if other else state.told, loss=loss, sure=sure)

    def _usual(self, state: WearState) -> WearState:
        """A load that moved, as far as is known, stays where it is: what is steady is learnt anew."""
        covariance = state.covariance.copy()
        covariance[:, _LIFT], covariance[:, :, _LIFT] = 0.0, 0.0
        covariance[:, _LIFT, _LIFT] = self._prior[:, _LIFT, _LIFT]
        return replace(self.anew(state), covariance=covariance, known=0)

    def _place(self, compared: _Compared, motor: int) -> tuple[tuple[int, ...], float]:
        """``motor`` (index), or both, where the one above or below it explains as much: of them yaw alone tells which
        it is; and the improvement of the best other one, or of the air."""
        mate, others = self._mates.of[motor], compared.improvement.copy()
        others[motor] = -np.inf
        clear = mate < 0 or compared.improvement[motor] - others[mate] >= self._tuning.margin_min
        if mate >= 0:
            others[mate] = -np.inf
        rival = max(float(others.max()), compared.air)
        return (motor,) if clear else tuple(sorted((motor, mate))), rival

    def _less(self, state: WearState) -> tuple[tuple[int, ...], float, bool, bool]:
        """The motor (index) that gives less by the newest blocks, or two above each other, one of which does; its loss;
        whether that is sure to be no load; whether some motor may give less."""
        o = self._tuning
        found: tuple[tuple[int, ...], float, bool] = ((), 0.0, False)
        most, suspected = o.improvement_min, False
        for count in (o.alike, 2 * o.alike, o.recent):
            compared = self._compared(state, count)
            motor = int(compared.improvement.argmax())
            improvement, loss = float(compared.improvement[motor]), float(compared.loss[motor])
            known = float(compared.deviation[motor]) <= o.deviation_max
            if improvement < o.improvement_min or not known or not o.loss_min <= loss <= 1.0:
                continue
            motors, rival = self._place(compared, motor)
            load = compared.load
            ahead = improvement - rival >= o.margin_min and improvement - load >= -o.load_behind_max
            suspected = suspected or ahead
            if ahead and improvement >= most:
                found, most = (motors, loss, improvement - load >= o.load_margin_min), improvement
        return (*found, suspected)

    def _compared(self, state: WearState, count: int) -> _Compared:
        """The newest ``count`` blocks with what was learnt."""
        newest = state.blocks[-count:]
        z, x, thrust = (np.mean([getattr(block, key) for block in newest], axis=0) for key in ("z", "x", "thrust"))
        off = z - state.coefficients.dot(x)
        # Gusts last longer than a block.
        independent = min(float(len(newest)), self._tuning.independent_blocks)
        variance = self._scatter_now(state) / independent + x.dot(state.covariance).dot(x)
        turns = -self._matrix * thrust  # (n, m) of the loss of each
        # A rotor that turns slower drags less: half as much as it loses, of the side force's share at the rotors.
        drags = -0.5 * x[_SIDE].dot(self._drag)
        turns[YAW] += self._tuning.rotor_share * drags
        doubtful = self._error * turns
        doubtful[YAW] = np.hypot(doubtful[YAW], self._tuning.rotor_share * drags)
        each = np.broadcast_to(variance[:, None], turns.shape)
        loss = np.zeros(len(thrust))
        for _ in range(2):  # how far the file may be off grows with the loss
            each = variance[:, None] + (doubtful * loss) ** 2
            weight = np.maximum((turns * turns / each).sum(axis=0), _TINY)  # one that gives nothing tells nothing
            loss = np.clip((turns * off[:, None] / each).sum(axis=0) / weight, 0.0, 1.0)
        rest = off[:, None] - turns * loss
        cost = 0.5 * (rest * rest / each + np.log(each / variance[:, None])).sum(axis=0)
        nothing = 0.5 * off * off / variance
        moved = float((off[[ROLL, PITCH]] * self._aside * x[_SIDE]).sum()) / max(x[_LIFT], _TINY)
        unknown = variance[YAW] + (self._tuning.load_error * moved) ** 2
        load = nothing.sum() - 0.5 * (off[YAW] - moved) ** 2 / unknown
        air = nothing[THRUST] + nothing[YAW]
        return _Compared(loss, 1.0 / np.sqrt(weight), nothing.sum() - cost, float(load), float(air))

    @staticmethod
    def _scatter_now(state: WearState) -> NDArray[np.float64]:
        """(n,) Variance of a block by what was learnt, or by the newest ones, where these scatter more: by how much
        each differs from the one before, without the largest step, which a motor may have made."""
        left = np.array([block.z - state.coefficients.dot(block.x) for block in state.blocks])
        squares = np.diff(left, axis=0) ** 2
        steps = (squares.sum(axis=0) - squares.max(axis=0)) / max(len(squares) - 1, 1)
        return np.maximum(state.scatter, 0.5 * steps)

    def _learnt(self, state: WearState, block: Block, last: Block | None) -> WearState:
        """C and scatter with a ``block`` that is some seconds old, after the ``last`` one."""
        o, x = self._tuning, block.x
        prior = state.covariance.copy()
        drifted = prior[:, _LIFT, _LIFT] + state.scatter / (max(x[_LIFT] * x[_LIFT], _TINY) * o.memory_blocks)
        prior[:, _LIFT, _LIFT] = np.minimum(drifted, self._prior[:, _LIFT, _LIFT])
        error, spread = block.z - state.coefficients.dot(x), prior.dot(x)  # (n,), (n, k)
        known = spread.dot(x)
        # Once what is usual is known, what is far from it moves it no more than what is at the limit would.
        noise = state.scatter
        if state.known >= o.known_blocks:
            noise = np.maximum(noise, np.abs(error) * np.sqrt(known + noise) / o.spread_limit - known)
        gain = spread / (known + noise)[:, None]
        share = 1.0 / min(state.known + o.scatter_blocks, o.memory_blocks)
        shown = error * error / (known + state.scatter) * state.scatter
        if last is not None:  # two in a row differ by their scatter alone, whatever is known
            step = block.z - last.z - state.coefficients.dot(x - last.x)
            shown = np.maximum(shown, 0.5 * step * step)
        shown = np.minimum(shown, o.spread_limit**2 * state.scatter)
        scatter = np.maximum(state.scatter + share * (shown - state.scatter), o.scatter_min**2 * self._scatter)
        return replace(
            state,
            known=state.known + 1,
            coefficients=state.coefficients + gain * error[:, None],
            covariance=prior - gain[:, :, None] * spread[:, None, :],
            scatter=scatter,
        )


@dataclasses.dataclass(frozen=True, slots=True)
class _Compared:
    """Were each motor (m,) the only one that gives less: its ``loss`` and that number's ``deviation``, and by how many
    nats that explains more than nothing; ``load``, ``air``: the same of a load that was moved or dropped, and of the
    air, which turns the vehicle about its yaw axis."""

    loss: NDArray[np.float64]
    deviation: NDArray[np.float64]
    improvement: NDArray[np.float64]
    load: float
    air: float
