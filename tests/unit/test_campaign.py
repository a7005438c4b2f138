"""Campaigns: what is drawn, kept and counted; flown in tests/flight/test_campaign_flights.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from nff_companion.errors import ConfigError
from sitl.trials.campaign import manoeuvres, page, summary
from sitl.trials.campaign.scenario import Scenario, batches, drawn, read
from sitl.trials.campaign.store import Store

SCENARIO = Scenario(name="t", flights=240, airframes=("octo-x", "hexa-x"), faults=("total", "partial"), batch=7)


def row(flight: int, **changed: Any) -> dict[str, Any]:
    case = drawn(SCENARIO, flight)
    flown: dict[str, Any] = {
        "level": "calibrated",
        "named": list(case.motors),
        "either": [],
        "more": [],
        "unresponsive": [],
        "weak": [],
        "weak_left": None,
        "worn": [],
        "worn_sure": [],
        "worn_left": None,
        "said_wrong": [],
        "among": [],
        "among_s": None,
        "delay_s": 0.07,
        "wrong": [],
        "wrong_s": None,
        "changes": 1,
        "flaps": 0,
        "partly": [],
        "partly_s": None,
        "says": "reallocated",
        "survived": True,
        "alone_survived": True,
    }
    numbers = dict.fromkeys(("tilt_deg", "off_m", "low_m", "alone_tilt_deg", "alone_off_m", "alone_low_m"), 10.0)
    return case.row() | flown | numbers | changed


def test_batches_have_every_flight_once_and_one_airframe_each() -> None:
    found = batches(SCENARIO)
    assert sorted(flight for batch in found for flight in batch) == list(range(SCENARIO.flights))
    assert max(map(len, found)) == SCENARIO.batch
    for batch in found:
        assert len({drawn(SCENARIO, flight).airframe for flight in batch}) == 1


def test_a_flight_is_drawn_alike_whatever_else_is_flown_and_all_kinds_come_with_all() -> None:
    longer = replace(SCENARIO, flights=100_000, batch=50, name="other")
    assert [drawn(SCENARIO, k) for k in range(40)] == [drawn(longer, k) for k in range(40)]
    assert drawn(replace(SCENARIO, seed=2), 3) != drawn(SCENARIO, 3)
    kinds = {(c.airframe, c.manoeuvre, c.fault) for c in (drawn(SCENARIO, k) for k in range(SCENARIO.flights))}
    assert len(kinds) == 2 * 5 * 2
    for k in range(SCENARIO.flights):
        case = drawn(SCENARIO, k)
        assert all(1 <= motor <= (8 if case.airframe == "octo-x" else 6) for motor in case.motors)
        assert SCENARIO.at_s[0] <= case.at_s <= SCENARIO.at_s[1]
        assert (0.1 <= case.left <= 0.9) if case.fault == "partial" else case.left == 0.0


def test_two_motors_that_fail_are_two_and_a_healthy_flight_has_none() -> None:
    two = [drawn(replace(SCENARIO, motors=2), k) for k in range(40)]
    assert all(len(set(case.motors)) == 2 for case in two)
    assert drawn(replace(SCENARIO, faults=("none",)), 0).motors == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("flights = 0", "flights = 0 is not allowed"),
        ("flights = 5\nlevel = 'guess'", "level = 'guess' is not allowed: give one of 'exact'"),
        ("flights = 5\nat_s = [9.0, 2.0]", "at_s = [9.0, 2.0]: the first must not be above the second"),
        ("flights = 5\nmanoeuvres = []", "manoeuvres is empty"),
        ("flights = 5\nmanoeuvres = ['loop']", "manoeuvres[1] = 'loop' is not allowed"),
        ("flights = 5\nairframes = ['no-such']", "no-such"),
        ("flights = 5\nwinds = 3", "winds is not known"),
        ("", "flights is missing"),
    ],
)
def test_a_file_that_is_wrong_is_refused_by_name(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert said in str(caught.value)


def test_a_campaign_is_named_after_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("flights = 5", encoding="utf-8")
    assert read(path).name == "mine"


def test_what_was_flown_is_not_flown_again_and_another_campaign_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    all_batches = batches(SCENARIO)
    store = Store(tmp_path / "c", SCENARIO)
    assert store.missing(all_batches) == all_batches
    store.put(all_batches[1], [row(flight) for flight in all_batches[1]])
    again = Store(tmp_path / "c", SCENARIO)
    assert again.missing(all_batches) == [all_batches[0], *all_batches[2:]]
    assert again.rows(all_batches) == [row(flight) for flight in sorted(all_batches[1])]
    assert (tmp_path / "c" / "flights.parquet").exists()
    assert not list((tmp_path / "c").rglob("*.tmp"))
    with pytest.raises(ConfigError, match="another campaign"):
        Store(tmp_path / "c", replace(SCENARIO, seed=5))


def test_counts_and_their_intervals() -> None:
    rows = [row(k) for k in range(100)]
    rows[3] |= {"delay_s": None, "named": []}
    rows[7] |= {"wrong": [2], "wrong_s": 1.0}
    rows[9] |= {"survived": False}
    rows[12] |= {"delay_s": None, "named": [], "among": [[7], list(rows[12]["motors"])], "among_s": 0.2}
    found = summary.document(rows)
    whole = found["whole"]
    assert (whole["flights"], whole["right"], whole["wrong"], whole["missed"]) == (100, 97, 1, 2)
    assert whole["sets"] == 1  # of the missed: not known which, and said so
    assert whole["lost_though_alone_survived"] == 1
    assert whole["delay_median_s"] == 0.07
    assert set(found["tables"]) == {"airframe", "manoeuvre", "fault"}
    assert sum(t["flights"] for t in found["tables"]["fault"].values()) == 100
    assert [r["flight"] for r in found["exceptions"]] == [r for r in (3, 7, 9, 12) if summary.exception(rows[r])]
    # Three in a rate: none seen in n is at most 3 / n.
    assert summary.at_most(0, 1000) == pytest.approx(3.0 / 1000, rel=0.01)
    assert summary.rate_at_most(0, 100.0) == pytest.approx(0.03, rel=0.01)
    assert summary.at_most(5, 5) == 1.0


def test_a_working_motor_that_is_allocated_around_is_an_exception_and_a_partly_lost_one_is_not() -> None:
    rows = [row(k) for k in range(3)]
    works = next(motor for motor in range(1, 7) if motor not in rows[1]["motors"])
    rows[1] |= {"partly": [works], "partly_s": 0.4}
    rows[2] |= {"partly": list(rows[2]["motors"]), "partly_s": 0.4}
    found = summary.document(rows)
    assert (found["whole"]["partly"], found["whole"]["partly_wrong"]) == (2, 1)
    assert [r["flight"] for r in found["exceptions"]] == [1]
    assert str(works) in summary.exception(rows[1])


def test_the_page_holds_each_exception_and_no_markup_of_others(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    rows = [row(k) for k in range(4)]
    rows[1] |= {"wrong": [2], "wrong_s": 1.0, "says": "<b>bold</b>"}
    page.write(tmp_path / "index.html", replace(SCENARIO, name="<i>"), summary.document(rows), rows)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "flight 1:" in text
    assert "&lt;b&gt;bold" in text
    assert "<i>" not in text.split("<script")[0]
    assert "http://" not in text.split("<script")[0]


@pytest.mark.parametrize("manoeuvre", ["hover", "climb", "descent", "turn", "forward", "steps"])
def test_legs_begin_in_order_and_are_the_same_for_a_seed(manoeuvre: Any) -> None:
    found = manoeuvres.legs(manoeuvre, 5, 20.0)
    assert repr(found) == repr(manoeuvres.legs(manoeuvre, 5, 20.0))
    times = [leg.from_s for leg in found]
    assert times == sorted(times)
    assert (not found) == (manoeuvre == "hover")
