"""What goes onto the autopilot's card, and what must agree with it: factors, parameters, scripts and their times."""

from __future__ import annotations

import dataclasses
import re
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from lupa.lua53 import LuaRuntime

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots import times
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.card import Card
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.core import vehicle
from nff_companion.errors import AllocationInfeasible

OCTO = vehicle.load("octo-x")


def test_the_stock_table_is_what_the_firmware_makes_of_its_own_frame() -> None:
    octo = vehicle.load("arducopter-octa-x")
    made = factors.stock(octo)
    # AP_MotorsMatrix: roll cos(angle + 90), pitch cos(angle), yaw +1 counter-clockwise; scaled to 0.5.
    angles = np.radians([22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5])
    largest = np.cos(np.radians(22.5))
    assert made[:, 1] == pytest.approx(-0.5 * np.sin(angles) / largest)
    assert made[:, 2] == pytest.approx(0.5 * np.cos(angles) / largest)
    assert made[:, 3] == pytest.approx(0.5 * np.array([-1, -1, 1, 1, 1, 1, -1, -1]))
    assert made[:, 0] == pytest.approx(np.ones(8))


@pytest.mark.parametrize("name", ["octo-x", "octo-plus", "coax-x8", "hexa-x"])
def test_tables_keep_the_loop_gains_and_leave_dead_motors_alone(name: str) -> None:
    model = vehicle.load(name)
    plans = tables.compute(model, allocator("trim"))
    made = factors.of_plans(model, plans)
    unit = factors.unit(model)
    for mask, plan in plans.items():
        real = made[mask] / tunnel.FACTOR_SCALE
        eta = np.array([0.0 if mask >> i & 1 else 1.0 for i in range(model.motors)])
        assert not real[eta == 0.0].any()
        given = (model.effectiveness * eta) @ real
        kept = [axis for axis in range(4) if axis not in plan.released]
        wanted = np.diag(unit)
        assert given[np.ix_(kept, kept)] == pytest.approx(wanted[np.ix_(kept, kept)], abs=2e-3)


def test_factors_that_cannot_be_carried_are_refused() -> None:
    model = vehicle.load("octo-x")
    with pytest.raises(AllocationInfeasible, match="at most 8"):
        factors.of_matrix(model, np.full((8, 4), 50.0))
    with pytest.raises(AllocationInfeasible):
        factors.of_matrix(model, np.full((8, 4), np.nan))


def test_a_plan_that_cannot_be_carried_costs_its_table_and_nothing_else() -> None:
    model = vehicle.load("octo-x")
    plans = tables.compute(model, allocator("trim"))
    plans[1] = dataclasses.replace(plans[1], matrix=np.full((8, 4), 50.0))
    assert set(factors.of_plans(model, plans)) == {0, *plans} - {1}
    assert Card(model, plans).report().startswith(f"0 of {len(plans) - 1} ")


def test_parameters_that_would_mislead_are_named() -> None:
    octo = vehicle.load("octo-x")
    good = {f"SERVO{i}_FUNCTION": 32.0 + i for i in range(1, 9)}
    good |= {"FRAME_CLASS": 17.0, "MOT_THST_EXPO": 0.65, "MOT_SPIN_MIN": 0.15, "MOT_SPIN_MAX": 0.95}
    good |= {"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0, "SCR_ENABLE": 1.0, "FLIGHT_OPTIONS": 1.0}
    assert checks.contradictions(good, octo) == []
    assert checks.advice(good, octo) == []
    assert checks.contradictions({**good, "MOT_PWM_MIN": 0.0}, octo) == []  # the throttle's range
    for change, word in (
        ({"SERVO3_FUNCTION": 36.0}, "SERVO3_FUNCTION is 36, motor 3 needs 35"),
        ({"FRAME_CLASS": 1.0}, "FRAME_CLASS is 1"),
        ({"MOT_THST_EXPO": 0.5}, "MOT_THST_EXPO"),
        ({"MOT_SPIN_MIN": 0.1}, "MOT_SPIN_MIN"),
        ({"MOT_PWM_MAX": 1940.0}, "MOT_PWM_MAX"),
    ):
        assert word in checks.contradictions({**good, **change}, octo)[0]
    assert "FLIGHT_OPTIONS" in checks.advice({**good, "FLIGHT_OPTIONS": 0.0}, octo)[0]
    assert "FRAME_CLASS is not 17" in checks.advice({**good, "FRAME_CLASS": 3.0}, octo)[0]


def test_motors_without_a_range_have_that_of_the_throttle_stick() -> None:
    octo = vehicle.load("octo-x")
    unset = {"MOT_PWM_MIN": 0.0, "MOT_PWM_MAX": 0.0}
    assert checks.further({"MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0}) == []
    assert checks.further(unset) == ["RCMAP_THROTTLE"]
    moved = {**unset, "RCMAP_THROTTLE": 2.0}
    assert checks.further(moved) == ["RC2_MIN", "RC2_MAX"]
    assert checks.contradictions({**moved, "RC2_MIN": 999.0, "RC2_MAX": 2004.0, "RC3_MIN": 1200.0}, octo) == []
    assert "RC2_MIN is 1100" in checks.contradictions({**moved, "RC2_MIN": 1100.0, "RC2_MAX": 1900.0}, octo)[0]


def test_a_motor_more_than_the_airframe_has_is_seen_where_the_frame_does_not_say() -> None:
    quad = vehicle.load("h250")
    five = {"SERVO9_FUNCTION": 37.0}
    assert "SERVO9_FUNCTION drives motor 5" in checks.misfits(five, quad)[0]
    assert checks.misfits({**five, "FRAME_CLASS": 1.0}, quad) == []


LUA = resources.files("nff_companion") / "autopilots" / "ardupilot" / "lua"


def test_the_times_on_the_card_are_those_of_the_protocol(tmp_path: Path) -> None:
    install(OCTO, tmp_path, of_trial(OCTO))
    module = LuaRuntime().execute((tmp_path / "modules" / "nff_times.lua").read_text())
    on_the_card = dict(module.items())
    assert on_the_card == {
        name.removesuffix("_S") + "_MS": round(1e3 * getattr(times, name))
        for name in (key.removesuffix("_MS") + "_S" for key in on_the_card)
    }
    assert all(type(value) is int and value > 0 for value in on_the_card.values())
    used: set[str] = set()
    for script in (*tmp_path.glob("*.lua"), *tmp_path.glob("modules/*.lua")):
        used |= set(re.findall(r"\bT\.(\w+)", script.read_text()))
    assert used == set(on_the_card)


@pytest.mark.parametrize("name", ["nff_companion.lua", "nff_watchdog.lua", "modules/nff_commands.lua"])
def test_no_script_has_times_of_its_own(name: str) -> None:
    text = LUA.joinpath(*name.split("/")).read_text()
    lines = [line for line in text.splitlines() if re.search(r"_(MS|ms)(, \w+)*\s*[=<>]+\s*[1-9]", line)]
    assert not lines
