"""Vehicles that are off from their airframe files: each motor that fails is named all the same."""

from __future__ import annotations

import pytest

from sitl.trials import survey


@pytest.mark.parametrize(("level", "seed"), [("geometry", 5), ("estimated", 6)])
def test_every_motor_of_a_vehicle_whose_file_is_off_is_named_at_once(
    level: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the file's own numbers 2 of 8 were missed on the first and another named on both, at a median of 0.7 s."""
    monkeypatch.setattr(survey, "FLY_ON_S", 4.0)
    options = survey.SurveyOptions(level=level, seeds=1, first_seed=seed)
    document = survey.run(options, [(motor,) for motor in range(1, 9)], workers=1)
    found = document["summary"]
    assert found["misnamed"] == 0
    assert found["missed"] == 0
    assert found["survived"] == 8
    assert found["delay_max_s"] <= 0.15


def test_a_motor_that_gives_little_because_the_one_across_is_lost_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a thrust curve that was off it looked lost as well, while the vehicle turned in the wind: motor 4 was named
    3.4 s after motor 3."""
    monkeypatch.setattr(survey, "FLY_ON_S", 6.0)
    options = survey.SurveyOptions(airframe="hexa-x", level="estimated", seeds=1, first_seed=1)
    (flight,) = survey.run(options, [(3,)], workers=1)["flights"]
    assert flight["named"] == [3]
    assert flight["survived"]
