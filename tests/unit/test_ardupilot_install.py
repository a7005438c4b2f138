"""``nff ardupilot install``: what flew before is read, kept and compared; a wrong airframe file is not installed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from lupa.lua53 import LuaRuntime
from other_airframes import OWN, PAIRS, SHIPPED, parameters_of, wrong_files
from typer.testing import CliRunner

from nff_companion.autopilots.ardupilot.before import KEPT, of_parameters, of_trial
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.cli.main import app
from nff_companion.core import vehicle
from nff_companion.daemon import live_parameters
from nff_companion.errors import ConfigError
from nff_companion.frames import catalogue, parameter_file
from nff_companion.frames.parameter_file import Parameters

OCTO = vehicle.load("octo-x")


class Card:
    """A card, and a parameter file of the autopilot that it belongs to."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._file = folder / "scripts", folder / "now.param"
        self.folder.mkdir()

    def install(self, values: Mapping[str, float] | None, *options: str, airframe: str = "octo-x") -> Any:
        """Outcome of the command; ``values`` None: without a parameter file."""
        arguments = ["ardupilot", "install", "--to", str(self.folder), "--airframe", airframe, "--json", *options]
        if values is not None:
            self._file.write_text("".join(f"{name},{value:g}\n" for name, value in values.items()))
            arguments += ["--parameters", str(self._file)]
        return CliRunner().invoke(app, arguments)

    def refused(self, values: Mapping[str, float] | None, *options: str, airframe: str = "octo-x") -> str:
        """Why; what is on the card is untouched."""
        before = self.content()
        result = self.install(values, *options, airframe=airframe)
        assert isinstance(result.exception, ConfigError), result.output
        assert self.content() == before
        return str(result.exception)

    def content(self) -> dict[str, bytes]:
        return {str(p.relative_to(self.folder)): p.read_bytes() for p in self.folder.rglob("*") if p.is_file()}

    @property
    def frame(self) -> Any:
        """Of the airframe's module."""
        return LuaRuntime().execute((self.folder / "modules" / "nff_airframe.lua").read_text())["frame"]

    def kept(self) -> dict[str, float]:
        return parameter_file.read(self.folder / KEPT).values


@pytest.fixture
def card(tmp_path: Path) -> Card:
    return Card(tmp_path)


def test_the_card_holds_scripts_tables_parameters_and_what_flew_before(card: Card) -> None:
    values = parameters_of("octo-x")
    result = card.install(values)
    assert result.exit_code == 0, result.output
    names = {str(Path(f).relative_to(card.folder)) for f in json.loads(result.stdout)["files"]}
    assert names == {
        "nff_companion.lua",
        "nff_watchdog.lua",
        "modules/nff_protocol.lua",
        "modules/nff_mixer.lua",
        "modules/nff_commands.lua",
        "modules/nff_airframe.lua",
        "modules/nff_times.lua",
        "nff_companion.parm",
        KEPT,
    }
    assert names == set(card.content())
    lines = (card.folder / "nff_companion.parm").read_text().splitlines()
    assert {"FRAME_CLASS 17", "SCR_ENABLE 1", "SERVO8_FUNCTION 40"} <= set(lines)
    wanted = {"FRAME_CLASS", "FRAME_TYPE", "FLIGHT_OPTIONS", "MOT_PWM_MIN", "MOT_PWM_MAX"}
    wanted |= {f"SERVO{n}_FUNCTION" for n in range(1, 9)}
    assert card.kept() == {name: values[name] for name in wanted}
    assert "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in (card.folder / KEPT).read_text().splitlines()[0]
    assert card.frame == 301
    assert card.install(values, "--outputs-only").exit_code == 0
    assert "FRAME_CLASS" not in (card.folder / "nff_companion.parm").read_text()


def test_without_the_parameters_nothing_is_installed_and_what_to_give_is_said(card: Card) -> None:
    why = card.refused(None)
    assert "--parameters FILE" in why
    assert "--from URL" in why
    assert "--from URL" in card.refused(None, "--frame", "octo-x")


def test_the_coaxial_file_is_not_installed_on_a_flat_octa_x(card: Card) -> None:
    for options in ((), ("--outputs-only",)):
        why = card.refused(parameters_of("octo-x"), *options, airframe="coax-x8")
        assert "those of coax-x8 (FRAME_CLASS 4, FRAME_TYPE 1), not of FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in why
        assert "motor 1: the airframe file has it at 45 deg, ccw; FRAME_CLASS 3, FRAME_TYPE 1 (octo-x) at 22.5" in why


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_a_file_with_reversed_spins_or_two_motors_changed_is_not_installed(
    name: str, frame: str, tmp_path: Path
) -> None:
    loaded = vehicle.load(name)
    before = of_parameters(Parameters(parameters_of(name), "a test"), None, tmp_path, loaded)
    assert before.contradictions(loaded) == []
    for what, file in wrong_files(loaded).items():
        with pytest.raises(ConfigError, match=r"nothing is installed.*FRAME_CLASS \d+, FRAME_TYPE \d+ \(" + frame):
            install(file, tmp_path, before)
        assert not list(tmp_path.iterdir()), what


@pytest.mark.parametrize("name", SHIPPED)
def test_a_file_of_another_number_of_motors_is_not_installed(name: str, tmp_path: Path) -> None:
    loaded = vehicle.load(name)
    before = of_parameters(Parameters(parameters_of(name), "a test"), None, tmp_path, loaded)
    for other in (vehicle.load(n) for n in SHIPPED):
        if other.motors != loaded.motors:
            with pytest.raises(ConfigError, match=rf"FRAME_CLASS is \d+, the airframe has {other.motors} motors"):
                install(other, tmp_path, before)
    assert not list(tmp_path.iterdir())


def test_an_airframe_that_is_no_frame_of_ardupilot_is_not_installed(card: Card) -> None:
    values = parameters_of("octo-x")
    eight = [frame for frame in catalogue.frames().values() if frame.motors == 8]
    for frame in eight:
        frame_class, frame_type = frame.ardupilot[0]
        why = card.refused({**values, "FRAME_CLASS": frame_class, "FRAME_TYPE": frame_type}, airframe="paper-octo")
        assert frame.name in why


# -- FRAME_CLASS is a script's already --------------------------------------------------------------------------------


def scripted(**changes: float) -> dict[str, float]:
    return {**parameters_of("octo-x"), "FRAME_CLASS": 17, **changes}


def test_what_is_kept_counts_when_the_applet_flies_already(card: Card) -> None:
    assert card.install(parameters_of("octo-x")).exit_code == 0
    kept = (card.folder / KEPT).read_bytes()
    result = card.install(scripted(FRAME_TYPE=0))
    assert result.exit_code == 0, result.output
    assert (card.folder / KEPT).read_bytes() == kept
    assert card.frame == 301
    assert "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in card.refused(scripted(), airframe="coax-x8")
    assert "octo-x, and coax-x8 was given" in card.refused(scripted(), "--frame", "coax-x8", airframe="coax-x8")


def test_what_flies_now_replaces_what_was_kept(card: Card) -> None:
    assert card.install(parameters_of("octo-x")).exit_code == 0
    assert card.install(parameters_of("coax-x8"), airframe="coax-x8").exit_code == 0
    assert card.kept()["FRAME_CLASS"] == 4
    assert card.frame == 401


@pytest.mark.parametrize("frame_class", [15, 17])
def test_where_nothing_is_kept_the_owner_names_the_frame(card: Card, frame_class: int) -> None:
    values = scripted(FRAME_CLASS=frame_class)
    why = card.refused(values)
    assert "--frame NAME" in why
    assert KEPT in why
    assert "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in card.refused(values, "--frame", "octo-x", airframe="coax-x8")
    result = card.install(values, "--frame", "octo-x")
    assert result.exit_code == 0, result.output
    assert "by the owner's word" in (card.folder / KEPT).read_text()
    assert (card.kept()["FRAME_CLASS"], card.kept()["FRAME_TYPE"], card.frame) == (3, 1, 301)


def test_a_script_of_somebody_elses_is_not_what_was_kept(card: Card) -> None:
    assert card.install(parameters_of("octo-x")).exit_code == 0
    assert "--frame NAME" in card.refused(scripted(FRAME_CLASS=15))


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ("octa-x", "nff airframe list"),
        ("dodeca-x-px4", "no frame of ArduPilot"),
        ("quad-v-tail", "FRAME_CLASS is 1, the airframe"),
    ],
)
def test_a_name_that_is_no_frame_for_it_is_refused(card: Card, frame: str, text: str) -> None:
    assert text in card.refused(scripted(), "--frame", frame)


def test_a_kept_file_that_is_spoilt_is_refused_by_name(card: Card) -> None:
    (card.folder / KEPT).write_text("FRAME_TYPE 1\n")
    assert KEPT in card.refused(scripted())


# -- parameters that do not say enough, or something else -------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"FRAME_CLASS": None}, "FRAME_CLASS is missing"),
        ({"FRAME_TYPE": None}, "FRAME_TYPE is missing"),
        ({"FRAME_TYPE": 99}, "FRAME_TYPE = 99 is no frame of ArduPilot"),
        ({"FRAME_CLASS": 6}, "a helicopter"),
        ({"SERVO3_FUNCTION": None}, "SERVO3_FUNCTION is missing: save all parameters"),
        ({"SERVO3_FUNCTION": 36, "SERVO4_FUNCTION": 35}, "SERVO3_FUNCTION is 36, motor 3 needs 35"),
        ({"MOT_SPIN_MIN": 0.05}, "MOT_SPIN_MIN is 0.05, the airframe file says 0.15"),
        ({"MOT_PWM_MAX": float("nan")}, "MOT_PWM_MAX = nan"),
        ({"MOT_PWM_MIN": 0, "RCMAP_THROTTLE": float("nan")}, "RCMAP_THROTTLE = nan"),
        ({"MOT_PWM_MIN": 0, "RCMAP_THROTTLE": 3, "RC3_MIN": float("inf")}, "RC3_MIN = inf"),
        ({"CA_AIRFRAME": 0}, "ArduPilot's and PX4's at once"),
    ],
)
def test_parameters_that_leave_it_open_or_contradict_are_refused(
    card: Card, change: dict[str, float | None], text: str
) -> None:
    values = {name: value for name, value in {**parameters_of("octo-x"), **change}.items() if value is not None}
    assert text in card.refused(values)


def test_the_parameters_of_a_px4_are_refused(card: Card) -> None:
    assert "PX4's" in card.refused({"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 8})


def test_a_name_beside_parameters_that_say_another_is_refused(card: Card) -> None:
    assert "coax-x8 was given" in card.refused(parameters_of("octo-x"), "--frame", "coax-x8", airframe="coax-x8")


def test_a_live_autopilot_is_asked(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def read(url: str, timeout_s: float) -> dict[str, float]:
        asked.append((url, timeout_s))
        return parameters_of("octo-x")

    monkeypatch.setattr(live_parameters, "read", read)
    options = ("--from", "udpin:0.0.0.0:14550", "--timeout", "9")
    assert "coax-x8" in card.refused(None, *options, airframe="coax-x8")
    assert card.install(None, *options).exit_code == 0
    assert asked == [("udpin:0.0.0.0:14550", 9.0)] * 2
    assert "by autopilot at udpin:0.0.0.0:14550" in (card.folder / KEPT).read_text()
    assert "give one of them" in card.refused(parameters_of("octo-x"), *options)


def test_a_path_with_any_character_in_it_leaves_a_file_that_can_be_read(tmp_path: Path) -> None:
    before = of_parameters(Parameters(parameters_of("octo-x"), "parameter file \u00fc\nx\udc80"), None, tmp_path, OCTO)
    install(OCTO, tmp_path, before)
    assert parameter_file.read(tmp_path / KEPT).values["FRAME_CLASS"] == 3


@pytest.mark.parametrize("name", [*SHIPPED, *OWN])
def test_an_emulated_vehicle_is_what_its_file_says(name: str) -> None:
    loaded = vehicle.load(name)
    before = of_trial(loaded)
    assert before.contradictions(loaded) == []
    frame = SHIPPED.get(name)
    assert before.number == (0 if frame is None else 100 * before.values["FRAME_CLASS"] + before.values["FRAME_TYPE"])
    assert (frame or name) in before.kept
