"""What is said to be in force is what the autopilot confirmed, in every way of saying it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from stepping import Stepped

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.announcer import Announcer
from nff_companion.autopilots.times import CONFIRM_MAX_S
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, InForce, Mode, Reason, Source, Statement, read_only
from nff_companion.core.parts import FLOWN
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect
from nff_companion.reporting import Moment, Reporter
from nff_companion.verdict import Confirmation, confirmed, verdict

THIRD = read_only(np.eye(8, dtype=bool)[2])
NOBODY = read_only(np.zeros(8, bool))
WORKING = np.where(THIRD, 0.0, 1.0)


@pytest.fixture
def plan(octo: Vehicle) -> Plan:
    found = make_plan(allocator("trim"), octo.effectiveness, WORKING, octo.hover)
    assert isinstance(found, Plan)
    return found


def wanting(**change: Any) -> Output:
    """What a companion in flight wants of the autopilot."""
    return replace(Stepped().state.last, mode=Mode.ALLOCATE, flying=True, obstacle=None, **change)


def holding(source: Source, failed: Any = THIRD, *, takes_matrix: bool = True) -> Condition:
    return Condition(takes_matrix=takes_matrix, in_force=InForce(source, failed))


def test_motors_are_confirmed_by_the_same_set_and_nothing_else(plan: Plan) -> None:
    output = wanting(failed=THIRD, plan=plan)
    assert confirmed(output, holding(Source.MATRIX))
    for other in (NOBODY, np.eye(8, dtype=bool)[1], THIRD | np.eye(8, dtype=bool)[1], None):
        assert not confirmed(output, holding(Source.MATRIX, other))
    assert not confirmed(wanting(), holding(Source.DECLARATION)), "lifted, and still held"


def test_a_matrix_is_confirmed_by_a_matrix(plan: Plan) -> None:
    output = wanting(failed=THIRD, plan=plan)
    held = {source: confirmed(output, holding(source)) for source in Source}
    assert held == {Source.STOCK: False, Source.DECLARATION: False, Source.MATRIX: True, Source.OVERRIDE: True}
    assert confirmed(output, holding(Source.DECLARATION, takes_matrix=False)), "none was sent"


def test_outputs_are_confirmed_by_outputs() -> None:
    output = replace(wanting(override=np.full(8, 0.5)), mode=Mode.OVERRIDE)
    assert [source for source in Source if confirmed(output, holding(source, NOBODY))] == [Source.OVERRIDE]


def test_a_partial_loss_that_is_told_by_declaration_is_confirmed_by_one() -> None:
    output = wanting(degraded=THIRD, effectiveness=np.where(THIRD, 0.5, 1.0))
    held = [s for s in Source if confirmed(output, holding(s, NOBODY, takes_matrix=False))]
    assert held == [Source.DECLARATION]


def test_one_of_two_motors_above_each_other_is_said_as_such(octo: Vehicle, plan: Plan) -> None:
    both = read_only(np.isin(np.arange(8), (2, 7)))
    output, condition = wanting(degraded=both, either=(3, 8), plan=plan), holding(Source.MATRIX)
    said = verdict(output, condition, Mode.ALLOCATE, FLOWN, None)
    assert said.reason in (Reason.EITHER, Reason.EITHER_NO_YAW)
    assert said.text.startswith("reallocated: motor 3 or 8 lost")
    moment = Moment(output, condition, Mode.ALLOCATE, said, None)
    assert Reporter(octo, None, 1).document(moment, 0.0, [])["either"] == [3, 8]


def test_sets_of_motors_that_cannot_be_told_apart_are_said_and_nothing_is_claimed(octo: Vehicle) -> None:
    output = wanting(among=((1, 2), (7, 8)))
    condition = holding(Source.STOCK)
    said = verdict(output, condition, Mode.ALLOCATE, FLOWN, None)
    assert (said.reason, said.text) == (Reason.AMONG, "LAND: motors 1+2 or 7+8 lost, not told which")
    assert len(said.text.encode()) <= 45  # what a pilot's screen takes at once, behind "NFF: "
    assert verdict(output, condition, Mode.OBSERVE, FLOWN, None) == said
    one = verdict(wanting(among=((1, 2),)), condition, Mode.ALLOCATE, FLOWN, None)
    assert (one.reason, one.text) == (Reason.PERHAPS, "LAND: motors 1+2 may be lost")
    assert verdict(wanting(more=(3,)), condition, Mode.OBSERVE, FLOWN, None).reason == Reason.MORE
    silent = verdict(wanting(unresponsive=(3,)), condition, Mode.ALLOCATE, FLOWN, None)
    assert (silent.reason, silent.text) == (Reason.UNRESPONSIVE, "LAND: motor 3 does not answer")
    assert verdict(wanting(unresponsive=(3,)), condition, Mode.OBSERVE, FLOWN, None) == silent
    for mode in (Mode.OBSERVE, Mode.ALLOCATE):
        weak = verdict(wanting(weak=(2, 5)), condition, mode, FLOWN, None)
        assert (weak.reason, weak.text) == (Reason.WEAK, "motor 2 or 5 has lost a part of its thrust")
        less = verdict(wanting(worn=(4,), worn_left=0.9), condition, mode, FLOWN, None)
        assert (less.reason, less.text) == (Reason.WORN_OR_LOAD, "motor 4 gives less, or a load moved")
        less = verdict(wanting(worn=(4,), worn_left=0.9, worn_sure=True), condition, mode, FLOWN, None)
        assert (less.reason, less.text) == (Reason.WORN, "motor 4 gives less thrust than before")
        assert verdict(wanting(worn=(4,), weak=(2,)), condition, mode, FLOWN, None).reason == Reason.WEAK
    assert verdict(wanting(), condition, Mode.OBSERVE, FLOWN, None).reason == Reason.OBSERVING
    worn = Moment(wanting(worn=(4,), worn_left=0.896), condition, Mode.ALLOCATE, less, None)
    assert Reporter(octo, None, 1).document(worn, 0.0, [])["worn"] == {"motors": [4], "left": 0.9, "or_load": True}
    moment = Moment(output, condition, Mode.ALLOCATE, said, None)
    document = Reporter(octo, None, 1).document(moment, 0.0, [])
    assert (document["among"], document["probing"]) == ([[1, 2], [7, 8]], False)


def test_a_test_of_which_motors_are_lost_is_said(octo: Vehicle, plan: Plan) -> None:
    output, condition = wanting(among=((1, 2), (7, 8)), plan=plan, probing=True), holding(Source.MATRIX)
    said = verdict(output, condition, Mode.ALLOCATE, FLOWN, None)
    assert (said.reason, said.text) == (Reason.PROBING, "motors 1+2 or 7+8 lost: testing which")
    moment = Moment(output, condition, Mode.ALLOCATE, said, None)
    assert Reporter(octo, None, 1).document(moment, 0.0, [])["probing"]
    # A test that the autopilot does not take is not claimed.
    late = verdict(output, holding(Source.STOCK), Mode.ALLOCATE, FLOWN, 1.0)
    assert late.reason == Reason.NOT_CONFIRMED


def test_what_is_wanted_and_not_confirmed_is_said_after_its_time_and_never_claimed(plan: Plan) -> None:
    output, waiting = wanting(failed=THIRD, plan=plan), Confirmation()
    for condition, reasons in (
        (holding(Source.STOCK, NOBODY), {Reason.TELLING, Reason.NOT_CONFIRMED}),
        (holding(Source.MATRIX), {Reason.REALLOCATED}),
        (holding(Source.DECLARATION), {Reason.TELLING, Reason.NOT_CONFIRMED}),
    ):
        said = []
        for k in range(100):
            unconfirmed_s = waiting.step(output, condition, 0.01 * k)
            said.append((0.01 * k, verdict(output, condition, Mode.ALLOCATE, FLOWN, unconfirmed_s).reason))
        assert {reason for _, reason in said} == reasons
        late = [at_s for at_s, reason in said if reason == Reason.NOT_CONFIRMED]
        assert not late or CONFIRM_MAX_S < late[0] < CONFIRM_MAX_S + 0.02


@pytest.mark.parametrize("source", list(Source))
def test_status_and_document_say_the_autopilots_word(octo: Vehicle, plan: Plan, source: Source) -> None:
    output, condition = wanting(failed=THIRD, plan=plan), holding(source, NOBODY)
    adapter: Any = type("Heard", (), {"name": "nff", "target": (1, 1)})
    moment = Moment(output, condition, Mode.ALLOCATE, Statement(Reason.TELLING, "3"), adapter)
    reporter = Reporter(octo, None, 1)
    (status,) = [m for m in reporter.due(moment, 0.0) if m.get_type() == "NFF_COMPANION_STATUS"]
    assert status.source == source
    document = reporter.document(moment, 0.0, [])
    assert document["failed"] == [3]
    assert document["autopilot"]["failed"] == []
    assert document["autopilot"]["allocation"] == source.name.lower()


@pytest.mark.parametrize(
    ("reason", "severity", "word"),
    [
        (Reason.NO_LIFT, dialect.MAV_SEVERITY_CRITICAL, "LAND"),
        (Reason.NO_PLAN, dialect.MAV_SEVERITY_CRITICAL, "no new matrix"),
        (Reason.NOT_TOLD, dialect.MAV_SEVERITY_CRITICAL, "not told"),
        (Reason.NOT_CONFIRMED, dialect.MAV_SEVERITY_CRITICAL, "NOT confirmed"),
        (Reason.TWIN, dialect.MAV_SEVERITY_ERROR, "companion"),
        (Reason.RATE, dialect.MAV_SEVERITY_ERROR, "Hz"),
        (Reason.TELEMETRY_STOPPED, dialect.MAV_SEVERITY_ERROR, "stopped"),
        (Reason.EITHER, dialect.MAV_SEVERITY_CRITICAL, "lost"),
        (Reason.EITHER_NO_YAW, dialect.MAV_SEVERITY_CRITICAL, "lost"),
        (Reason.AMONG, dialect.MAV_SEVERITY_CRITICAL, "LAND"),
        (Reason.PERHAPS, dialect.MAV_SEVERITY_CRITICAL, "LAND"),
        (Reason.MORE, dialect.MAV_SEVERITY_CRITICAL, "LAND"),
        (Reason.UNRESPONSIVE, dialect.MAV_SEVERITY_CRITICAL, "LAND"),
        (Reason.WEAK, dialect.MAV_SEVERITY_WARNING, "part of its thrust"),
        (Reason.WORN_OR_LOAD, dialect.MAV_SEVERITY_WARNING, "or a load"),
        (Reason.WORN, dialect.MAV_SEVERITY_WARNING, "less thrust"),
        (Reason.PROBING, dialect.MAV_SEVERITY_WARNING, "testing"),
        (Reason.PARTIAL, dialect.MAV_SEVERITY_WARNING, "partial loss of motor x"),
        (Reason.PARTIAL_NO_YAW, dialect.MAV_SEVERITY_WARNING, "motor x partly lost"),
    ],
)
def test_the_pilot_is_told_once_when_it_begins(reason: Reason, severity: int, word: str) -> None:
    announcer, said = Announcer(), Statement(reason, "x")
    (text,) = announcer.verdict(said, 10.0)
    assert text.severity == severity
    assert word in str(text.text)
    assert announcer.verdict(said, 20.0) == []


# What is not said because it goes without saying, is said otherwise, or is for the moment until something is.
NOT_SAID = {Reason.OBSERVING, Reason.NOT_WATCHING, Reason.TELLING, Reason.HEALTHY}


@pytest.mark.parametrize("reason", [reason for reason in Reason if 40 <= reason.priority < 50 or reason.priority >= 60])
def test_whatever_is_believed_of_motors_or_done_about_them_reaches_the_pilot(reason: Reason) -> None:
    if reason in NOT_SAID or reason.priority >= 70:  # notes are said as such
        return
    (text,) = Announcer().verdict(Statement(reason, "1"), 10.0)
    assert len(str(text.text)) <= 50


@pytest.mark.parametrize(
    "reason",
    [
        Reason.AMONG,
        Reason.PERHAPS,
        Reason.MORE,
        Reason.UNRESPONSIVE,
        Reason.WEAK,
        Reason.WORN,
        Reason.EITHER,
        Reason.PARTIAL,
    ],
)
def test_other_motors_are_news(reason: Reason) -> None:
    announcer = Announcer()
    assert announcer.verdict(Statement(reason, "1+2 or 7+8"), 10.0)
    assert announcer.verdict(Statement(reason, "1+2 or 7+8"), 12.0) == []
    assert announcer.verdict(Statement(reason, "3+6 or 4+5"), 14.0)


def test_that_one_should_land_is_not_cut_off() -> None:
    for reason in (Reason.AMONG, Reason.PERHAPS, Reason.MORE, Reason.UNRESPONSIVE, Reason.NO_LIFT):
        (text,) = Announcer().verdict(Statement(reason, "10+12 or 14+16 or 11+13 or 15+17"), 10.0)
        assert "LAND" in str(text.text)
