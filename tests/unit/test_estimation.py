"""Every recursion equals its batch solution; the sparse program is the one that is written down."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, signal

from nff_companion.core import hypotheses, sparse
from nff_companion.core.decision import Decision, DecisionState
from nff_companion.core.disturbance import Disturbance, SideDragState, learn_side_drag
from nff_companion.core.filters import LowPass, lag_share, loss_response
from nff_companion.core.onset import OnsetBank
from nff_companion.core.residual import ResidualFilter
from nff_companion.core.tuning import SparseTuning, Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Hypothesis
from nff_companion.errors import SolverError

DT = 0.005
TUNING = Tuning()
CORRELATION_S, SMOOTHING_S = TUNING.disturbance.correlation_s, TUNING.residual.smoothing_s
MODEL_ERROR_SHARE, YAW_ERROR_SHARE = TUNING.onset.model_error_share, TUNING.onset.yaw_error_share
TOGETHER_ERROR_SHARE = np.array(TUNING.onset.together_error_share)
SINGLE_ERROR_SHARE = TUNING.onset.single_error_share


def data(
    rng: np.random.Generator, octo: Vehicle, samples: int, loss: NDArray[np.float64], noise: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    b = octo.acceleration_effectiveness
    u = 0.4 + 0.1 * rng.standard_normal((samples, 8))
    y = np.einsum("ni,ki,i->kn", b, u, loss) + noise * rng.standard_normal((samples, 4))
    return b, u, y


def test_information_recursion_equals_the_batch_sums(octo: Vehicle, rng: np.random.Generator) -> None:
    b, u, y = data(rng, octo, 300, np.zeros(8), noise=1.0)
    weight = rng.uniform(0.5, 2.0, 4)
    forgetting = 3.0
    state = sparse.Information.empty(8)
    for k in range(300):
        state = sparse.update(state, b * u[k], y[k], weight, DT, forgetting)
    age = np.exp(-forgetting * DT * np.arange(299, -1, -1))
    matrix = sum(a * DT * (b * w).T @ np.diag(weight) @ (b * w) for a, w in zip(age, u, strict=True))
    vector = sum(a * DT * (b * w).T @ (weight * v) for a, w, v in zip(age, u, y, strict=True))
    np.testing.assert_allclose(state.matrix, matrix, rtol=1e-10)
    np.testing.assert_allclose(state.vector, vector, rtol=1e-10)


def test_sparse_step_is_the_minimum_of_the_written_cost(octo: Vehicle, rng: np.random.Generator) -> None:
    loss = np.zeros(8)
    loss[[2, 5]] = -0.8, -0.3
    b, u, y = data(rng, octo, 80, loss, noise=0.2)
    gamma = 0.1
    state = sparse.Information.empty(8)
    for k in range(80):
        state = sparse.update(state, b * u[k], y[k], np.ones(4), DT, 0.0)

    def cost(e: NDArray[np.float64]) -> float:
        misfit = y - np.einsum("ni,ki,i->kn", b, u, e)
        return 0.5 * DT * float((misfit**2).sum()) + gamma * float(np.abs(e).sum())

    # |e|_1 = -sum e in the box: bounded least squares, its right side moved so that A'b gains gamma in each entry.
    a, right = np.sqrt(DT) * (b * u[:, None, :]).reshape(-1, 8), np.sqrt(DT) * y.ravel()
    right = right + a @ np.linalg.solve(a.T @ a, np.full(8, gamma))
    best = optimize.lsq_linear(a, right, bounds=(-1.0, 0.0), method="bvls", tol=1e-12).x
    e = sparse.solve(state, gamma)
    assert cost(e) <= cost(best) + 1e-5
    np.testing.assert_allclose(e, best, atol=2e-2)
    assert e[2] == pytest.approx(-0.8, abs=0.1)
    assert np.count_nonzero(e < -0.05) == 2


def test_sparse_step_agrees_with_osqp(octo: Vehicle, rng: np.random.Generator) -> None:
    import osqp
    from scipy import sparse as scipy_sparse

    b, u, y = data(rng, octo, 60, -rng.uniform(0, 1, 8), noise=1.0)
    state = sparse.Information.empty(8)
    for k in range(60):
        state = sparse.update(state, b * u[k], y[k], np.ones(4), DT, 0.0)
    peer = osqp.OSQP()
    hessian = state.matrix + np.eye(8) * 1e-6 * np.trace(state.matrix)
    peer.setup(
        scipy_sparse.csc_matrix(np.triu(hessian)),
        -(state.vector + 1.0),
        scipy_sparse.identity(8, format="csc"),
        -np.ones(8),
        np.zeros(8),
        verbose=False,
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=50000,
    )
    np.testing.assert_allclose(sparse.solve(state, 1.0), peer.solve().x, atol=1e-4)


def test_the_other_sign_of_gamma_would_drive_healthy_motors_to_minus_one(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    b, u, y = data(rng, octo, 2, np.zeros(8))
    state = sparse.update(sparse.Information.empty(8), b * u[0], y[0], np.ones(4), DT, 0.0)
    assert np.abs(sparse.solve(state, 50.0)).max() < 1e-12
    assert sparse.solve(state, -50.0).min() == -1.0


def test_where_no_loss_would_pay_the_program_need_not_be_solved(octo: Vehicle, rng: np.random.Generator) -> None:
    b, u, y = data(rng, octo, 40, np.zeros(8), noise=1.0)
    state = sparse.Information.empty(8)
    for k in range(40):
        state = sparse.update(state, b * u[k], y[k], np.ones(4), DT, 0.0)
    gamma = float(-state.vector.min()) * (1.0 + 1e-9)
    assert not sparse.solve(state, gamma).any()
    np.testing.assert_allclose(sparse._box_program(state.matrix.copy(), -(state.vector + gamma), None), 0.0, atol=1e-6)
    assert sparse.solve(state, 0.9 * gamma).min() < 0.0, "just below, one does"


def test_what_is_not_finite_is_no_quiet_sum(octo: Vehicle) -> None:
    state = sparse.Information(matrix=np.eye(8), vector=np.full(8, np.nan))
    with pytest.raises(SolverError):
        sparse.solve(state, 1.0)


def test_an_undriven_motor_keeps_no_opinion(octo: Vehicle) -> None:
    b = octo.acceleration_effectiveness
    u = np.full(8, 0.4)
    u[3] = 0.0
    state = sparse.update(sparse.Information.empty(8), b * u, -b[:, 3] * 0.4, np.ones(4), DT, 0.0)
    assert sparse.solve(state, 1.0)[3] == 0.0


@pytest.mark.parametrize(
    ("eta", "shaped"), [(1.0, 1.0), (0.75, 1.0), (0.525, 0.5), (0.30, 0.0), (0.29, 0.0), (0.0, 0.0)]
)
def test_shaping_is_equation_24(eta: float, shaped: float) -> None:
    assert sparse.shape(np.array([eta]), 0.75, 0.30)[0] == pytest.approx(shaped)


def test_low_pass_and_lag_equal_scipy(rng: np.random.Generator) -> None:
    low_pass = LowPass.design(20.0, DT)
    assert low_pass is not None
    x = rng.standard_normal((200, 3))
    state = low_pass.settled(np.zeros(3))
    mine = []
    for row in x:
        state, out = low_pass.step(state, row)
        mine.append(out)
    b, a = signal.butter(2, 20.0, fs=1 / DT)
    np.testing.assert_allclose(mine, signal.lfilter(b, a, x, axis=0), atol=1e-9)
    share = lag_share(DT, 0.045)
    lagged, step = 0.0, []
    for _ in range(50):
        lagged += share * (1.0 - lagged)
        step.append(lagged)
    np.testing.assert_allclose(step, 1 - np.exp(-DT * np.arange(1, 51) / 0.045), atol=1e-12)


def test_residual_of_a_vehicle_that_does_what_the_model_says_is_nought(octo: Vehicle, rng: np.random.Generator) -> None:
    """Thrusts through lag, exact integration and the same gyro filter: no transient may remain."""
    chain = ResidualFilter(octo, DT)
    chain._inertia = [1.0, 1.0, 1.0]  # no gyroscopic torque: it is checked below, by itself
    b = octo.acceleration_effectiveness
    low_pass = LowPass.design(octo.telemetry.gyro_filter_hz, DT)
    assert low_pass is not None
    command = np.full(8, octo.hover)
    lagged = command.copy()
    up, down = (lag_share(DT, t) for t in (octo.motor.time_constant_up_s, octo.motor.time_constant_down_s))
    shown_state = low_pass.settled(b @ lagged)
    shown = b @ lagged
    gyro = np.zeros(3)
    state = chain.start(gyro, np.array([0, 0, -shown[0]]), command)
    worst = 0.0
    for _ in range(400):
        before, command = command, np.clip(octo.hover + 0.1 * rng.standard_normal(8), 0, 1)
        held = 0.5 * (before + command)
        lagged = lagged + np.where(held > lagged, up, down) * (held - lagged)
        last = shown
        shown_state, shown = low_pass.step(shown_state, b @ lagged)
        gyro = gyro + DT * 0.5 * (last[1:] + shown[1:])
        state = chain.step(state, gyro, np.array([0, 0, -shown[0]]), command, DT)
        worst = max(worst, float(np.abs(state.measured - b @ state.thrust_shown).max()))
    assert worst < 1e-9


def test_gyroscopic_torque_is_part_of_the_model(octo: Vehicle) -> None:
    """A free body that spins about all axes: Euler's equation moves its rates, and nothing is left over."""
    chain = ResidualFilter(octo, 0.001)
    j, w = octo.inertia_kg_m2, np.array([1.0, -0.7, 0.5])
    nothing = np.zeros(8)
    state = chain.start(w, np.zeros(3), nothing)
    for _ in range(500):
        middle = w - 0.0005 * np.cross(w, j * w) / j
        w = w - 0.001 * np.cross(middle, j * middle) / j
        state = chain.step(state, w, np.zeros(3), nothing, 0.001)
    assert np.abs(state.measured[1:]).max() < 1e-3 * np.abs(np.cross(w, j * w) / j).max()


def test_onset_sums_equal_sums_over_the_history(octo: Vehicle, rng: np.random.Generator) -> None:
    bank = OnsetBank(octo, DT, LowPass.design(20.0, DT), TUNING)
    b, u, y = data(rng, octo, 90, np.zeros(8), noise=3.0)
    state = bank.start()
    for k in range(90):
        state = bank.push(state, u[k], y[k], b, 0.5 * u[k])
    variance = np.array([0.1, 2.0, 2.0, 0.3])
    sums = bank.sums(state, b, variance, 0.01)
    response = loss_response(DT, bank.length, 0.045, LowPass.design(20.0, DT), SMOOTHING_S)
    counts = [round(a / DT) for a in sums.age_s]
    energy = np.array([(y[-c:] ** 2).sum(axis=0) for c in counts])
    level = (energy / np.array(counts)[:, None]).max(axis=0)
    error = MODEL_ERROR_SHARE**2 * level
    error[3] += ((octo.inertia_kg_m2[:2] / octo.inertia_kg_m2[2]) ** 2 @ level[1:3]) * (YAW_ERROR_SHARE**2 + 0.01**2)
    half = 0.5 * b * u[:, None, :]
    doubt = TOGETHER_ERROR_SHARE**2 * half.sum(axis=2) ** 2 + SINGLE_ERROR_SHARE**2 * (half**2).sum(axis=2)
    error += np.array([doubt[-c:].mean(axis=0) for c in counts]).max(axis=0)
    w = np.diag(DT / (CORRELATION_S * (variance + error)))
    for row, count in enumerate(counts[:-2]):  # the last two windows are for standing losses
        g = response[:count]
        matrix = sum(gk**2 * (b * v).T @ w @ (b * v) for gk, v in zip(g, u[-count:], strict=True))
        vector = sum(gk * (b * v).T @ w @ r for gk, v, r in zip(g, u[-count:], y[-count:], strict=True))
        np.testing.assert_allclose(sums.matrix[row], matrix, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(sums.vector[row], vector, rtol=1e-8, atol=1e-8)
        assert sums.energy[row] == pytest.approx(float(np.trace(w @ np.diag(energy[row]))), rel=1e-9)


def test_pairs_are_searched_exactly(octo: Vehicle, rng: np.random.Generator) -> None:
    b, u, y = data(rng, octo, 40, -rng.uniform(0, 1, 8), noise=1.0)
    state = sparse.Information.empty(8)
    for k in range(40):
        state = sparse.update(state, b * u[k], y[k], np.ones(4), DT, 0.0)
    first, second = np.triu_indices(8, 1)
    scores = hypotheses.pairs(state.matrix[None], state.vector[None], 1.0, first, second)
    for h in range(len(first)):
        chosen = [first[h], second[h]]
        s, q = state.matrix[np.ix_(chosen, chosen)], state.vector[chosen] + 1.0
        middle, reach, value = np.array([-0.5, -0.5]), 0.5, np.array(-np.inf)
        for _ in range(6):  # finer and finer grids around the best point so far
            x, z = np.meshgrid(*(np.clip(np.linspace(-reach, reach, 101) + c, -1.0, 0.0) for c in middle))
            value = q[0] * x + q[1] * z - 0.5 * (s[0, 0] * x * x + 2 * s[0, 1] * x * z + s[1, 1] * z * z)
            best = np.unravel_index(value.argmax(), value.shape)
            middle, reach = np.array([x[best], z[best]]), reach / 10.0
        assert scores.improvement[0, h] == pytest.approx(value.max(), rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(scores.e[0, h], middle, atol=1e-3)


def test_nuisance_motors_take_no_blame_and_give_none(octo: Vehicle, rng: np.random.Generator) -> None:
    """A declared motor that still pushes must not make its opposite look dead."""
    b = octo.acceleration_effectiveness
    state, energy_before = sparse.Information.empty(8), 0.0
    for _ in range(60):
        u = 0.4 + 0.05 * rng.standard_normal(8)
        y = 0.5 * b[:, 0] * u[0]  # motor 1, modelled as dead, pushes with half its thrust
        state = sparse.update(state, b * u, y, np.ones(4), DT, 0.0)
        energy_before += DT * float(y @ y)
    matrix, vector, energy, free = hypotheses.without_nuisance(
        state.matrix[None], state.vector[None], np.array([energy_before]), np.array([0])
    )
    assert free[0, 0] == pytest.approx(0.5, abs=1e-3)
    assert np.abs(vector).max() < 1e-3 * np.abs(state.vector).max()
    assert energy[0] < 1e-3 * energy_before
    assert not matrix[0, 0].any()


@pytest.mark.parametrize("gone", [[2], [0, 5], [1, 4, 6]])
def test_beside_declared_motors_the_sparse_step_is_that_of_the_schur_complement(
    octo: Vehicle, rng: np.random.Generator, gone: list[int]
) -> None:
    loss = np.zeros(8)
    loss[[gone[0], 7]] = -0.6, -0.7
    b, u, y = data(rng, octo, 80, loss, noise=0.3)
    state = sparse.Information.empty(8)
    for k in range(80):
        state = sparse.update(state, b * u[k], y[k] + b[:, gone] @ u[k, gone], np.ones(4), DT, 0.0)
    failed = np.isin(np.arange(8), gone)
    matrix, vector, _, free = hypotheses.without_nuisance(
        state.matrix[None], state.vector[None], np.zeros(1), np.array(gone)
    )
    tuning = SparseTuning(gamma=0.1)
    eta = sparse.effectiveness(state, failed, tuning)
    rest = sparse.Information(matrix[0], vector[0])
    np.testing.assert_allclose(eta[~failed], 1.0 + sparse.solve(rest, tuning.gamma)[~failed], atol=1e-9)
    np.testing.assert_allclose(eta[gone], np.clip(free[0], 0.0, tuning.free_max), atol=1e-9)
    assert eta[7] < 0.6, "what the others lose is found beside them"


def test_side_drag_recursion_equals_batch_least_squares(rng: np.random.Generator) -> None:
    slopes = rng.standard_normal(400)
    truth, deviation = 0.8, 0.05
    y = truth * slopes + deviation * rng.standard_normal(400)
    state = SideDragState.start(TUNING.disturbance)
    prior_mean, prior_variance = state.share, state.variance
    noise = deviation**2 * CORRELATION_S / DT
    for slope, value in zip(slopes, y, strict=True):
        state = learn_side_drag(state, slope, value - state.share * slope, deviation**2, DT, TUNING.disturbance)
    precision = 1 / prior_variance + (slopes**2).sum() / noise
    batch = (prior_mean / prior_variance + (slopes * y).sum() / noise) / precision
    assert state.share == pytest.approx(batch, abs=2e-3)
    assert state.share == pytest.approx(truth, abs=0.02)


def test_the_disturbance_may_not_grow_into_the_place_of_a_motor(octo: Vehicle) -> None:
    disturbance = Disturbance(octo)
    state = disturbance.start()
    loss = -octo.acceleration_effectiveness[:, 0] * octo.hover
    for _ in range(20000):
        state = disturbance.step(state, state.basis, loss, DT)
    assert np.abs(disturbance.predict(state, state.basis)[1:3]).max() < 0.7 * np.abs(loss[1:3]).max()
    for _ in range(round(3.0 / DT)):
        state = disturbance.step(state, state.basis, np.zeros(4), DT)
    assert np.abs(disturbance.predict(state, state.basis)[1:3]).max() < 0.2 * np.abs(loss[1:3]).max(), "wound up"


def test_what_the_wind_turns_stays_with_the_wind_while_the_vehicle_turns(octo: Vehicle) -> None:
    """Roll and pitch torque of a wind from ahead are those of one from the left after a quarter turn to the right."""
    long = copy.copy(octo)
    long.inertia_kg_m2 = octo.inertia_kg_m2 * [0.7, 1.4, 1.0]
    for model in (octo, long):
        disturbance = Disturbance(model)
        state = disturbance.start()
        torque = 0.1 * model.inertia_kg_m2[:2] * disturbance.loss_scale[1:3].min()
        y = np.array([0.3, *(torque * [1.0, 0.5] / model.inertia_kg_m2[:2]), 0.02])
        for _ in range(4000):
            state = disturbance.step(state, state.basis, y, DT)
        before = disturbance.predict(state, state.basis)
        quarter = round(1.0 / DT)
        for _ in range(quarter):
            expectation = disturbance.expect(state, state.basis)
            state = disturbance.learn(state, expectation, y, DT, 0.0, turned_rad=0.5 * np.pi / quarter)
        after = disturbance.predict(state, state.basis)
        jx, jy = model.inertia_kg_m2[:2]
        np.testing.assert_allclose(after[1:3], [before[2] * jy / jx, -before[1] * jx / jy], rtol=1e-6)
        np.testing.assert_allclose(after[[0, 3]], before[[0, 3]])


def test_a_sudden_loss_shows_monotonically_from_nought_to_one() -> None:
    response = loss_response(DT, 200, 0.045, LowPass.design(20.0, DT), SMOOTHING_S)
    assert response[0] < 0.1
    assert response[-1] == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.diff(response) > -1e-3)


def test_a_constant_basis_is_the_mean_with_exponential_weights(octo: Vehicle, rng: np.random.Generator) -> None:
    disturbance = Disturbance(octo)
    y = 0.1 * disturbance.loss_scale * rng.standard_normal((300, 4))  # far from the bound on the mean
    state = disturbance.start()
    for row in y:
        state = disturbance.step(state, state.basis, row, DT)
    share = DT / TUNING.adaptation.follow_s
    weights = share * (1 - share) ** np.arange(299, -1, -1)
    np.testing.assert_allclose(disturbance.predict(state, state.basis), weights @ y, rtol=0.02, atol=1e-3)
    frozen = disturbance.step(state, state.basis, y[0], DT, rate=0.0)
    assert frozen.adaptation is state.adaptation, "frozen while a failure is weighed"


def test_a_joint_estimate_is_the_marginal_over_a_constant_error_of_the_disturbance(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    joint = 1.5
    bank = OnsetBank(octo, DT, None, TUNING, joint=joint)
    b, u, y = data(rng, octo, 90, np.zeros(8), noise=3.0)
    state = bank.start()
    for k in range(90):
        state = bank.push(state, u[k], y[k], b, u[k])
    variance = np.array([0.1, 2.0, 2.0, 0.3])
    plain = OnsetBank(octo, DT, None, TUNING).sums(state, b, variance, 0.0)
    together = bank.sums(state, b, variance, 0.0)
    response = loss_response(DT, bank.length, 0.045, None, SMOOTHING_S)
    row, count = 4, round(bank.sums(state, b, variance, 0.0).age_s[4] / DT)
    # The weight that both use, from a window's energy on each axis.
    axis_energy = (y[-count:] ** 2).sum(axis=0)
    level = np.array([(y[-round(a / DT) :] ** 2).sum(axis=0) / round(a / DT) for a in plain.age_s]).max(axis=0)
    total = variance + MODEL_ERROR_SHARE**2 * level
    total[3] += ((octo.inertia_kg_m2[:2] / octo.inertia_kg_m2[2]) ** 2 @ level[1:3]) * YAW_ERROR_SHARE**2
    weight = DT / (CORRELATION_S * total)
    assert plain.energy[row] == pytest.approx(float(axis_energy @ weight), rel=1e-9)
    matrix, vector = np.zeros((8, 8)), np.zeros(8)
    for axis in range(4):
        covariance = np.eye(count) / weight[axis] + joint**2 * variance[axis]
        regressor = response[:count, None] * u[-count:] * b[axis]
        matrix += regressor.T @ np.linalg.solve(covariance, regressor)
        vector += regressor.T @ np.linalg.solve(covariance, y[-count:, axis])
    np.testing.assert_allclose(together.matrix[row], matrix, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(together.vector[row], vector, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("motors", "loss", "age_s", "declared"),
    [
        ((3,), (0.70,), 0.065, True),  # still spinning down: its loss is not known well
        ((3,), (0.70,), 0.2, False),
        ((3,), (0.90,), 0.2, True),
        ((3, 5), (0.70, 0.72), 0.065, False),  # partly lost, two motors can look like any gust
        ((3, 5), (0.70, 0.95), 0.065, True),
        ((3, 5), (0.50, 1.00), 0.2, False),
    ],
)
def test_how_large_a_loss_must_be_depends_on_how_well_it_is_known(
    octo: Vehicle, motors: tuple[int, ...], loss: tuple[float, ...], age_s: float, declared: bool
) -> None:
    decision = Decision(octo.motors, octo.axes, TUNING.decision)
    state = DecisionState.start(octo.motors)
    best = Hypothesis(motors, loss, improvement=60.0, margin=20.0, explained=0.95, age_s=age_s)
    ones = np.ones(octo.motors)
    for k in range(20):
        state, events = decision.step(state, 0.005 * k, best, ones, 0.1 * ones, 0.4 * ones)
        if events:
            break
    assert [e.motor - 1 for e in events] == (list(motors) if declared else [])
