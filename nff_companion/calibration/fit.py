"""Maximum likelihood of a vehicle's numbers, given what was believed before; scipy's least squares do the search."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from nff_companion.calibration import air, chain, model, noise
from nff_companion.calibration.battery import sag
from nff_companion.calibration.lift import lift_slope, share_of
from nff_companion.calibration.model import BELIEVED, Layout, Prior
from nff_companion.calibration.record import Piece, Record

ROUNDS = 4  # of noise and numbers in turn
_MEMORY_S = 0.3  # of the noise's model: less, and yaw's slow motion is taken for surer than it is
_SETTLE_S = 0.5  # of each piece, in which the filters forget how it began
_LIFT_S = 0.08  # over which the thrust of the outputs is held to the specific force that was measured
_LEAST_NOISE = 0.01  # m/s^2 and rad/s^2: no sensor is as good
_THRUST_DOUBT = 10.0  # what moving air does to the thrust is no noise: its axis counts as so much noisier
_TURNING = (model.ROLL, model.PITCH, model.YAW)
_CURVE = [model.EXPO, model.IDLE]
# What the model leaves out of a flight moves the numbers by so much more than noise does, as the flights of
# `nff bench calibration` show: deviations of delay (s), log lag, its asymmetry, expo, idle; log gain, motor, centre.
_LEFT_OUT_SHAPE = (0.0012, 0.05, 0.03, 0.08, 0.06)
_SAME_RATE = 1e-3  # of two pieces' samples
_BLOCK = 512  # rows
_NO_VEHICLE = 4.0  # deviations of what an owner knows of motors and centre of mass, beyond which it is no news of them
_UNSEEN = 0.5  # deviation of a logarithm that nothing was seen of
_LEFT_OUT_GAIN, _LEFT_OUT_MOTOR, _LEFT_OUT_CENTRE = 0.04, 0.0, 0.015


@dataclass(frozen=True, slots=True)
class Fit:
    """``x`` and ``covariance`` of the parameters (model.py), ``prior`` their deviations before; ``mean_output`` of all
    motors over the record; ``explained`` (AXES,): share of what noise of the same colour would not do
    that the outputs foretell."""

    x: NDArray[np.float64]
    covariance: NDArray[np.float64]
    prior: NDArray[np.float64]
    layout: Layout
    mean_output: float
    explained: NDArray[np.float64]

    @property
    def deviation(self) -> NDArray[np.float64]:
        """(parameters,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def command_deviation(self) -> NDArray[np.float64]:
        """(3,) of the logarithms of roll, pitch and yaw acceleration per change of the outputs: a gain, and the curve's
        steepness."""
        _, steeper = model.steepness(self.x, self.layout, self.mean_output)
        change = np.eye(len(self.x))[[model.SHAPE + axis for axis in _TURNING]] + steeper
        return np.sqrt(np.diag(change @ self.covariance @ change.T))


class Problem:
    """A record, and what a vector of parameters leaves of it."""

    def __init__(
        self,
        record: Record,
        layout: Layout,
        filters: chain.Filters,
        inertia: tuple[float, float, float],
        start: NDArray[np.float64],
        prior: NDArray[np.float64],
    ) -> None:
        self._layout, self._filters, self._start, self._prior = layout, filters, start, prior
        self.free = np.flatnonzero(prior > 0.0)
        self._shape_free = self.free[self.free < model.SHAPE]
        self._pieces = record.pieces
        self._climbs = all(bool(piece.velocity_m_s.any()) for piece in record.pieces)  # the velocity is known
        self._measured = [chain.measured(piece, filters, inertia) for piece in record.pieces]
        self._mean = np.array(float(np.mean(np.concatenate([piece.output.mean(axis=1) for piece in record.pieces]))))
        self._skip = [round(_SETTLE_S / piece.dt_s) for piece in record.pieces]
        self._lift = [
            _slow(values[:, :1], piece.dt_s) for values, piece in zip(self._measured, self._pieces, strict=True)
        ]
        self.lift_m_s2 = float(np.mean(np.concatenate(self._lift)))
        self._air = self._air_at(start)
        self._whitening, self._scale = [np.ones(1)] * model.AXES, np.ones(model.AXES)
        self._at: NDArray[np.float64] | None = None
        self._values = (np.zeros(0), np.zeros((0, 0)))

    @property
    def mean_output(self) -> float:
        """Of all motors over the record."""
        return float(self._mean)

    @property
    def layout(self) -> Layout:
        """Of the vehicle."""
        return self._layout

    def suggested(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """``x`` with gains from the powers of what was measured and what the outputs ask for, between 2 and 8 Hz."""
        x = x.copy()
        gains = np.zeros(model.AXES)
        gains[model.THRUST] = np.log(self.lift_m_s2)
        x[model.gains_of(self._layout)] = gains
        left, _ = self._axes(x)
        asked = [m[s:, : model.AXES] - rest for m, s, rest in zip(self._measured, self._skip, left, strict=True)]
        for axis in _TURNING:
            found = sum(float(_band(m[s:, axis], p.dt_s).std()) * p.samples for m, s, p in self._each())
            wanted = sum(
                float(_band(a[:, axis], p.dt_s).std()) * p.samples for a, p in zip(asked, self._pieces, strict=True)
            )
            if self._prior[model.SHAPE + axis] > 0.0:
                gains[axis] = np.log(max(found, 1e-9) / max(wanted, 1e-9))
            else:
                gains[axis] = self._layout.per_lift[axis] + gains[model.THRUST]
        x[model.gains_of(self._layout)] = gains
        return x

    def colour(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Learn the noise from what ``x`` and the air leave; the shares explained (AXES,).

        With what the air does still in it, slow motion would count for nothing: yaw's is slow.
        """
        left, _ = self._axes(x)
        self._air = self._air_at(x)
        explained, scale = np.zeros(model.AXES), np.ones(model.AXES)
        whitening = []
        for axis in range(model.AXES):
            parts = self._split(self._still(np.concatenate([rows[:, axis] for rows in left]), axis))
            order = max(round(_MEMORY_S / self._pieces[0].dt_s), 2)
            filter_ = noise.autoregression(parts, order)
            rest = np.concatenate([noise.whitened(part, filter_) for part in parts])
            moved = self._split(self._still(np.concatenate([m[s:, axis] for m, s, _ in self._each()]), axis))
            was = np.concatenate([noise.whitened(part, filter_) for part in moved])
            explained[axis] = max(1.0 - rest.var() / max(float(was.var()), 1e-30), 0.0)
            scale[axis] = max(float(np.sqrt(np.mean(rest * rest))), _LEAST_NOISE)
            whitening.append(filter_)
        scale[model.THRUST] *= _THRUST_DOUBT
        self._whitening, self._scale, self._at = whitening, scale, None
        return explained

    def residual(self, free: NDArray[np.float64]) -> NDArray[np.float64]:
        """What is left with these values of the free parameters, and what is off from the prior, in deviations."""
        return self._both(free)[0]

    def jacobian(self, free: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of ``residual``."""
        return self._both(free)[1]

    def whole(self, free: NDArray[np.float64]) -> NDArray[np.float64]:
        """All parameters."""
        x = self._start.copy()
        x[self.free] = free
        return x

    def course(self, x: NDArray[np.float64]) -> Course:
        """Of the first piece."""
        left, measured = self._axes(x)[0][0], self._measured[0][self._skip[0] :, : model.AXES]
        time_s = self._pieces[0].dt_s * np.arange(len(left), dtype=np.float64)
        return Course(np.asarray(time_s, np.float64), measured, measured - left)

    def _each(self) -> list[tuple[NDArray[np.float64], int, Piece]]:
        return list(zip(self._measured, self._skip, self._pieces, strict=True))

    def _air_at(self, x: NDArray[np.float64]) -> list[list[NDArray[np.float64]]]:
        """Columns of the air of each piece; how fast rotors turn, as ``x`` says."""
        shape, out = model.shape_of(x, self._layout.full), []
        for values, skip, piece in self._each():
            thrust = chain.shown(piece, [shape], self._filters)[0]
            out.append(air.columns(values[skip:], thrust[skip:], self._layout, piece.dt_s, climbs=self._climbs))
        return out

    def steepness_seen(self, x: NDArray[np.float64]) -> tuple[float, float] | None:
        """Logarithm of the curve's steepness at the mean outputs by what a change of them lifts, and its deviation."""
        if not {model.EXPO, model.IDLE} & set(self.free.tolist()):
            return None
        shape = model.shape_of(x, self._layout.full)
        skipped = [(values[skip:], skip, piece) for values, skip, piece in self._each()]
        thrust = [chain.shown(piece, [shape], self._filters)[0].mean(axis=1)[skip:] for _, skip, piece in skipped]
        ups, airs = [values[:, 0] for values, _, _ in skipped], [columns[model.THRUST][:, 1:] for columns in self._air]
        steps_s = [piece.dt_s for piece in self._pieces]
        late_s = [skip * dt_s for skip, dt_s in zip(self._skip, steps_s, strict=True)]
        battery = sag([piece.battery for piece in self._pieces], thrust, steps_s, late_s)
        if battery is not None:
            thrust = [battery.applied(given) for given in thrust]
        # Two logs may be of different rates: the longest piece's counts.
        dt_s = max(self._pieces, key=lambda piece: piece.samples * piece.dt_s).dt_s
        same = [k for k, step_s in enumerate(steps_s) if abs(step_s - dt_s) < _SAME_RATE * dt_s]
        found = lift_slope([ups[k] for k in same], [thrust[k] for k in same], [airs[k] for k in same], dt_s)
        if found is None:
            return None
        steep, _ = model.steepness(x, self._layout, self.mean_output)
        share = share_of(climbs=self._climbs, battery=battery)
        return float(np.log(found.ratio / share.mean * steep)), float(np.hypot(found.deviation, share.deviation))

    def _still(self, values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """``values`` (N,) of all pieces, without what the air did, about their mean."""
        rest = air.taken_off(values, np.concatenate([piece[axis] for piece in self._air]))
        return np.asarray(rest - rest.mean())

    def _split(self, values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """``values`` (N,) by pieces."""
        lengths = [len(piece[0]) for piece in self._air]
        return np.split(values, np.cumsum(lengths)[:-1])

    def _both(self, free: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if self._at is None or not np.array_equal(self._at, free):
            self._at, self._values = free.copy(), self._reduced(self.whole(free))
        return self._values

    def _reduced(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Squares stay the same under a rotation: each axis is reduced to as many rows as it has columns, after what
        the air may have done is taken off."""
        left, slopes = self._axes(x)
        rows, jacobian = [], []
        for axis in range(model.AXES):
            columns = [
                np.column_stack([moved[axis], slope[axis][:, self.free], rest[:, axis]])
                for moved, slope, rest in zip(self._air, slopes, left, strict=True)
            ]
            white = np.concatenate([noise.whitened(c, self._whitening[axis]) for c in columns]) / self._scale[axis]
            given = self._air[0][axis].shape[1]
            triangle = _triangle(white)[given:, given:]
            rows.append(triangle[:, -1])
            jacobian.append(-triangle[:, :-1])
        off, prior = (x - self._start)[self.free], self._prior[self.free]
        return np.concatenate([*rows, off / prior]), np.concatenate([*jacobian, np.diag(1.0 / prior)])

    def _axes(self, x: NDArray[np.float64]) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
        """What is left (N, AXES) and the derivatives (AXES, N, parameters) of what was foretold, of each piece."""
        shapes = model.variants(x, self._layout.full, self._shape_free)
        at_mean = np.array([float(chain.fraction(self._mean, shape)) for shape in shapes])
        left, slopes = [], []
        for (values, skip, piece), lift in zip(self._each(), self._lift, strict=True):
            thrust = chain.shown(piece, shapes, self._filters) / at_mean[:, None, None]
            # Battery, height and speed change what a rotor gives at the same output: the accelerometer says how much.
            total = _slow(thrust.mean(axis=2).T, piece.dt_s).T
            thrust = thrust * (lift[:, 0] / self.lift_m_s2 / np.maximum(total, 1e-3))[:, :, None]
            value, derivative = model.foretold(x, self._layout, thrust[:, skip:], self._shape_free, piece.dt_s)
            left.append(values[skip:, : model.AXES] - value.T)
            slopes.append(derivative)
        return left, slopes


def _triangle(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """(c, c) upper, with the squares of ``rows`` (N, c); first block by block, as much as a processor's cache holds."""
    blocks = len(rows) // _BLOCK
    each = np.linalg.qr(rows[: blocks * _BLOCK].reshape(blocks, _BLOCK, -1), mode="r") if blocks else rows[:0]
    left = np.concatenate([np.asarray(each).reshape(-1, rows.shape[1]), rows[blocks * _BLOCK :]])
    return np.asarray(np.linalg.qr(left, mode="r"))


def _slow(values: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """Columns (N, c) smoothed forwards and backwards."""
    return chain.smoothed_both_ways(values, dt_s, _LIFT_S)


def _band(values: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    return chain.band(values, dt_s, 2.0, 8.0)


@dataclass(frozen=True, slots=True)
class Course:
    """Of the longest piece: ``time_s`` (N,), accelerations (N, AXES) as measured and as foretold."""

    time_s: NDArray[np.float64]
    measured: NDArray[np.float64]
    foretold: NDArray[np.float64]


def course(
    record: Record, layout: Layout, filters: chain.Filters, inertia: tuple[float, float, float], x: NDArray[np.float64]
) -> Course:
    """What the parameters ``x`` say of a record."""
    longest = Record([max(record.pieces, key=lambda piece: piece.samples)])
    return Problem(longest, layout, filters, inertia, x, np.zeros(layout.parameters)).course(x)


def fit(
    record: Record,
    layout: Layout,
    filters: chain.Filters,
    inertia: tuple[float, float, float],
    start: NDArray[np.float64],
    prior: Prior = BELIEVED,
    rounds: int = ROUNDS,
) -> Fit:
    """From the parameters ``start`` (whose gains are taken from the record), believed as ``prior`` says."""
    x_start, deviations = start, prior.deviations(layout.motors)
    start = Problem(record, layout, filters, inertia, start, deviations).suggested(start)
    problem = Problem(record, layout, filters, inertia, start, deviations)
    free, x, explained = problem.free, start, np.zeros(model.AXES)
    for _ in range(rounds):
        explained = problem.colour(x)
        scale = deviations[free]
        found = least_squares(problem.residual, x[free], problem.jacobian, x_scale=scale, max_nfev=20, xtol=1e-4)
        x = problem.whole(found.x)
    made = _lifted(_known(problem, x, free, explained, prior), problem.steepness_seen(x))
    trim = np.r_[model.motors_of(layout), model.centre_of(layout)]
    if prior.motor > 0.0 and (np.abs(x[trim]) > _NO_VEHICLE * deviations[trim]).any():
        return _without_trim(made, record, filters, inertia, x_start, prior, rounds)
    return made


def _known(
    problem: Problem, x: NDArray[np.float64], free: NDArray[np.int64], explained: NDArray[np.float64], prior: Prior
) -> Fit:
    """What was found, and how well that is known."""
    layout = problem.layout
    deviations = prior.deviations(layout.motors)
    trim = np.r_[model.motors_of(layout), model.centre_of(layout)]
    jacobian = problem.jacobian(x[free])
    covariance = np.zeros((len(x), len(x)))
    # In deviations of the prior, so that no number is so much smaller than others that rounding eats it.
    scaled = jacobian * deviations[free]
    root = solve_triangular(np.asarray(np.linalg.qr(scaled, mode="r")), np.diag(deviations[free]), trans="T")
    covariance[np.ix_(free, free)] = root.T @ root  # by its root: no variance comes out below 0
    # What a command does is measured, so that a curve too steep leaves the gains too small.
    together = np.eye(len(x))
    together[[model.SHAPE + axis for axis in _TURNING]] -= model.steepness(x, layout, problem.mean_output)[1]
    covariance += together @ np.diag(_left_out(layout) * (deviations > 0.0)) @ together.T
    if prior.motor == 0.0:
        covariance[trim, trim] = BELIEVED.deviations(layout.motors)[trim] ** 2
    if prior.yaw == 0.0:
        covariance[model.SHAPE + model.YAW, model.SHAPE + model.YAW] = _UNSEEN**2
    return Fit(x, covariance, deviations, layout, problem.mean_output, explained)


def _lifted(made: Fit, seen: tuple[float, float] | None) -> Fit:
    """``made`` with the steepness of the curve as a change of the outputs lifts, ``seen``: a logarithm and its
    deviation. How much less sure the rest of the record is of the curve than noise says, is in the covariance alone."""
    if seen is None:
        return made
    target, deviation = seen
    steep, slope = model.steepness(made.x, made.layout, made.mean_output)
    spread = made.covariance @ slope
    gain = spread / (float(slope @ spread) + deviation**2)
    covariance = made.covariance - np.outer(gain, spread)
    return replace(made, x=made.x + gain * (target - float(np.log(steep))), covariance=covariance)


def _without_trim(
    made: Fit,
    record: Record,
    filters: chain.Filters,
    inertia: tuple[float, float, float],
    start: NDArray[np.float64],
    prior: Prior,
    rounds: int,
) -> Fit:
    """``made`` of a record that tells nothing of motors unlike and the centre of mass: the air was taken for them. The
    companion learns them anew in each flight (core/balance.py).

    The curve stays as it was found beside them: with the trim held to motors all alike, only a flat curve explains that
    their outputs differ (by 0.45 of its exponent on one of 12 flights, now 0.05).
    """
    start = start.copy()
    start[_CURVE] = made.x[_CURVE]
    held = replace(prior, motor=0.0, centre=0.0, expo=0.0, idle=0.0)
    again = fit(record, made.layout, filters, inertia, start, held, rounds)
    moves = np.eye(len(start))[:, _CURVE]
    moves[[model.SHAPE + axis for axis in _TURNING]] -= model.steepness(again.x, again.layout, again.mean_output)[1][
        _CURVE
    ]
    covariance = again.covariance + moves @ made.covariance[np.ix_(_CURVE, _CURVE)] @ moves.T
    before = again.prior.copy()
    before[_CURVE] = made.prior[_CURVE]
    return replace(again, covariance=covariance, prior=before)


def _left_out(layout: Layout) -> NDArray[np.float64]:
    """Variances (parameters,) that noise knows nothing of."""
    out = np.zeros(layout.parameters)
    out[: model.SHAPE] = _LEFT_OUT_SHAPE
    out[model.gains_of(layout)] = _LEFT_OUT_GAIN
    out[model.motors_of(layout)] = _LEFT_OUT_MOTOR
    out[model.centre_of(layout)] = _LEFT_OUT_CENTRE
    return out**2
