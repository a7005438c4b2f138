"""Whether the machine kept up with a flight: a slow one is named, a companion that fails on a quick one not excused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from sitl.trials.machine import Figures, exit_code, judge, line

QUICK = Figures(
    flown_s=20.0, wall_s=20.1, asked_hz=200.0, rate_hz=199.0, commands_sent=40, stale=0, expected=True, acted=True
)


def test_a_machine_that_keeps_up_is_not_blamed() -> None:
    machine = judge(QUICK)
    assert not machine["too_slow"]
    assert machine["reason"] == ""
    assert machine["clock_ratio"] == pytest.approx(0.995, abs=1e-3)
    assert machine["rate_hz"] == 199.0
    assert "kept up" in line(machine)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"wall_s": 25.0}, "clock ran at 0.80 of the wall clock"),
        ({"late_cycles": 2, "lost_s": 0.61, "crashed": True}, "stood still 2 times and lost 0.61 s"),
        ({"late_cycles": 1, "lost_s": 0.25, "acted": False}, "stood still once and lost 0.25 s"),
        ({"rate_hz": 120.0}, "telemetry came at 120 of 200 Hz"),
        ({"rate_hz": None}, "did not answer"),
        ({"stale": 8}, "8 of 40 commands came too late"),
        ({"acted": False, "stale": 1}, "nothing of the companion was ever applied"),
        ({"acted": False, "rate_hz": 185.0}, "nothing of the companion was ever applied"),
        ({"acted": False, "wall_s": 20.6}, "nothing of the companion was ever applied"),
    ],
)
def test_a_machine_that_was_too_slow_is_named_with_the_figure(change: dict[str, Any], reason: str) -> None:
    machine = judge(replace(QUICK, **change))
    assert machine["too_slow"]
    assert reason in machine["reason"]
    assert reason in line(machine)
    assert "too slow" in line(machine)


@pytest.mark.parametrize(
    "change", [{"acted": False}, {"acted": False, "rate_hz": 0.0, "commands_sent": 0}, {"acted": False, "stale": 0}]
)
def test_a_companion_that_does_nothing_on_a_quick_machine_is_not_excused(change: dict[str, Any]) -> None:
    assert not judge(replace(QUICK, **change))["too_slow"]


def test_a_companion_that_need_not_act_is_not_asked_to() -> None:
    assert not judge(replace(QUICK, expected=False, acted=False, rate_hz=185.0, commands_sent=0))["too_slow"]


def test_the_exit_code_tells_flown_on_crashed_and_not_to_be_judged_apart() -> None:
    quick, slow = judge(QUICK), judge(replace(QUICK, wall_s=40.0))
    assert exit_code({"machine": quick, "companion": {"crashed": False}}) == 0
    assert exit_code({"machine": quick, "companion": {"crashed": True}}) == 1
    assert exit_code({"machine": slow, "companion": {"crashed": True}}) == 3
    assert exit_code({"machine": slow, "companion": {"crashed": False}}) == 3
    assert exit_code({"machine": slow, "error": "waited"}) == 3


def test_a_short_stall_of_a_flight_that_went_well_is_no_matter() -> None:
    machine = judge(replace(QUICK, late_cycles=2, lost_s=0.5))
    assert not machine["too_slow"]
    assert machine["late_cycles"] == 2
