"""The page of a flight stands alone, says what happened, and takes no text of the log for markup."""

from __future__ import annotations

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from flown_logs import Flight, log_flight

from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.replay import why
from nff_companion.replay.page.page import page
from nff_companion.replay.page.plot import Curve, plot

EVIL = "<script>alert(1)</script>&\"'[b].bin"
VOID = {"meta", "br", "img", "link", "input"}
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")


class Parsed(HTMLParser):
    """Tags and texts; fails where tags do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.text += data


def asked(
    model: Vehicle, frame: str, rng: np.random.Generator, lost: dict[int, float], **more: Any
) -> tuple[dict[str, Any], str]:
    rows = Flight(model, seconds=14.0, fail_s=10.0, lost=lost).rows(rng)
    return why._of_flight(log_flight(rows, name=EVIL, **more), why.Question(frame=frame, pages=True))


def stands_alone(text: str) -> Parsed:
    parsed = Parsed(text)
    for tag, attributes in parsed.tags:
        assert tag not in ("script", "link", "img", "iframe", "object", "embed")
        assert not {"src", "href", "xlink:href", "srcset", "onload", "data", "action"} & attributes.keys()
    assert "http" not in text.replace("http-equiv", "")
    assert "url(" not in text
    for picture in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        assert ElementTree.fromstring(picture).tag == "svg"
    assert "@import" not in text
    return parsed


def test_a_lost_motor_of_an_octorotor_is_shown_with_its_evidence(rng: np.random.Generator) -> None:
    said, text = asked(vehicle.load("octo-x"), "octo-x", rng, {3: 0.0})
    assert [fault["motor"] for fault in said["faults"]] == [3]
    parsed = stands_alone(text)
    assert 10.0 < said["faults"][0]["time_s"] < 11.0
    assert f"Motor 3 failed, {said['faults'][0]['time_s']:.2f} s" in parsed.text
    assert EVIL in parsed.text
    assert "The motors left can carry it" in parsed.text
    assert "motor 3, failed" in parsed.text
    assert sum(attributes.get("class") == "failed" for _, attributes in parsed.tags) == 1
    plots = [attributes for _, attributes in parsed.tags if attributes.get("class") == "plot"]
    assert len(plots) == 5  # four axes, and the motors
    assert sum(attributes.get("stroke") == "#d50000" for _, attributes in parsed.tags) >= 10


def test_a_quadrotor_that_loses_one_is_named_and_nothing_could_be_done(rng: np.random.Generator) -> None:
    said, text = asked(vehicle.load("h250"), "quad-x-clockwise", rng, {2: 0.0})
    assert [fault["motor"] for fault in said["faults"]] == [2]
    assert "The motors left can carry it" not in stands_alone(text).text
    assert "What the companion would have done" in text


def test_a_flight_without_a_fault_has_a_page_too(rng: np.random.Generator) -> None:
    said, text = asked(vehicle.load("octo-x"), "octo-x", rng, {})
    assert said["verdict"] == "no_fault"
    parsed = stands_alone(text)
    assert "No motor failed" in parsed.text
    assert "would have done" not in parsed.text


def test_a_flight_that_was_not_judged_says_why(rng: np.random.Generator) -> None:
    said, text = asked(vehicle.load("octo-x"), "", rng, {})
    assert said["verdict"] == "not_judged"
    parsed = stands_alone(text)
    assert "It cannot be told whether a motor failed" in parsed.text
    assert "give --frame" in parsed.text
    assert said["airframe"] is None


def test_every_text_of_the_log_is_escaped() -> None:
    said = {
        "file": EVIL,
        "system": None,
        "verdict": "not_judged",
        "reason": EVIL,
        "frame": EVIL,
        "duration_s": 0.0,
        "judged_s": 0.0,
        "refused_samples": 0,
        "explained": dict.fromkeys(("thrust", "roll", "pitch", "yaw")),
        "faults": [],
        "notes": [EVIL],
        "airframe": {"how": [EVIL]},
    }
    text = page(said, None, None)
    assert "<script" not in text
    assert stands_alone(text).text.count(EVIL) == 5


@pytest.mark.skipif(BROWSER is None, reason="no chromium: NO PAGE WAS OPENED in a browser")
def test_a_browser_draws_the_page(rng: np.random.Generator, tmp_path: Path) -> None:
    _, text = asked(vehicle.load("octo-x"), "octo-x", rng, {3: 0.0})
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    command = [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=2000", "--dump-dom"]
    done = subprocess.run(
        [*command, (tmp_path / "page.html").as_uri()], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.count('class="plot"') == 5
    assert "Motor 3 failed" in done.stdout


TIME_S = np.linspace(10.0, 20.0, 200)


def texts(picture: str) -> list[tuple[str, float, float]]:
    """(text, x, y) of all that a plot has written on it."""
    out = []
    for node in ElementTree.fromstring(picture[: picture.index("</svg>") + 6]).iter("text"):
        out.append((node.text or "", float(node.attrib["x"]), float(node.attrib["y"])))
    return out


@pytest.mark.parametrize("reach", [0.019, 0.41, 0.9, 1.9, 23.0, 41.0, 700.0])
def test_an_axis_bears_three_numbers_at_least(reach: float) -> None:
    picture = plot("roll, rad/s²", TIME_S, [Curve("measured", reach * np.sin(TIME_S), "#000")], [])
    numbers = [text for text, _, _ in texts(picture) if re.fullmatch(r"-?[\d.]+", text)]
    assert 3 <= len(numbers) <= 9


def test_what_is_marked_is_written_beside_its_line_and_no_text_covers_another() -> None:
    marks = [(12.0, "motor 1 named"), (12.01, "motor 3 named"), (12.6, "motor 5 named"), (19.9, "motor 1 works again")]
    picture = plot("effectiveness", TIME_S, [Curve("motor 1", np.ones(200), "#000")], marks)
    written = {text: (x, y) for text, x, y in texts(picture)}
    assert "motor 1 named, motor 3 named" in written
    assert written["motor 5 named"][1] > written["motor 1 named, motor 3 named"][1]
    assert 'text-anchor="end">motor 1 works again' in picture


def test_a_step_that_lasts_a_moment_is_not_cut_off() -> None:
    values = np.where(np.arange(1000) < 4, -0.9, 0.4 * np.sin(np.arange(1000)))
    picture = plot("yaw", np.linspace(0.0, 10.0, 1000), [Curve("measured", values, "#000")], [])
    path = re.search(r'<path d="M0*[\d.]+ ([\d.]+) L[^"]*" fill="none"', picture)
    assert path is not None
    axis = {float(text): y for text, x, y in texts(picture) if re.fullmatch(r"-?[\d.]+", text) and x < 64.0}
    per_unit = (axis[0.0] - axis[-0.5]) / 0.5
    assert float(path[1]) == pytest.approx(axis[0.0] - 4.0 - 0.9 * per_unit, abs=0.2)


def test_curves_are_named_once_for_all_axes(rng: np.random.Generator) -> None:
    _, text = asked(vehicle.load("octo-x"), "octo-x", rng, {3: 0.0})
    assert text.count('class="legend"') == 2  # the axes, and the motors
    assert Parsed(text).text.count("less what whole motors would give") == 1 + 4  # and the titles of the curves


def test_the_number_of_a_failed_motor_is_written_over_its_cross(rng: np.random.Generator) -> None:
    _, text = asked(vehicle.load("octo-x"), "octo-x", rng, {3: 0.0})
    cross = text.index('class="failed"')
    assert re.search(r">3</text>", text[cross : cross + 500]) is not None


def test_texts_of_a_plot_are_larger_on_a_narrow_screen(rng: np.random.Generator) -> None:
    _, text = asked(vehicle.load("octo-x"), "octo-x", rng, {})
    assert re.search(r"@media \(max-width: \d+px\) \{[^}]*svg\.plot \{ font-size", text) is not None
