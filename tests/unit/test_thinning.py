"""Samples in a row become their mean, and what must not be mixed is not."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.core.sample import Sample
from nff_companion.replay.flight import Row
from nff_companion.replay.thinning import thinned


def rows(times: np.ndarray, armed: list[bool] | None = None) -> list[Row]:
    return [
        (
            float(t) + 0.5,
            Sample(
                time_s=float(t),
                gyro_rad_s=np.array([t, 2.0 * t, 0.0]),
                specific_force_m_s2=np.array([0.0, 0.0, -9.8 - t]),
                output=np.full(4, t),
                armed=True if armed is None else armed[k],
            ),
        )
        for k, t in enumerate(times)
    ]


def test_four_samples_of_400_hz_become_one_of_100() -> None:
    out = thinned(rows(np.arange(400) / 400.0))
    assert len(out) == 100
    times = np.array([sample.time_s for _, sample in out])
    assert np.diff(times) == pytest.approx(0.01)
    for _, sample in out:
        assert sample.gyro_rad_s[:2] == pytest.approx([sample.time_s, 2.0 * sample.time_s])
        assert sample.output == pytest.approx(np.full(4, sample.time_s))


def test_slow_samples_stay_as_they_are() -> None:
    slow = rows(np.arange(100) / 50.0)
    assert thinned(slow) is slow


def test_nothing_is_averaged_over_a_gap_or_over_arming() -> None:
    times = np.concatenate([np.arange(0.0, 0.05, 0.0025), 1.0 + np.arange(0.0, 0.05, 0.0025)])
    armed = [k >= 10 for k in range(len(times))]
    for _, sample in thinned(rows(times, armed)):
        assert sample.time_s < 0.05 or sample.time_s >= 1.0
        assert sample.armed == (sample.time_s >= 0.025)


def test_an_output_that_is_not_known_leaves_its_mean_unknown() -> None:
    some = rows(np.arange(400) / 400.0)
    some[5][1].output[2] = np.nan
    out = thinned(some)
    assert np.isnan(out[1][1].output[2])
    assert np.isfinite(out[0][1].output).all()
    assert np.isfinite(out[2][1].output).all()


def test_samples_that_come_in_pairs_are_not_thrown_away() -> None:
    paired = rows(np.repeat(np.arange(200) / 400.0, 2))
    assert thinned(paired) is paired
    bursts = rows(np.concatenate([k + np.arange(3) / 400.0 for k in range(40)]))
    assert thinned(bursts) is bursts
