"""Full matrix adaptation (6.19)-(6.32): batch solution, continuous law, and its Lyapunov function."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.trials.research.full_matrix import FullMatrix, FullMatrixOptions

N, M = 4, 8


def test_it_is_the_batch_minimum_of_its_cost(rng: np.random.Generator) -> None:
    options, dt, steps = FullMatrixOptions(forget_s=0.7, regularisation=0.05), 0.005, 400
    adaptation = FullMatrix(N, M, options)
    state = adaptation.start()
    thrusts, residuals = rng.uniform(0, 1, (steps, M)), rng.standard_normal((steps, N))
    for u, y in zip(thrusts, residuals, strict=True):
        state = adaptation.step(state, u, y, dt)
    keep = np.exp(-dt / options.forget_s)
    weight = (1 - keep) * options.forget_s * keep ** np.arange(steps - 1, -1, -1)
    gram = (thrusts.T * weight) @ thrusts + options.regularisation * np.eye(M)
    np.testing.assert_allclose(state.matrix, (residuals.T * weight) @ thrusts @ np.linalg.inv(gram), atol=1e-9)


def test_it_follows_the_printed_differential_equations(rng: np.random.Generator) -> None:
    o = FullMatrixOptions(forget_s=0.5, regularisation=0.3, composite=1.0)
    adaptation = FullMatrix(N, M, o)
    state = adaptation.start()
    p, b = np.eye(M) / o.regularisation, np.zeros((N, M))
    truth, s = 0.3 * rng.standard_normal((N, M)), rng.standard_normal(N)
    dt, fine = 0.005, 200
    for _ in range(200):
        u = rng.uniform(0, 1, M)
        y = truth @ u
        state = adaptation.step(state, u, y, dt, s)
        for _ in range(fine):
            h = dt / fine
            slope = -np.outer(b @ u - y, u) @ p - o.regularisation / o.forget_s * b @ p + np.outer(s, u) @ p
            p = p + h * (p / o.forget_s - p @ (o.regularisation / o.forget_s * np.eye(M) + np.outer(u, u)) @ p)
            b = b + h * slope
    np.testing.assert_allclose(state.matrix, b, atol=5e-3 * np.abs(b).max())


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.2]))
def test_its_lyapunov_function_falls_outside_the_bound(seed: int, regularisation: float) -> None:
    """V = s^T M s + tr(Btilde P^-1 Btilde^T) (6.33 ff.) in closed loop, M s' = -K s - Btilde u, falls while
    sqrt(V) > D / alpha, D = |(l2/l1) P^(1/2) (B - B0)^T|_F; for l2 = 0 always."""
    draw = np.random.default_rng(seed)
    o = FullMatrixOptions(forget_s=0.8, regularisation=max(regularisation, 1e-9), composite=1.0)
    adaptation = FullMatrix(N, M, o)
    state = adaptation.start()
    state.information = np.eye(M)  # known a little: l2 = 0 starts without any knowledge otherwise
    truth = 0.3 * draw.standard_normal((N, M))
    mass = np.diag(draw.uniform(0.5, 2.0, N))
    slow = 0.4  # 1/s: too slow to hide what the adaptation does
    gain = slow * mass
    s, dt = draw.standard_normal(N), 2e-4
    frequency, phase = draw.uniform(2, 20, M), draw.uniform(0, 6, M)
    before, before_bound = np.inf, np.inf
    for step in range(1500):
        u = 0.5 + 0.4 * np.sin(frequency * step * dt + phase)
        error = state.matrix - truth
        value = float(s @ mass @ s + np.trace(error @ state.information @ error.T))
        root = np.linalg.cholesky(np.linalg.inv(state.information))
        bound = float(o.regularisation / o.forget_s * np.linalg.norm(root.T @ truth.T))
        assert value <= before * (1 + 1e-6) + 1e-12 or np.sqrt(before) <= before_bound, (seed, step)
        alpha = min(adaptation.rate(state, u), slow)
        before, before_bound = value, bound / max(alpha, 1e-9)
        # s is the tracking error of the state whose derivative the residual is part of.
        y = truth @ u
        state = adaptation.step(state, u, y, dt, s)
        s = s + dt * np.linalg.solve(mass, -gain @ s - error @ u)
