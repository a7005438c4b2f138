"""``nff why`` names the failed motor of a log without an airframe file, or says why it cannot."""

from __future__ import annotations

import json
import os
from importlib import resources
from pathlib import Path
from typing import Any

import log_files
import msgspec
import pytest
from conftest import DATA
from log_files import GOOD_PARAMETERS
from typer.testing import CliRunner

from nff_companion.cli.main import app
from nff_companion.errors import ConfigError
from nff_companion.replay import why_schema
from nff_companion.replay.tlog import first_stamp
from nff_companion.replay.why import logs_in, outputs_of

RECORDED = Path(os.environ["NFF_DATA"]) if os.environ.get("NFF_DATA") else None
needs_data = pytest.mark.skipif(RECORDED is None, reason="NFF_DATA is not set (README, section Data)")
MOTOR_7 = DATA / "ardupilot_motor7.tlog"
HEALTHY = DATA / "arducopter.bin"


class Asked:
    """What the command says; its document is one of the shipped schema, and all of standard output."""

    def __init__(self, *arguments: Path | str) -> None:
        result = CliRunner().invoke(app, ["why", *map(str, arguments), "--json"])
        self.code, self.errors = result.exit_code, result.stderr
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        self.flights: list[dict[str, Any]] = json.loads(result.stdout)["flights"]
        msgspec.convert({"flights": self.flights}, why_schema.Document)

    def motors(self) -> list[list[int]]:
        return [sorted(fault["motor"] for fault in flight["faults"]) for flight in self.flights]


def test_the_shipped_schema_is_that_of_the_document() -> None:
    shipped = resources.files("nff_companion") / "replay" / "why.schema.json"
    assert json.loads(shipped.read_text(encoding="utf-8")) == why_schema.schema()


def test_a_log_that_says_8_motors_names_the_failed_one_and_how_the_vehicle_was_made() -> None:
    asked = Asked(MOTOR_7)
    assert asked.code == 1
    assert asked.motors() == [[7]]
    (flight,) = asked.flights
    (fault,) = flight["faults"]
    assert 0.0 < fault["time_s"] - log_files.FAIL_S < 0.15
    assert fault["effectiveness"] < 0.1
    assert (flight["airframe"]["made_of"], flight["airframe"]["name"]) == ("log", "octo-x")
    assert flight["airframe"]["hover"] == pytest.approx(0.39, abs=0.02)
    assert any("explains the motion" in line for line in flight["airframe"]["how"])


def test_a_frame_of_the_parameters_needs_no_option(tmp_path: Path) -> None:
    log = log_files.dataflash(tmp_path / "octa.bin", {**GOOD_PARAMETERS, "FRAME_CLASS": 3.0, "FRAME_TYPE": 1.0})
    asked = Asked(log)
    assert (asked.code, asked.motors()) == (1, [[7]])
    assert "frame octo-x, by the log's parameters" in asked.flights[0]["airframe"]["how"]


def test_a_frame_that_is_given_or_a_file_takes_the_place_of_what_the_log_says() -> None:
    assert Asked(HEALTHY).code == 2
    given = Asked(HEALTHY, "--frame", "octo-x")
    assert (given.code, given.motors()) == (0, [[]])
    file = Asked(HEALTHY, "--airframe", "arducopter-octa-x")
    assert file.code == 0
    assert file.flights[0]["airframe"]["made_of"] == "file"


def test_a_ulog_of_which_nothing_but_driven_outputs_is_known_is_understood(tmp_path: Path) -> None:
    asked = Asked(log_files.ulog(tmp_path / "bare.ulg"))
    assert (asked.code, asked.motors()) == (1, [[7]])


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    silent = Asked(log_files.tlog(tmp_path / "a.tlog", lambda message: message.get_type() != "SERVO_OUTPUT_RAW"))
    assert silent.code == 2
    assert "no SERVO_OUTPUT_RAW" in silent.flights[0]["reason"]
    assert silent.flights[0]["airframe"] is None
    other = Asked(MOTOR_7, "--frame", "quad-x")
    assert other.code == 2
    assert other.flights[0]["verdict"] == "not_judged"


def test_files_and_folders_are_read_in_order_over_processes(tmp_path: Path) -> None:
    folder = tmp_path / "logs" / "deep"
    folder.mkdir(parents=True)
    for name in ("b.tlog", "a.TLOG", "notes.txt"):
        (folder / name).write_bytes(MOTOR_7.read_bytes())
    (folder.parent / "broken.bin").write_bytes(b"nothing" * 99)
    asked = Asked(DATA / "ardupilot_motors1_3.tlog", tmp_path / "logs", "--jobs", "2")
    assert asked.code == 2  # one is no log
    assert asked.motors() == [[1, 3], [7], [7]]
    assert [Path(flight["file"]).name for flight in asked.flights] == ["ardupilot_motors1_3.tlog", "a.TLOG", "b.tlog"]
    assert "broken.bin" in asked.errors
    assert logs_in([folder / "b.tlog", folder]) == [folder / "b.tlog", folder / "a.TLOG"]


def test_a_folder_without_logs_is_an_error(tmp_path: Path) -> None:
    asked = Asked(tmp_path)
    assert (asked.code, asked.flights) == (2, [])
    assert "no log" in asked.errors


def test_each_flight_has_a_page_of_its_own(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "[x] y.tlog").write_bytes(MOTOR_7.read_bytes())
    asked = Asked(tmp_path / "one", tmp_path / "two", "--page", tmp_path / "pages", "--jobs", "1")
    assert asked.code == 1
    pages = sorted(path.name for path in (tmp_path / "pages").iterdir())
    assert pages == ["[x] y.tlog-system1-2.html", "[x] y.tlog-system1.html"]
    assert "Motor 7 failed" in (tmp_path / "pages" / pages[0]).read_text(encoding="utf-8")


@pytest.mark.parametrize("text", ["tdes", "topic:field:N", "a:b[{}]:kg", ":x{}:N", "a:{}{}:N"])
def test_outputs_that_cannot_be_meant_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="TOPIC:FIELD:UNIT"):
        outputs_of(text)


def test_options_that_contradict_each_other_are_refused() -> None:
    result = CliRunner().invoke(app, ["why", str(MOTOR_7), "--airframe", "octo-x", "--frame", "octo-x"])
    assert isinstance(result.exception, ConfigError)


@needs_data
class TestRecordedFlights:
    """Of vehicles that nobody described."""

    @pytest.mark.parametrize("name", ["healthy", "motor5", "motors1+3", "motor4_half_pwm"])
    def test_stock_arducopter(self, name: str) -> None:
        assert RECORDED is not None
        path = RECORDED / "arducopter" / f"{name}.tlog"
        truth = json.loads((RECORDED / "arducopter" / "truth.json").read_text(encoding="utf-8"))[path.name]
        asked = Asked(path)
        wanted = {"healthy": [], "motor5": [5], "motors1+3": [1, 3], "motor4_half_pwm": [4]}[name]
        assert asked.motors() == [wanted]
        for fault in asked.flights[0]["faults"]:
            assert 0.0 < fault["time_s"] - (truth["fault_unix_s"] - first_stamp(path)) < 0.15

    def test_a_real_quadrotor_that_loses_a_rotor(self) -> None:
        """Outputs at 10 Hz, in a topic of its own controller; the rotor is stopped in each flight."""
        assert RECORDED is not None
        options = ("--frame", "quad-x-clockwise", "--outputs", "unknown_logger:tdes[{}]:N")
        asked = Asked(RECORDED / "flights", *options)
        assert len(asked.flights) == 12
        assert [flight["verdict"] for flight in asked.flights] == ["fault"] * 12
        assert asked.motors() == [[1]] * 12
        for flight in asked.flights:
            assert flight["faults"][0]["confidence"] <= 0.6, "outputs at 10 Hz explain little of how it turns"

    @pytest.mark.parametrize("name", ["20221025_6", "20221026_5", "20221117_5"])
    def test_motors_that_are_numbered_otherwise_than_the_parameters_say_are_no_evidence(self, name: str) -> None:
        """SYS_AUTOSTART says quad X; the controller of these flights numbers its motors clockwise."""
        assert RECORDED is not None
        asked = Asked(RECORDED / "flights" / f"{name}.ulg", "--outputs", "unknown_logger:tdes[{}]:N")
        assert asked.code == 2
        assert asked.motors() == [[]]

    def test_where_the_commands_may_be_is_said(self) -> None:
        assert RECORDED is not None
        asked = Asked(RECORDED / "flights" / "20221026_9.ulg")
        assert asked.code == 2
        assert "--outputs 'unknown_logger:tdes[{}]:N'" in asked.flights[0]["reason"]

    @pytest.mark.parametrize(
        ("name", "options"),
        [
            ("false_declarations/quad_healthy_10hz.bin", ()),
            ("false_declarations/quad_dshot_fast_flight.ulg", ("--frame", "quad-x")),
            (
                "missed_spinning_rotor/rotor1.ulg",
                ("--frame", "quad-x-clockwise", "--outputs", "unknown_logger:tdes[{}]:N"),
            ),
        ],
    )
    def test_what_others_met_is_not_judged(self, name: str, options: tuple[str, ...]) -> None:
        assert RECORDED is not None
        asked = Asked(RECORDED / "reports" / name, *options)
        assert asked.code == 2
        assert asked.motors() == [[]]
