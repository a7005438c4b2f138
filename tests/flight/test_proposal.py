"""A better airframe file of the daemon's own flights: made beside the loop, on the ground, and never put in force."""

from __future__ import annotations

import errno
import os
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from flown_logs import RATE_HZ, Flight
from flying import wait_for
from sessions import bare_session, texts

from nff_companion.calibration import airframe
from nff_companion.calibration.handover import Flown
from nff_companion.calibration.recorder import FlightRecorder
from nff_companion.condition import Reason, Statement
from nff_companion.core import vehicle as vehicles
from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.motor_order import orders
from nff_companion.core.vehicle import Vehicle
from nff_companion.daemon import configuration, proposal
from nff_companion.daemon.notify import Notifier
from nff_companion.daemon.proposal import Proposer, Source
from nff_companion.daemon.service import Daemon
from nff_companion.errors import StateFileError
from nff_companion.replay import calibrate, propose
from nff_companion.session import Session
from nff_companion.state_file import StateFile
from sitl.trials.process import config_text, free_port

OCTO = vehicles.path_of("octo-x").read_text(encoding="utf-8")


class Ground:
    """A session as far as a proposal is concerned."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.armed: bool | None = False
        self.companion = SimpleNamespace(vehicle=vehicle)
        self.adapter = SimpleNamespace(name="ardupilot")

    def moment(self) -> Any:
        return SimpleNamespace(condition=SimpleNamespace(armed=self.armed))


def proposer(folder: Path, recorder: FlightRecorder, airframe: str = "octo-x", patience_s: float = 1e9) -> Proposer:
    return Proposer(Source(airframe, None, folder), recorder, patience_s)


def landed(count: int = 1) -> FlightRecorder:
    recorder = FlightRecorder(8, 10)
    for k in range(count):
        recorder.add(Flight(vehicles.load("octo-x"), seconds=0.005).rows(np.random.default_rng(k))[0][1])
        recorder.landed()
    return recorder


def until(made: Proposer, ground: Ground, state: str, timeout_s: float = 30.0) -> list[Statement]:
    """What is said until the state is ``state``; a clock that runs fast looks often."""
    said: list[Statement] = []
    began_s, before = time.monotonic(), made.document()["state"]

    def looked() -> bool:
        note = made.turn(cast("Session", ground), 1000.0 * (time.monotonic() - began_s))
        said.extend([] if note is None else [note])
        now = made.document()
        assert now["state"] in ("waiting", "calibrating", before, state), now
        return bool(now["state"] == state)

    wait_for(looked, f"state {state}", timeout_s)
    return said


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Another process in the place of the calibration."""
    return lambda code: monkeypatch.setattr(proposal, "_COMMAND", [sys.executable, "-I", "-S", "-c", code])


def test_a_flight_with_slower_motors_and_two_of_them_swapped_gives_a_file_that_says_so(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    slow = OCTO.replace("time_constant_up_s = 0.045", "time_constant_up_s = 0.08")
    slow = slow.replace("time_constant_down_s = 0.045", "time_constant_down_s = 0.08")
    (tmp_path / "true.toml").write_text(slow, encoding="utf-8")
    flown_file = vehicles.load("octo-x")
    swap = next(o for o in orders(flown_file.acceleration_effectiveness[1:]) if o.swapped == (2, 4))
    (tmp_path / "flown.toml").write_text(airframe.reordered(OCTO, swap), encoding="utf-8")
    recorder = FlightRecorder(8, round(24 * RATE_HZ))
    for _, sample in Flight(vehicles.load(str(tmp_path / "true.toml")), seconds=24.0, turns_rad=0.6).rows(rng):
        recorder.add(sample)
    ground, folder = Ground(flown_file.with_telemetry(vehicles.TelemetryTable(0.0, 0.0))), tmp_path / "state"
    made = proposer(folder, recorder, str(tmp_path / "flown.toml"))
    assert made.turn(cast("Session", ground), 0.0) is None
    assert made.document()["state"] == "waiting"
    recorder.landed()
    said = until(made, ground, "proposed", 120.0)
    document = made.document()
    print(document)
    assert [note.text for note in said] == ["file proposed: motors 2, 4 swapped?"]
    assert any("motors 2, 4 swapped" in sentence for sentence in document["differs"])
    assert any(sentence.endswith("ms, the file says 45") for sentence in document["differs"])
    written = folder / "proposed-octo-x.toml"
    assert document["file"] == str(written)
    found = vehicles.load(str(written))
    assert found.motor.time_constant_up_s == pytest.approx(0.08, abs=0.012)
    np.testing.assert_allclose(np.sign(found.effectiveness_si), np.sign(flown_file.effectiveness_si))
    assert found.confirmed == "", "another order is for a flight to confirm"
    assert sorted(path.name for path in folder.iterdir()) == ["proposed-octo-x.toml"]
    assert made.turn(cast("Session", ground), 1e9) is None, "said once"


def test_the_pilot_hears_of_a_proposal_in_a_text_that_fits() -> None:
    note = Statement(Reason.FILE_PROPOSED, "motors take 80 ms, file 45")
    session = bare_session()
    assert texts(session.tell(note, 1.0)) == ["NFF: file proposed: motors take 80 ms, file 45"]
    assert texts(session.tell(note, 2.0)) == []


def test_it_waits_for_a_landing_and_is_ended_when_armed_again(tmp_path: Path, answering: Callable[[str], None]) -> None:
    answering("import time; time.sleep(60)")
    ground, recorder = Ground(vehicles.load("octo-x")), landed()
    made = proposer(tmp_path, recorder)
    for ground.armed in (True, None):
        assert made.turn(cast("Session", ground), 0.0) is None
        assert made.document()["state"] == "waiting"
    ground.armed = False
    until(made, ground, "calibrating")
    process = made._process
    ground.armed = True
    until(made, ground, "failed")
    assert "armed again" in made.document()["text"]
    assert process is not None
    assert process.wait(10.0) < 0
    made.close()


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("raise SystemExit('no room')", "ended with code 1: no room"),
        ("print('{}')", "ended with code 0: it said nothing"),
        ("import os; os.kill(os.getpid(), 9)", "ended with code -9"),
        ("import time; time.sleep(60)", "has not ended in 1 s"),
    ],
)
def test_a_calibration_that_fails_is_said_and_ends_nothing(
    code: str, words: str, tmp_path: Path, answering: Callable[[str], None]
) -> None:
    answering(code)
    patience_s = 1.0 if "sleep" in code else 1e9  # of the fast clock
    recorder = landed()
    made = proposer(tmp_path, recorder, patience_s=patience_s)
    ground = Ground(vehicles.load("octo-x"))
    assert until(made, ground, "failed") == []
    assert words in made.document()["text"]
    answering('print(\'{"outcome": "agrees", "text": "well"}\')')
    recorder.add(Flight(vehicles.load("octo-x"), seconds=0.005).rows(np.random.default_rng(0))[0][1])
    recorder.landed()
    made._patience_s = 1e9
    until(made, ground, "agrees")


def test_a_process_that_cannot_be_started_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proposal, "_COMMAND", [str(tmp_path / "nothing")])
    made = proposer(tmp_path, landed())
    until(made, Ground(vehicles.load("octo-x")), "failed")
    assert "cannot be started: No such file" in made.document()["text"]


# -- the process ----------------------------------------------------------------------------------------------------


def flown(folder: Path, airframe: str = "octo-x") -> Flown:
    return Flown(
        airframe=airframe,
        target=str(folder / "proposed-octo-x.toml"),
        motors=8,
        samples=0,
        gyro_filter_hz=0.0,
        accelerometer_filter_hz=0.0,
    )


def test_a_flight_too_short_says_what_to_fly(tmp_path: Path, rng: np.random.Generator) -> None:
    rows = [sample for _, sample in Flight(vehicles.load("octo-x"), seconds=9.0).rows(rng)]
    for some in ([], rows):
        outcome = propose.proposed(flown(tmp_path), some)
        assert outcome.outcome == "missing", outcome
        assert "turns to both sides" in outcome.missing[0]
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A calibration that found motors of 80 ms."""
    verdict = SimpleNamespace(enough=True, advice="climb")
    calibration = SimpleNamespace(text=OCTO, fit=None, verdicts=[verdict], flown_s=60.0)
    monkeypatch.setattr(calibrate, "of_flights", lambda *_: calibration)
    monkeypatch.setattr(propose, "differences", lambda *_: [("motors take 80 ms", "motors respond in 80 ms")])
    return calibration


def rows() -> list[Any]:
    return [s for _, s in Flight(vehicles.load("octo-x"), seconds=0.1).rows(np.random.default_rng(1))]


def test_a_quiet_flight_names_the_manoeuvre_and_writes_nothing(tmp_path: Path, found: Any) -> None:
    found.verdicts[0].enough = False
    outcome = propose.proposed(flown(tmp_path), rows())
    assert outcome.outcome == "missing"
    assert outcome.text == "no proposal: climb (so far: motors respond in 80 ms)"
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_or_no_folder_is_said_and_leaves_the_older_proposal(
    tmp_path: Path, found: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    older = tmp_path / "proposed-octo-x.toml"
    older.write_text("older", encoding="utf-8")

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        outcome = propose.proposed(flown(tmp_path), rows())
    assert outcome.outcome == "failed"
    assert "cannot be written: No space left on device" in outcome.text
    assert older.read_text(encoding="utf-8") == "older"
    assert list(tmp_path.iterdir()) == [older]
    (tmp_path / "file").touch()
    outcome = propose.proposed(flown(tmp_path / "file"), rows())
    assert "cannot be written" in outcome.text
    assert propose.proposed(flown(tmp_path), rows()).outcome == "proposed"
    assert older.read_text(encoding="utf-8") == OCTO


def test_the_file_that_is_flown_is_never_replaced(tmp_path: Path, found: Any) -> None:
    mine = tmp_path / "proposed-octo-x.toml"
    mine.write_text(OCTO + "\n# mine\n", encoding="utf-8")
    outcome = propose.proposed(flown(tmp_path, str(mine)), rows())
    assert outcome.outcome == "failed"
    assert "copy it elsewhere" in outcome.text
    assert mine.read_text(encoding="utf-8").endswith("# mine\n")


def test_a_state_file_is_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "a.toml").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StateFileError, match="is a symbolic link: the proposal is a file of the companion alone"):
        StateFile(tmp_path / "a.toml", "proposal").write(b"x")
    assert not (tmp_path / "elsewhere").exists()


def test_every_order_can_be_put_right_in_the_file() -> None:
    vehicle = vehicles.load("octo-x")
    for order in orders(vehicle.acceleration_effectiveness[1:]):
        if not order.turned_deg:
            text = airframe.reordered(OCTO, order)
            made = Vehicle(msgspec.convert(tomllib.loads(text), AirframeFile))
            np.testing.assert_allclose(made.acceleration_effectiveness[1:], order.rows, atol=1e-9, err_msg=order.text)


# -- the daemon -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("line", "state"), [("", "waiting"), ("propose = false\n", "off")])
def test_the_status_has_the_proposal_and_the_configuration_can_turn_it_off(
    line: str, state: str, tmp_path: Path
) -> None:
    path = tmp_path / "c.toml"
    text = config_text(
        endpoint=f"udpin:127.0.0.1:{free_port()}",
        airframe="octo-x",
        mode="observe",
        rate_hz=200.0,
        socket=tmp_path / "s",
        state_folder=tmp_path,
    )
    path.write_text(text + line, encoding="utf-8")
    daemon = Daemon(configuration.load(path), Notifier({}))
    try:
        daemon.turn(0.0)
        document = daemon._request({"command": "status"})["proposal"]
        assert document["state"] == state
        assert (daemon.session.recorder is None) == (state == "off")
        if state == "waiting":
            assert document["megabytes_max"] == pytest.approx(180 * 200 * 92e-6, abs=0.1)
    finally:
        daemon.close()
