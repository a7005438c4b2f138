"""The demonstration: two flights in real time, and a machine that is too slow for them."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nff_companion.cli.main import app
from sitl.fleet import Fleet
from sitl.server import Server
from sitl.trials import demo
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.machine import Figures, judge
from sitl.trials.process import free_port


def slow_down(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Each cycle of the vehicle takes so long at least, on any machine."""
    step = Fleet.step

    def slowly(fleet: Fleet) -> None:
        time.sleep(seconds)
        step(fleet)

    monkeypatch.setattr(Fleet, "step", slowly)


def test_a_server_that_falls_behind_counts_the_time_it_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_down(monkeypatch, 0.01)
    server = Server(make_fleet(DemoOptions(failures=[])), [f"udpout:127.0.0.1:{free_port()}"])
    began = time.monotonic()
    server.run(0.5)
    behind = time.monotonic() - began - 0.5
    server.close()
    assert server.late_cycles >= 3
    assert 0.0 <= behind - server.lost_s < 0.3, "what is lost is what the clocks differ by, but for the last moment"


@pytest.mark.realtime
def test_a_flight_on_a_machine_too_slow_for_it_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    slow_down(monkeypatch, 0.006)
    monkeypatch.setattr(demo, "FLY_ON_S", 0.4)
    keep = tmp_path / "kept"
    result = demo.run(DemoOptions(failures=[(1, 0.6)]), say=lambda text: None, keep=keep)
    machine = result.document["machine"]
    print(machine)
    assert machine["too_slow"]
    assert machine["clock_ratio"] < 0.7
    assert machine["late_cycles"] > 0
    assert machine["lost_s"] > 0.25
    assert machine["reason"]
    assert machine["reason"] in demo.side_by_side(result.document)
    log = (keep / "companion.log").read_text(encoding="utf-8")
    assert "scheduling: " in log
    assert "running: octo-x" in log
    json.dumps(result.document, allow_nan=False)


def canned(*, too_slow: bool, crashed: bool) -> demo.DemoResult:
    options = DemoOptions(failures=[(1, 5.0)])
    trace = demo.Trace(crashed_at_s=6.0 if crashed else None)
    figures = Figures(
        flown_s=10.0,
        wall_s=20.0 if too_slow else 10.0,
        asked_hz=200.0,
        rate_hz=200.0,
        commands_sent=10,
        stale=0,
        expected=True,
        acted=True,
    )
    flown = demo.describe(options, demo.Trace(crashed_at_s=6.0), trace, judge(figures))
    return demo.DemoResult(options, trace, trace, flown)


@pytest.mark.parametrize(
    ("too_slow", "crashed", "code"), [(False, False, 0), (False, True, 1), (True, True, 3), (True, False, 3)]
)
@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_ends_with_the_verdict_as_its_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, too_slow: bool, crashed: bool, code: int, as_json: bool
) -> None:
    monkeypatch.setattr(demo, "run", lambda options, say, keep=None: canned(too_slow=too_slow, crashed=crashed))
    arguments = ["demo", "--report", str(tmp_path / "r.html"), *(["--json"] if as_json else [])]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == code, result.output
    if as_json:
        assert json.loads(result.stdout)["machine"]["too_slow"] == too_slow
    assert ("too slow" in result.stderr) == too_slow


@pytest.mark.realtime
def test_a_demo_flies_two_flights_and_judges_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(demo, "FLY_ON_S", 4.0)
    keep = tmp_path / "kept"
    arguments = ["demo", "--fail", "1@2", "--json", "--report", str(tmp_path / "r.html"), "--keep", str(keep)]
    result = CliRunner().invoke(app, arguments)
    document = json.loads(result.stdout)
    print(document)
    assert (keep / "companion.log").exists()
    if document["machine"]["too_slow"]:
        print("the machine was too slow: nothing was tried")
        assert result.exit_code == 3
        return
    assert result.exit_code == 0
    assert not document["companion"]["crashed"]
    assert document["companion"]["faults"][0]["delay_s"] < 0.5
    assert document["machine"]["clock_ratio"] > 0.95
