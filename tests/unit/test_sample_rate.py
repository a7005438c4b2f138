"""At which rate samples come, whatever is heard twice or missed."""

from __future__ import annotations

import pytest

from nff_companion.core.sample_rate import Agreement, SampleRate


@pytest.mark.parametrize("copies", [1, 2, 3])
def test_a_sample_that_is_heard_again_counts_once(copies: int) -> None:
    rate = SampleRate()
    for k in range(400):
        for _ in range(copies):
            rate.add(0.005 * k)
    assert rate.hz == pytest.approx(200.0)


def test_gaps_and_a_clock_that_begins_anew_leave_the_rate_right() -> None:
    rate = SampleRate()
    for k in range(400):
        if k % 10:
            rate.add(5.0 + 0.005 * k)
    assert rate.hz == pytest.approx(200.0)
    rate.add(0.1)
    assert rate.hz is None, "nothing of the clock before"
    for k in range(1, 400):
        rate.add(0.1 + 0.01 * k)
    assert rate.hz == pytest.approx(100.0)


@pytest.mark.parametrize(("rate_hz", "built_hz"), [(201.0, 200.0), (190.0, 190.0), (215.0, 215.0), (175.0, 200.0)])
def test_what_is_built_is_what_arrives_within_what_was_agreed(rate_hz: float, built_hz: float) -> None:
    agreement = Agreement(200.0)
    assert agreement.off_hz(200.0) is None, "nothing was heard yet"
    for k in range(400):
        agreement.add(k / rate_hz)
    assert agreement.build_for(200.0) == pytest.approx(built_hz)
    off = agreement.off_hz(agreement.build_for(200.0))
    assert off == (None if rate_hz != 175.0 else pytest.approx(175.0))
