"""Samples in a row become their mean, and what must not be mixed is not."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.core.sample import Sample
from nff_companion.replay.flight import Row
from nff_companion.replay.table import Table
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


def table(rows: list[Row]) -> Table:
    samples = [sample for _, sample in rows]
    return Table(
        stamp_s=np.array([stamp for stamp, _ in rows]),
        time_s=np.array([s.time_s for s in samples]),
        gyro_rad_s=np.array([s.gyro_rad_s for s in samples]),
        specific_force_m_s2=np.array([s.specific_force_m_s2 for s in samples]),
        output=np.array([s.output for s in samples]),
        armed=np.array([s.armed for s in samples]),
    )


def test_columns_become_what_rows_become() -> None:
    times = np.delete(np.arange(800) / 400.0, slice(200, 290))
    whole = rows(times, [k > 40 for k in range(len(times))])
    one, other = thinned(whole), thinned(table(whole))
    assert len(one) == len(other) < len(whole) / 3
    for (stamp, sample), (stamp_of_column, column) in zip(one, other, strict=True):
        assert (stamp, sample.time_s, sample.armed) == (stamp_of_column, column.time_s, column.armed)
        assert sample.gyro_rad_s.tolist() == column.gyro_rad_s.tolist()
        assert sample.specific_force_m_s2.tolist() == column.specific_force_m_s2.tolist()
        assert sample.output.tolist() == column.output.tolist()
        assert column.thrust is None


def test_a_row_that_a_table_has_not_is_an_error_and_a_part_of_it_is_a_table() -> None:
    whole = table(rows(np.arange(10) / 50.0))
    assert whole[-1][1].time_s == pytest.approx(0.18)
    assert [sample.time_s for _, sample in whole[2:4]] == pytest.approx([0.04, 0.06])
    with pytest.raises(IndexError, match="row 10 of 10"):
        whole[10]
