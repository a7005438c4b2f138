"""The ArduPilot path whole: adapter, TUNNEL, the applet in a real Lua, the emulated loops; and real firmware."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from flying import Flying, wait_for

from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.core import vehicle
from nff_companion.daemon.status_server import ask
from nff_companion.errors import EndpointError
from sitl.faults import Fault
from sitl.trials import survey
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.fly import arducopter
from sitl.trials.process import DaemonProcess, config_text, free_port

OCTO = vehicle.load("octo-x")
ADJACENT = [[1, 3], [1, 5], [2, 4], [2, 6], [3, 8], [4, 8], [5, 7], [6, 7]]
SAME_SPIN_90 = [[1, 7], [1, 8], [2, 7], [2, 8], [3, 4], [3, 5], [4, 6], [5, 6]]
STOCK_CRASHES = [*ADJACENT[::4], *SAME_SPIN_90[::4]]
STOCK_FLIES = [list(pair) for pair in survey.failure_sets(8, pairs=True) if [*pair] not in ADJACENT + SAME_SPIN_90][::6]


def fly(sets: list[list[int]]) -> list[dict[str, Any]]:
    """Some of each kind; all of them: ``nff survey --personality ardupilot --singles``, ``--pairs``."""
    options = survey.SurveyOptions(
        personality="ardupilot", seeds=1, wind_m_s=3.0, thrust_to_weight=2.56, model_error=0.10
    )
    flights = survey.run(options, [tuple(motors) for motors in sets], workers=1)["flights"]
    for f in flights:
        print(
            f"{f['motors']!s:7} stock {'flies' if f['baseline_survived'] else 'CRASH'}, "
            f"companion {'flies' if f['survived'] else 'CRASH'}, named {f['named']}, delay {f['delay_s']}, "
            f"tilt {f['max_tilt_deg']} deg, off {f['max_position_error_m']} m"
        )
    return flights


@pytest.mark.timeout(600)
def test_single_failures_are_named_and_reallocated_by_the_applet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "FLY_ON_S", 6.0)
    for flight in fly([[4], [7]]):
        assert flight["survived"]
        assert flight["named"] == flight["motors"]
        assert flight["false_alarms"] == 0
        assert flight["max_tilt_deg"] < flight["baseline_max_tilt_deg"]


@pytest.mark.timeout(600)
def test_of_simultaneous_doubles_none_that_stock_survives_is_lost_and_the_others_are_saved(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(survey, "FLY_ON_S", 8.0)
    flights = fly(STOCK_CRASHES + STOCK_FLIES)
    assert sorted(f["motors"] for f in flights if not f["baseline_survived"]) == sorted(STOCK_CRASHES)
    assert len(STOCK_FLIES) == 2
    assert not [f["motors"] for f in flights if f["baseline_survived"] and not f["survived"]]
    assert all(f["survived"] for f in flights)
    assert not [f["motors"] for f in flights if set(f["named"]) - set(f["motors"])]


# -- processes --------------------------------------------------------------------------------------------------------


def config(folder: Path, port: int, rate_hz: float = 200.0) -> Path:
    path = folder / "companion.toml"
    path.write_text(
        config_text(
            endpoint=f"udpin:127.0.0.1:{port}", airframe="octo-x", mode="allocate", rate_hz=rate_hz, socket=folder / "s"
        )
    )
    return path


def state(folder: Path) -> dict[str, Any]:
    try:
        return ask(str(folder / "s"), {"command": "status"})
    except EndpointError:
        return {}


@pytest.mark.realtime
def test_the_daemon_finds_the_applet_names_the_motor_and_leaves_its_mask_behind(tmp_path: Path) -> None:
    port = free_port()
    card = tmp_path / "card"
    install(OCTO, card, of_trial(OCTO))
    fleet = make_fleet(DemoOptions(failures=[], wind_m_s=2.0))
    flying = Flying(fleet, [f"udpout:127.0.0.1:{port}"], card=card)
    with DaemonProcess(config(tmp_path, port), tmp_path / "log") as daemon, flying:
        wait_for(lambda: state(tmp_path).get("mode") == "allocate", "allocate mode")
        fleet.faults.add(Fault(vehicle=0, motor=3, start_s=fleet.time_s))
        assert state(tmp_path)["autopilot"]["adapter"] == "ardupilot"
        wait_for(lambda: state(tmp_path).get("failed") == [3], "the declaration")
        wait_for(lambda: state(tmp_path)["autopilot"]["failed"] == [3], "the applet's word on it")
        assert state(tmp_path)["autopilot"]["allocation"] == "matrix"
        assert not any(state(tmp_path)["autopilot"]["refused"].values())
        daemon.kill()
        killed = fleet.time_s
        wait_for(lambda: fleet.time_s > killed + 1.5, "flight without a companion")
        assert not fleet.state.crashed[0]
        assert fleet.autopilot.output[0, 2] == 0.0, "the dead motor stays stopped"
    personality = flying.server.personality
    assert personality is not None
    texts = [text for _, _, text in personality.texts]
    assert any(text.startswith("NFF: failed mask 4 at") for text in texts)


@pytest.mark.realtime
def test_the_doctor_finds_a_ready_vehicle_and_a_wrong_motor_order(tmp_path: Path) -> None:
    card = tmp_path / "card"
    install(OCTO, card, of_trial(OCTO))
    for order, code in ((35.0, 0), (36.0, 1)):
        port = free_port()
        fleet = make_fleet(DemoOptions(failures=[]))
        fleet.autopilot.disarm(0)
        flying = Flying(fleet, [f"udpout:127.0.0.1:{port}"], card=card)
        personality = flying.server.personality
        assert personality is not None
        personality.parameters["SERVO3_FUNCTION"] = order
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
        if not found["rates"]["ok"]:
            print(f"the machine was too slow for the doctor's rates: {found['rates']['detail']}")
            assert flying.server.late_cycles > 0
        assert result.returncode == (code if found["rates"]["ok"] else 1), document
        assert found["applet"]["ok"]
        assert found["tables"]["ok"]
        assert found["watchdog"]["ok"]
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
