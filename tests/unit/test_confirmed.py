"""Who says that an airframe file is the vehicle's own, and a check that asks the flight."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from nff_companion.cli.main import app
from nff_companion.companion import Companion
from nff_companion.companion_state import Orders
from nff_companion.condition import Condition, Mode, Reason, Statement
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.daemon import configuration
from nff_companion.daemon.startup import prepare
from sitl.trials.process import free_port


@pytest.mark.parametrize(
    ("key", "text", "confirmed"),
    [("", "", False), ("confirmed = true\n", "", True), ("", 'confirmed = "calibrated 2026-11-02"\n', True)],
)
def test_an_airframe_file_is_confirmed_by_the_configuration_or_by_itself(
    key: str, text: str, confirmed: bool, tmp_path: Path
) -> None:
    airframe = tmp_path / "mine.toml"
    shipped = vehicle_model.path_of("octo-x").read_text(encoding="utf-8")
    airframe.write_text(shipped.replace('name = "octo-x"\n', f'name = "mine"\n{text}'), encoding="utf-8")
    path = tmp_path / "c.toml"
    path.write_text(
        f'[link]\nendpoint = "udpin:127.0.0.1:1"\n[vehicle]\nairframe = "{airframe}"\n[companion]\n{key}'
        f'state_folder = "{tmp_path}"\n',
        encoding="utf-8",
    )
    session = prepare(configuration.load(path), 0.0)
    assert session.companion.confirmed is confirmed
    assert session.state.trusted is confirmed


def test_a_check_of_the_fit_without_a_vehicle_knows_nothing_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text(
        f'[link]\nendpoint = "udpin:127.0.0.1:{free_port()}"\n[vehicle]\nairframe = "octo-x"\n[companion]\n'
        f'state_folder = "{tmp_path}"\n',
        encoding="utf-8",
    )
    result = CliRunner().invoke(app, ["check", "--config", str(path), "--wait", "0.2", "--json"])
    assert result.exit_code == 2
    assert json.loads(result.stdout)["verdict"] == "unknown"


def test_killed_and_started_again_in_flight_it_acts_on_what_it_had_declared_and_else_waits_for_the_flight(
    octo: Vehicle,
) -> None:
    companion = Companion(octo, 200.0, confirmed=False)
    fresh = companion.start(Mode.ALLOCATE)
    assert not fresh.trusted
    assert fresh.doubt is not None
    assert fresh.doubt.reason is Reason.UNCONFIRMED
    # The autopilot says what was declared before: only a file that was confirmed can have done that.
    adopted, _ = companion.step(fresh, None, Condition(), Orders(adopt=(3,)))
    assert adopted.trusted
    assert adopted.failed.tolist() == [False, False, True, False, False, False, False, False]
    nothing, _ = companion.step(fresh, None, Condition(), Orders(adopt=()))
    assert not nothing.trusted


def test_a_link_that_is_lost_in_flight_takes_nothing_from_what_the_flight_has_shown(octo: Vehicle) -> None:
    companion = Companion(octo, 200.0, confirmed=False)
    state = companion.start(Mode.ALLOCATE)
    proven = msgspec.structs.replace(state, fit=msgspec.structs.replace(state.fit, proven=True))
    lost, output = companion.interrupted(proven, Condition(), Statement(Reason.TELEMETRY_STOPPED))
    assert lost.trusted
    assert output.mode is Mode.OBSERVE  # while nothing is heard
