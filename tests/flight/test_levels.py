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
