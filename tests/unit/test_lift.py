"""How steep the thrust curve is, by what a change of the outputs lifts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.calibration.lift import lift_slope

DT_S = 0.005


def thrust_of(rng: np.random.Generator, seconds: float = 60.0, size: float = 0.05) -> NDArray[np.float64]:
    """(N,) About 1, changing within half a second."""
    out, at = [], 0.0
    for step in rng.standard_normal(round(seconds / DT_S)):
        at += 0.01 * (10.0 * step - at)
        out.append(at)
    values = np.array(out)
    return np.asarray(0.6 * (1.0 + size * values / values.std()))


@pytest.mark.parametrize("ratio", [0.6, 0.9, 1.4])
def test_the_ratio_is_found_beside_climb_gusts_and_a_battery_that_runs_down(
    ratio: float, rng: np.random.Generator
) -> None:
    thrust = thrust_of(rng)
    climb, gusts = np.cumsum(thrust / thrust.mean() - 1.0) * 0.05, thrust_of(rng) / 0.6 - 1.0
    climb, time = climb - climb.mean(), np.linspace(-0.5, 0.5, len(thrust))
    up = 9.81 * (1.0 + ratio * (thrust / thrust.mean() - 1.0) - 0.02 * climb + 0.3 * gusts - 0.05 * time)
    up = up + 0.05 * rng.standard_normal(len(up))
    found = lift_slope([up], [thrust], [climb[:, None]], DT_S)
    assert found is not None
    assert abs(found.ratio - ratio) < 4.5 * ratio * found.deviation
    assert 0.0 < found.deviation < 0.06


def test_without_change_of_thrust_or_an_answer_to_it_nothing_is_said(rng: np.random.Generator) -> None:
    still, moved = thrust_of(rng, size=0.002), thrust_of(rng)
    air = [np.zeros((len(still), 0))]
    noise = 9.81 + 0.5 * rng.standard_normal(len(still))
    assert lift_slope([9.81 * still / 0.6], [still], air, DT_S) is None
    assert lift_slope([noise - 3.0 * (moved - 0.6)], [moved], air, DT_S) is None
    assert lift_slope([noise[:50]], [moved[:50]], [air[0][:50]], DT_S) is None


def test_the_ends_of_a_short_record_say_nothing(rng: np.random.Generator) -> None:
    """Where the filter lacks a half, a hover looked like all its thrust gone and back."""
    hover, moved = thrust_of(rng, 10.0, size=0.0005), thrust_of(rng, 10.0)
    air = [np.zeros((len(hover), 0))]
    assert lift_slope([9.81 * hover / 0.6 + 0.01 * rng.standard_normal(len(hover))], [hover], air, DT_S) is None
    found = lift_slope([9.81 * (0.2 + 0.8 * moved / moved.mean())], [moved], air, DT_S)
    assert found is not None
    assert found.ratio == pytest.approx(0.8, abs=0.01)


def test_pieces_too_short_are_left_out(rng: np.random.Generator) -> None:
    moved, short = thrust_of(rng, 30.0), thrust_of(rng, 0.5)
    air = [np.zeros((len(each), 0)) for each in (moved, short)]
    found = lift_slope([9.81 * moved, -short], [moved, short], air, DT_S)
    assert found is not None
    assert found.ratio == pytest.approx(1.0, abs=0.01)
