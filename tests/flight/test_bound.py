"""How soon a failure could be told at best."""

from __future__ import annotations

from sitl.trials.bound import BoundOptions, measure


def test_it_is_above_the_link_and_below_what_is_measured_and_grows_with_the_link_alone() -> None:
    quick = measure(BoundOptions(vehicles=2))
    slow = measure(BoundOptions(vehicles=2, link_delay_s=0.05))
    assert len(quick["motors_s"]) == 8
    assert 0.02 < quick["least_s"] <= quick["median_s"] <= quick["most_s"] < 0.075
    for fast, late in zip(quick["motors_s"], slow["motors_s"], strict=True):
        assert abs(late - fast - 0.04) < 1e-9


def test_of_two_motors_above_each_other_yaw_alone_tells_which_and_later() -> None:
    spread, above = (measure(BoundOptions(airframe=name, vehicles=1)) for name in ("octo-x", "coax-x8"))
    assert above["least_s"] > spread["most_s"]
