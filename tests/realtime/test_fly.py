"""Flights on real firmware, as far as they can be tried without it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flying import Flying
from typer.testing import CliRunner

from nff_companion.cli.main import app
from nff_companion.core import vehicle
from nff_companion.errors import ConfigError
from nff_companion.mavlink.codec import Message
from sitl.fleet import Fleet
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.fly import arducopter, campaign, flight, px4
from sitl.trials.fly.pilot import FlightError, Pilot
from sitl.trials.fly.px4_parameters import default_of, parameters
from sitl.trials.machine import Figures, judge
from sitl.trials.process import config_text, free_port

PREFIX = "PX4_PARAM_"
EPSILON = 1.2e-7  # FLT_EPSILON: what PX4 takes for equal


def written(name: str) -> dict[str, float]:
    model = vehicle.load(name, thrust_to_weight=1.55)
    options = px4.FlyOptions(binary=Path("px4"), airframe=name)
    found = parameters(model, options.height_m)
    assert all(key.startswith(PREFIX) for key in found)
    return {key.removeprefix(PREFIX): float(value) for key, value in found.items()}


@pytest.mark.parametrize("name", vehicle.names())
def test_no_parameter_is_passed_to_px4_at_its_default_where_the_start_script_would_win(name: str) -> None:
    """PX4 drops from its environment what equals a default, and the airframe's start script then sets its own."""
    for parameter, value in written(name).items():
        assert abs(np.float32(value) - np.float32(default_of(parameter))) > EPSILON, f"{parameter} = {value}"


@pytest.mark.parametrize("name", vehicle.names())
def test_px4_is_told_every_rotor_where_it_is(name: str) -> None:
    model, told = vehicle.load(name), written(name)
    assert told["CA_ROTOR_COUNT"] == model.motors
    for i in range(model.motors):
        place = [told[f"CA_ROTOR{i}_PX"], told[f"CA_ROTOR{i}_PY"]]
        assert place == pytest.approx(model.position_m[i].tolist(), abs=2e-4)
        assert told[f"CA_ROTOR{i}_KM"] == pytest.approx(model.motor.torque_per_thrust_m * model.spin[i], abs=2e-4)
        assert told[f"PWM_MAIN_FUNC{i + 1}"] == 101 + i


def test_a_drag_that_is_px4s_default_is_passed_too(tmp_path: Path) -> None:
    text = vehicle.path_of("hexa-x").read_text(encoding="utf-8")
    changed = text.replace("torque_per_thrust_m = 0.018", "torque_per_thrust_m = 0.05")
    assert changed != text
    (tmp_path / "hexa.toml").write_text(changed, encoding="utf-8")
    told = written(str(tmp_path / "hexa.toml"))
    drags = [told[f"CA_ROTOR{i}_KM"] for i in range(6)]
    assert all(abs(drag - 0.05) > 1e-6 for drag in drags)
    assert np.abs(drags) == pytest.approx(np.full(6, 0.05), abs=2e-4)


@pytest.mark.parametrize(("name", "kind"), [("h250", 2), ("hexa-x", 13), ("octo-plus", 14)])
def test_px4_is_told_what_kind_of_vehicle_it_is(name: str, kind: int) -> None:
    assert written(name)["MAV_TYPE"] == kind


# -- the companion beside a flight ------------------------------------------------------------------------------------


class Range:
    """An emulated vehicle in place of real firmware, a pilot, and the text of the daemon's configuration."""

    def __init__(self, folder: Path, *, mode: str = "allocate") -> None:
        companion, ground = free_port(), free_port()
        self.fleet = make_fleet(DemoOptions(failures=[]))
        self.flying = Flying(self.fleet, [f"udpout:127.0.0.1:{companion}", f"udpout:127.0.0.1:{ground}"])
        self.pilot = Pilot(f"udpin:127.0.0.1:{ground}")
        self.text = config_text(
            endpoint=f"udpin:127.0.0.1:{companion}",
            airframe="octo-x",
            mode=mode,
            rate_hz=100.0,
            socket=folder / flight.SOCKET,
            state_folder=folder,
        )

    def clock(self) -> float:
        return self.fleet.time_s

    def fly(self, seconds: float) -> dict[str, Any]:
        until = self.fleet.time_s + seconds
        self.pilot.wait(lambda: self.fleet.time_s > until, 60.0, "the flight")
        return {"crashed": False}


@pytest.mark.realtime
def test_what_flies_beside_the_companion_is_timed_and_counted(tmp_path: Path) -> None:
    trial = Range(tmp_path)
    with trial.flying:
        trial.pilot.connect()
        with flight.companion(trial.pilot, tmp_path, trial.text, rate_hz=100.0) as beside:
            summary, machine = beside.test(lambda: trial.fly(2.0), trial.clock, expected=False)
        trial.pilot.close()
    print(machine)
    assert summary["crashed"] is False
    assert summary["status"]["airframe"] == "octo-x"
    assert machine["rate_hz"] > 0.0
    assert machine["clock_ratio"] > 0.0
    assert machine["too_slow"] == bool(machine["reason"])


@pytest.mark.realtime
@pytest.mark.parametrize("module", [arducopter, px4], ids=["ardupilot", "px4"])
def test_both_flights_become_one_document_with_the_companions_word_and_the_machines(
    module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way through a flight, with an emulated vehicle in place of the firmware and of its test."""
    trials: list[Range] = []

    @contextmanager
    def simulator(options: Any, model: Any, folder: Path, **_: Any) -> Iterator[Any]:
        trials.append(Range(folder))
        with trials[-1].flying:
            yield SimpleNamespace(physics=trials[-1].fleet, process=SimpleNamespace(poll=lambda: None))

    def test(pilot: Pilot, *_: Any) -> dict[str, Any]:
        summary = trials[-1].fly(1.0)
        return {**summary, "failed_at_s": trials[-1].clock() + 1.0}

    monkeypatch.setattr(module, "simulator" if module is px4 else "Simulator", simulator)
    monkeypatch.setattr(module, "Pilot", lambda url, **_: ThroughRange(trials))
    monkeypatch.setattr(module, "_take_off" if module is px4 else "take_off", lambda *_: None)
    monkeypatch.setattr(module, "_test", test)
    monkeypatch.setattr(module, "config_text", lambda **_: trials[-1].text)
    options = module.FlyOptions(binary=Path("binary"), rate_hz=100.0, failures=[1])
    document = module.run(options, baseline=True, keep=tmp_path / "kept")
    json.dumps(document, allow_nan=False)
    assert document["options"]["failures"] == [1]
    assert "machine" not in document["baseline"]
    assert "status" not in document["companion"]
    assert document["companion"]["faults"][0]["delay_s"] is None
    assert document["machine"]["asked_hz"] == 100.0
    assert "running: " in (tmp_path / "kept" / "companion" / "companion.log").read_text(encoding="utf-8")


@pytest.mark.realtime
def test_a_companion_that_is_never_ready_for_want_of_speed_is_no_failed_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Fleet.step

    def slowly(fleet: Fleet) -> None:
        time.sleep(0.03)  # a machine that takes twelve times as long
        step(fleet)

    monkeypatch.setattr(Fleet, "step", slowly)
    trial = Range(tmp_path)
    with trial.flying:
        trial.pilot.connect()
        with (
            pytest.raises(flight.SlowMachineError, match="Hz") as error,
            flight.companion(trial.pilot, tmp_path, trial.text, rate_hz=100.0, ready_s=5.0),
        ):
            pass
        trial.pilot.close()
    assert error.value.machine["too_slow"]
    assert error.value.machine["reason"] in str(error.value)


def test_a_companion_that_ends_at_once_is_a_failed_flight(tmp_path: Path) -> None:
    trial = Range(tmp_path, mode="fly")
    with trial.flying:
        trial.pilot.connect()
        with (
            pytest.raises(FlightError, match="ended with code") as error,
            flight.companion(trial.pilot, tmp_path, trial.text, rate_hz=100.0),
        ):
            pass
        trial.pilot.close()
    assert not isinstance(error.value, flight.SlowMachineError)


def test_the_daemons_log_is_kept_when_a_flight_fails_and_sockets_are_not(tmp_path: Path) -> None:
    import socket

    def fly(with_companion: bool, folder: Path) -> dict[str, Any]:
        (folder / "companion.log").write_text("it said this\n", encoding="utf-8")
        with socket.socket(socket.AF_UNIX) as door:
            door.bind(str(folder / "s"))
        raise FlightError("it fell")

    with pytest.raises(FlightError, match="it fell"):
        flight.both({}, fly, baseline=False, keep=tmp_path / "kept")
    assert (tmp_path / "kept" / "companion" / "companion.log").read_text(encoding="utf-8") == "it said this\n"
    assert not (tmp_path / "kept" / "companion" / "s").exists()


class ThroughRange:
    """The pilot of the range that flies now."""

    def __init__(self, trials: list[Range]) -> None:
        self._trials = trials
        self.hooks: list[Callable[[Message], None]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._trials[-1].pilot, name)

    def set_parameter(self, *_: Any) -> None:
        self._trials[-1].pilot.hooks += self.hooks


# -- verdicts ---------------------------------------------------------------------------------------------------------

QUICK = Figures(
    flown_s=20.0, wall_s=20.0, asked_hz=200.0, rate_hz=200.0, commands_sent=40, stale=0, expected=True, acted=True
)


def flown(*, slow: bool, crashed: bool) -> dict[str, Any]:
    summary = {
        "crashed": crashed,
        "max_tilt_deg": 90.0,
        "max_position_error_m": 5.0,
        "position_rms_m": 1.0,
        "height_lost_m": 9.0,
        "faults": [{"delay_s": None, "applied_delay_s": None}],
        "false_alarms": 0,
    }
    machine = judge(replace(QUICK, rate_hz=90.0 if slow else 200.0, acted=not slow))
    return {"options": {"failures": [1]}, "companion": summary, "machine": machine}


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
@pytest.mark.parametrize(("slow", "crashed", "code"), [(False, False, 0), (False, True, 1), (True, True, 3)])
def test_a_flight_on_a_slow_machine_is_called_neither_success_nor_crash(
    monkeypatch: pytest.MonkeyPatch, firmware: str, slow: bool, crashed: bool, code: int
) -> None:
    module = {"ardupilot": arducopter, "px4": px4}[firmware]
    monkeypatch.setattr(module, "binary_from", lambda path: Path("binary"))
    monkeypatch.setattr(module, "run", lambda options, **_: flown(slow=slow, crashed=crashed))
    result = CliRunner().invoke(app, ["fly", firmware, "--json"])
    assert result.exit_code == code, result.output
    assert json.loads(result.stdout)["machine"]["too_slow"] == slow
    assert ("CRASH" in result.stderr) == (crashed and not slow)
    assert ("the machine was too slow" in result.stderr) == slow


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_the_help_names_the_exit_codes(firmware: str) -> None:
    said = CliRunner().invoke(app, ["fly", firmware, "--help"]).stdout
    assert "Exit code" in said
    assert "too slow" in said


def test_a_campaign_counts_the_flights_that_the_machine_was_too_slow_for() -> None:
    flights = [flown(slow=True, crashed=True), flown(slow=False, crashed=False)]
    totals = campaign.summary(flights)
    assert totals["too_slow"] == 1
    assert totals["flights"] == 2


def test_a_missing_binary_is_named_with_the_variable(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for module, option in ((arducopter, "--arducopter"), (px4, "--px4")):
        monkeypatch.delenv(module.ENVIRONMENT, raising=False)
        with pytest.raises(ConfigError, match=f"{option} PATH or {module.ENVIRONMENT}=PATH"):
            module.binary_from(None)
        with pytest.raises(ConfigError, match="executable"):
            module.binary_from(tmp_path / "nothing")
