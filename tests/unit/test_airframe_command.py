"""``nff airframe``: what is drawn, listed and written; every fault is one line and exit code 2."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from nff_companion.cli import main
from nff_companion.core import vehicle
from nff_companion.frames import catalogue, drawing

NAMES = list(catalogue.frames())


class Nff:
    """The command line, in this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._patch, self._capsys = monkeypatch, capsys

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        """Exit code, standard output, standard error."""
        self._patch.setattr(sys, "argv", ["nff", "airframe", *arguments])
        with pytest.raises(SystemExit) as end:
            main.main()
        out = self._capsys.readouterr()
        return int(end.value.code or 0), out.out, out.err

    def document(self, *arguments: str) -> Any:
        code, out, _ = self(*arguments, "--json")
        assert code == 0
        return json.loads(out)


@pytest.fixture
def nff(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Nff:
    return Nff(monkeypatch, capsys)


def labels(text: str) -> dict[int, str]:
    """Spin by motor of what a drawing names."""
    return {int(number): spin for number, spin in re.findall(r"\b(\d+)(ccw|cw|)\b", text)}


@pytest.mark.parametrize("name", NAMES)
def test_a_drawing_of_characters_has_every_motor_once_with_its_spin(name: str) -> None:
    frame = catalogue.by_name(name)
    text = drawing.characters(frame)
    assert text.isascii()
    assert max(map(len, text.splitlines())) <= 79
    found = re.findall(r"\d+(?:ccw|cw)?", text)
    assert sorted(found) == sorted(drawing.label(frame, motor) for motor in range(frame.motors))
    assert labels(text) == {k + 1: {1: "ccw", -1: "cw", 0: ""}[int(spin)] for k, spin in enumerate(frame.spin)}


@pytest.mark.parametrize("name", NAMES)
def test_a_drawing_has_ahead_above_and_right_on_the_right(name: str) -> None:
    frame = catalogue.by_name(name)
    rows: dict[int, tuple[int, int]] = {}
    for row, line in enumerate(drawing.characters(frame).splitlines()):
        for match in re.finditer(r"[\dcw/]*\d[\dcw/]*", line):
            for number in labels(match.group()):
                rows[number - 1] = (row, match.start() + match.end())
    for one in range(frame.motors):
        for other in range(frame.motors):
            ahead, aside = frame.place[one] - frame.place[other]
            if ahead > 0.2:
                assert rows[one][0] < rows[other][0]
            if aside > 0.2:
                assert rows[one][1] > rows[other][1]


def test_coaxial_motors_are_drawn_side_by_side() -> None:
    assert "1ccw/6cw" in drawing.characters(catalogue.by_name("coax-x8"))


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_is_svg_with_every_motor_inside(name: str) -> None:
    frame = catalogue.by_name(name)
    root = ElementTree.fromstring(drawing.svg(frame, "a <frame> & more"))
    space = "{http://www.w3.org/2000/svg}"
    assert root.findtext(f"{space}title") == "a <frame> & more"
    hubs = [c for c in root.iter(f"{space}circle") if c.get("r") == "30"]
    places = [(float(c.get("cx", "nan")), float(c.get("cy", "nan"))) for c in hubs]
    assert len(set(places)) == frame.motors
    assert all(30.0 <= x <= 450.0 and 30.0 <= y <= 450.0 for x, y in places)
    numbers = [t.text for t in root.iter(f"{space}text") if t.get("font-size") == "18"][1:]
    assert sorted(map(int, filter(None, numbers))) == list(range(1, frame.motors + 1))


def test_every_frame_is_listed_with_its_numbers(nff: Nff) -> None:
    code, out, err = nff("list")
    assert (code, out) == (0, "")
    assert all(re.search(rf"^ {name} ", err, re.MULTILINE) for name in NAMES)
    listed = {frame["name"]: frame for frame in nff.document("list")["frames"]}
    assert list(listed) == NAMES
    assert listed["octo-x"]["ardupilot"] == [[3, 1]]
    assert listed["octo-x"]["px4"] == [8001]
    assert len(listed["octo-x"]["motors"]) == 8


def test_a_frame_is_shown_with_a_table_in_metres_and_a_picture(nff: Nff, tmp_path: Path) -> None:
    picture = tmp_path / "[red]octo[red].svg"
    code, out, err = nff("show", "octo-x", "--arm", "0.5", "--svg", str(picture))
    assert (code, out) == (0, "")
    assert "nose" in err
    assert re.search(r"1 +0\.462 +0\.191 +cw", err)
    assert str(picture) in err
    assert ElementTree.parse(picture).getroot().tag.endswith("svg")
    shown = nff.document("show", "octo-x", "--arm", "0.5")
    assert shown["motors"][2] == {"motor": 3, "forward": 0.1913, "right": 0.4619, "spin": "ccw"}


def test_an_airframe_file_is_shown_too(nff: Nff) -> None:
    shown = nff.document("show", str(vehicle.path_of("paper-octo")))
    assert shown["arm_m"] == pytest.approx(0.785, abs=1e-3)
    assert shown["motors"][0] == {"motor": 1, "forward": 0.4401, "right": -0.65, "spin": "cw"}


def test_which_frame_an_airframe_file_is_is_said(nff: Nff) -> None:
    for name, frame, text in (
        ("arducopter-octa-x", "octo-x", "It is octo-x, motor by motor."),
        ("paper-octo", None, "It is no frame of the catalogue."),
    ):
        path = str(vehicle.path_of(name))
        assert nff.document("show", path)["frame"] == frame
        assert text in nff("show", path)[2]
    assert "frame" not in nff.document("show", "octo-x")


def test_a_new_airframe_is_written_and_what_is_guessed_is_named(nff: Nff, tmp_path: Path) -> None:
    path = tmp_path / "[bold]mine.toml"
    made = nff.document("new", "--out", str(path), "--frame", "octo-x", "--arm", "0.5", "--mass", "6")
    assert made["frame"] == "octo-x"
    assert "motor.max_thrust_n" in made["guessed"]
    assert "airframe.mass_kg" not in made["guessed"]
    assert vehicle.load(str(path)).motors == 8
    code, _, err = nff("new", "--out", str(path), "--frame", "octo-x", "--arm", "0.5")
    assert code == 2
    assert f"{path} exists already" in err


def test_a_new_airframe_is_made_of_a_parameter_file(nff: Nff, tmp_path: Path) -> None:
    parameters = tmp_path / "my [red]octo.param"
    parameters.write_text("FRAME_CLASS,3\nFRAME_TYPE,1\nMOT_SPIN_MIN,0.11\n")
    path = tmp_path / "mine.toml"
    code, _, err = nff("new", "--out", str(path), "--parameters", str(parameters), "--arm", "0.5")
    assert code == 0
    assert "octo-x of ArduPilot, 8 motors" in err
    assert vehicle.load(str(path)).command.spin_min == 0.11


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("show", "[red]octa[/red]"), r"\[red\]octa\[/red\]"),
        (("show", "octo-x", "--arm", "nan"), "--arm nan"),
        (("show", "octo-x", "--svg", "/nowhere/[x].svg"), r"/nowhere/\[x\]\.svg cannot be written"),
        (("show", "nowhere.toml"), "nowhere.toml"),
        (("show", "octo-x.toml", "--arm", "1"), "--arm"),
        (("new", "--out", "x.toml", "--arm", "0.5"), "--frame NAME"),
        (("new", "--out", "x.json", "--arm", "0.5", "--frame", "octo-x"), "suffix"),
        (("new", "--out", "x.toml", "--arm", "50", "--frame", "octo-x"), "0.02 to 10 m"),
        (("new", "--out", "x.toml", "--arm", "0.3", "--mass", "5000", "--frame", "octo-x"), "0.02 to 3000 kg"),
        (("new", "--out", "x.toml", "--arm", "0.3", "--mass", "900", "--frame", "octo-x"), "farthest"),
        (("new", "--out", "x.toml", "--arm", "0.5", "--frame", "quad-v-tail"), "no model"),
        (("new", "--out", "x.toml", "--arm", "0.5", "--frame", "octo-x", "--autopilot", "beta"), "beta"),
        (("new", "--out", "/nowhere/x.toml", "--arm", "0.5", "--frame", "octo-x"), "cannot be written"),
        (("new", "--out", "x.toml", "--arm", "0.5", "--parameters", "[b].param"), r"\[b\]\.param cannot be read"),
    ],
    ids=lambda part: " ".join(part)[:50] if isinstance(part, tuple) else "",
)
def test_a_fault_is_one_line_that_quotes_what_was_given(
    nff: Nff, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = nff(*arguments)
    assert (code, out) == (2, "")
    assert re.search(words, err)
    assert err.startswith("nff: ")
    assert err.count("\n") == 1
    assert not (tmp_path / "x.toml").exists()
