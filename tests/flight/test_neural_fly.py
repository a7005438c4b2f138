"""Adaptation of phi a: the discrete law is the batch solution, and follows the continuous one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core.adaptation import Adaptation
from nff_companion.core.tuning import AdaptationTuning

K, N = 4, 3


def basis_at(time_s: float) -> NDArray[np.float64]:
    return np.array([np.sin(time_s), np.cos(0.7 * time_s), np.sin(2.3 * time_s + 1.0), 1.0])


def test_without_drive_it_is_regularised_least_squares(rng: np.random.Generator) -> None:
    prior, spread = rng.standard_normal((K, N)), np.diag(rng.uniform(0.5, 2.0, K))
    adaptation = Adaptation(prior, AdaptationTuning(follow_s=1e9), spread)
    state, dt = adaptation.start(), 0.01
    rows = [rng.standard_normal(K) for _ in range(300)]
    targets = [rng.standard_normal(N) for _ in rows]
    for phi, y in zip(rows, targets, strict=True):
        state = adaptation.step(state, phi, y, dt)
    phi, y = np.array(rows), np.array(targets)
    precision = np.linalg.inv(spread) + dt * phi.T @ phi
    batch = np.linalg.solve(precision, np.linalg.inv(spread) @ prior + dt * phi.T @ y)
    np.testing.assert_allclose(state.a, batch, atol=1e-9)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(precision), atol=1e-9)


@pytest.mark.parametrize("composite", [0.0, 1.0])
def test_it_converges_to_the_continuous_law(rng: np.random.Generator, composite: float) -> None:
    """a' = -lam (a - a0) - P phi^T (phi a - y) + P phi^T s,  P' = -2 lam P + Q - P phi^T phi P, by fine Euler steps."""
    lam, follow = 0.3, 0.8
    prior = rng.standard_normal((K, N))
    truth = rng.standard_normal((K, N))
    tracking = rng.standard_normal(N)
    options = AdaptationTuning(follow_s=follow, forget_per_s=lam, composite=composite)
    errors = []
    for dt in (0.02, 0.005):
        adaptation = Adaptation(prior, options)
        state = adaptation.start()
        a, p = prior.copy(), np.eye(K) / follow
        fine = 50
        for step in range(round(4.0 / dt)):
            phi = basis_at(step * dt)
            y = phi @ truth
            state = adaptation.step(state, phi, y, dt, tracking)
            for _ in range(fine):
                h = dt / fine
                slope = -lam * (a - prior) - np.outer(p @ phi, phi @ a - y)
                a = a + h * (slope + composite * np.outer(p @ phi, tracking))
                p = p + h * (-2 * lam * p + np.eye(K) / follow**2 - np.outer(p @ phi, phi @ p))
        errors.append(float(np.abs(state.a - a).max()))
    assert errors[1] < 0.5 * errors[0] < 0.1


def test_the_covariance_stays_definite_at_any_rate(rng: np.random.Generator) -> None:
    adaptation = Adaptation(np.zeros((K, N)), AdaptationTuning(follow_s=0.05, forget_per_s=0.5))
    state = adaptation.start()
    for _ in range(3000):
        state = adaptation.step(state, 30.0 * rng.standard_normal(K), rng.standard_normal(N), rng.uniform(0.001, 0.1))
        assert np.linalg.eigvalsh(state.covariance).min() > 0.0
    assert np.isfinite(state.a).all()


def test_functions_that_a_flight_does_not_excite_gather_no_variance_for_ever() -> None:
    """Twenty minutes of hover, then forward flight: one sample may not take a large part of the innovation."""
    adaptation = Adaptation(np.zeros((K, N)), AdaptationTuning())
    state = adaptation.start()
    fresh = float(state.covariance.trace())
    hover, forward = np.eye(K)[-1], np.ones(K)
    for _ in range(20 * 60 * 50):
        state = adaptation.step(state, hover, np.ones(N), 0.02)
    assert float(state.covariance.trace()) <= 2.0 * fresh
    np.testing.assert_allclose(hover @ state.a, 1.0, atol=1e-3)
    before = forward @ state.a
    state = adaptation.step(state, forward, before + 1.0, 0.005)
    assert float(np.abs(forward @ state.a - before).max()) < 0.05
