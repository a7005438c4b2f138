"""The ArduPilot path whole: adapter, TUNNEL, the applet in a real Lua, the emulated loops; and real firmware."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from realtime import Flying, wait_for

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots.ardupilot import checks, factors
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.core import vehicle
from nff_companion.daemon.status_server import ask
from nff_companion.errors import AllocationInfeasible, EndpointError
from nff_companion.mavlink.codec import dialect
from sitl.trials import survey
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.fly import arducopter
from sitl.trials.process import DaemonProcess, config_text, free_port

ADJACENT = [[1, 3], [1, 5], [2, 4], [2, 6], [3, 8], [4, 8], [5, 7], [6, 7]]
SAME_SPIN_90 = [[1, 7], [1, 8], [2, 7], [2, 8], [3, 4], [3, 5], [4, 6], [5, 6]]


def fly(pairs: bool) -> list[dict]:
    options = survey.SurveyOptions(
        personality="ardupilot", seeds=1, wind_m_s=3.0, thrust_to_weight=2.56, model_error=0.10
    )
    flights = survey.run(options, survey.failure_sets(8, pairs=pairs), workers=1)["flights"]
    for f in flights:
        print(
            f"{f['motors']!s:7} stock {'flies' if f['baseline_survived'] else 'CRASH'}, "
            f"companion {'flies' if f['survived'] else 'CRASH'}, named {f['named']}, delay {f['delay_s']}, "
            f"tilt {f['max_tilt_deg']} deg, off {f['max_position_error_m']} m"
        )
    return flights


@pytest.mark.timeout(600)
def test_every_single_failure_is_named_and_reallocated_by_the_applet() -> None:
    for flight in fly(pairs=False):
        assert flight["survived"]
        assert flight["named"] == flight["motors"]
        assert flight["false_alarms"] == 0
        assert flight["max_tilt_deg"] < flight["baseline_max_tilt_deg"]


@pytest.mark.timeout(600)
def test_of_all_simultaneous_doubles_none_that_stock_survives_is_lost_and_most_others_are_saved() -> None:
    flights = fly(pairs=True)
    stock = [f["motors"] for f in flights if f["baseline_survived"]]
    assert sorted(f["motors"] for f in flights if not f["baseline_survived"]) == sorted(ADJACENT + SAME_SPIN_90)
    assert len(stock) == 12
    assert not [f["motors"] for f in flights if f["baseline_survived"] and not f["survived"]]
    assert sum(f["survived"] for f in flights) >= 24
    assert not [f["motors"] for f in flights if set(f["named"]) - set(f["motors"])]


# -- factors, checks, card --------------------------------------------------------------------------------------------


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
        real = made[mask] / factors.FACTOR_SCALE
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
    adapter = ArduPilotAdapter(model, (1, 1), plans)
    assert set(factors.of_plans(model, plans)) == {0, *plans} - {1}
    assert not adapter.tables_stored


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


def test_the_card_holds_scripts_tables_and_parameters(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "nff_companion.cli.main", "ardupilot", "install", "--to", str(tmp_path), "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    names = {str(Path(f).relative_to(tmp_path)) for f in json.loads(result.stdout)["files"]}
    assert names == {
        "nff_companion.lua",
        "nff_watchdog.lua",
        "modules/nff_protocol.lua",
        "modules/nff_airframe.lua",
        "nff_companion.parm",
    }
    lines = (tmp_path / "nff_companion.parm").read_text().splitlines()
    assert {"FRAME_CLASS 17", "SCR_ENABLE 1", "SERVO8_FUNCTION 40"} <= set(lines)
    install(vehicle.load("octo-x"), tmp_path, scripted=False)
    assert "FRAME_CLASS" not in (tmp_path / "nff_companion.parm").read_text()


def test_override_is_kept_to_the_mode_that_it_follows() -> None:
    octo = vehicle.load("octo-x")
    adapter = ArduPilotAdapter(octo, (1, 1), {})
    for mode, free in ((4, True), (5, False), (9, False)):
        adapter.observe(dialect.MAVLink_heartbeat_message(14, 3, 128, mode, 4, 3))
        assert (adapter.hands_off() == "") == free
    assert "GUIDED" in adapter.hands_off()


# -- processes --------------------------------------------------------------------------------------------------------


def config(folder: Path, port: int, rate_hz: float = 200.0) -> Path:
    path = folder / "companion.toml"
    path.write_text(
        config_text(
            endpoint=f"udpin:127.0.0.1:{port}", airframe="octo-x", mode="allocate", rate_hz=rate_hz, socket=folder / "s"
        )
    )
    return path


def state(folder: Path) -> dict:
    try:
        return ask(str(folder / "s"), {"command": "status"})
    except EndpointError:
        return {}


@pytest.mark.realtime
def test_the_daemon_finds_the_applet_names_the_motor_and_leaves_its_mask_behind(tmp_path: Path) -> None:
    port = free_port()
    card = tmp_path / "card"
    install(vehicle.load("octo-x"), card)
    fleet = make_fleet(DemoOptions(failures=[(3, 7.0)], wind_m_s=2.0))
    flying = Flying(fleet, [f"udpout:127.0.0.1:{port}"], card=card)
    with DaemonProcess(config(tmp_path, port), tmp_path / "log") as daemon, flying:
        wait_for(lambda: state(tmp_path).get("mode") == "allocate", "allocate mode")
        assert state(tmp_path)["autopilot"]["adapter"] == "ardupilot"
        wait_for(lambda: state(tmp_path).get("failed") == [3], "the declaration")
        wait_for(lambda: state(tmp_path)["autopilot"]["failed"] == [3], "the applet's word on it")
        assert state(tmp_path)["autopilot"]["allocation"] == "matrix"
        assert not any(state(tmp_path)["autopilot"]["refused"].values())
        daemon.kill()
        killed = fleet.time_s
        wait_for(lambda: fleet.time_s > killed + 2.0, "two seconds without a companion")
        assert not fleet.state.crashed[0]
        assert fleet.autopilot.output[0, 2] == 0.0, "the dead motor stays stopped"
    texts = [text for _, _, text in flying.server.personality.texts]
    assert any(text.startswith("NFF: failed mask 4 at") for text in texts)


@pytest.mark.realtime
def test_the_doctor_finds_a_ready_vehicle_and_a_wrong_motor_order(tmp_path: Path) -> None:
    card = tmp_path / "card"
    install(vehicle.load("octo-x"), card)
    for order, code in ((35.0, 0), (36.0, 1)):
        port = free_port()
        fleet = make_fleet(DemoOptions(failures=[]))
        fleet.autopilot.disarm(0)
        flying = Flying(fleet, [f"udpout:127.0.0.1:{port}"], card=card)
        flying.server.personality.parameters["SERVO3_FUNCTION"] = order
        # A rate that a busy machine holds too: the doctor is on trial, not the machine.
        arguments = ["doctor", "--config", str(config(tmp_path, port, 100.0)), "--timeout", "12", "--json"]
        with flying:
            result = subprocess.run(
                [sys.executable, "-m", "nff_companion.cli.main", *arguments],
                capture_output=True,
                text=True,
                check=False,
            )
        document = json.loads(result.stdout)
        found = {f["name"]: f for f in document["findings"]}
        assert result.returncode == code, document
        assert found["applet"]["ok"]
        assert found["tables"]["ok"]
        assert found["watchdog"]["ok"]
        assert found["rates"]["ok"], found["rates"]
        assert found["parameters"]["ok"] == (code == 0)
        if code:
            assert "SERVO3_FUNCTION" in found["parameters"]["detail"]


# -- real firmware ----------------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_a_real_arducopter_survives_two_adjacent_failures() -> None:
    if not os.environ.get(arducopter.ENVIRONMENT):
        print(f"{arducopter.ENVIRONMENT} is not set: no real ArduCopter was flown")
        return
    options = arducopter.FlyOptions(binary=arducopter.binary_from(None), failures=[1, 3])
    document = arducopter.run(options, baseline=False)
    print(json.dumps(document["companion"]))
    assert not document["companion"]["crashed"]
    assert all(fault["applied_delay_s"] < 0.2 for fault in document["companion"]["faults"])
