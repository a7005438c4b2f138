"""A campaign is flown: by workers of its own, and each flight as it would be alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle as vehicles
from nff_companion.core.parts import Parts
from nff_companion.core.tuning import Tuning
from sitl import airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.campaign.fly import fly
from sitl.trials.campaign.run import run
from sitl.trials.campaign.scenario import MANOEUVRES, Event, Scenario, batches
from sitl.trials.campaign.store import Store
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight


def test_a_flight_is_the_same_alone_and_beside_others() -> None:
    scenario = Scenario(name="t", flights=6, at_s=(3.0, 5.0), fly_on_s=1.5, manoeuvres=("turn", "forward"), batch=6)
    together = fly(scenario, tuple(range(6)))
    assert [row["named"] for row in together] == [row["motors"] for row in together]
    assert fly(scenario, (3,)) == [together[3]]


def test_workers_fly_what_is_missing_and_nothing_else(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    scenario = Scenario(name="t", flights=3, at_s=(2.0, 2.5), fly_on_s=0.5, manoeuvres=("hover",), batch=1)
    store, seen = Store(tmp_path, scenario), list[tuple[int, int]]()
    first, *_ = all_batches = batches(scenario)
    marked = fly(scenario, first)
    marked[0]["says"] = "flown before"
    store.put(first, marked)
    assert run(scenario, store, workers=2, progress=lambda done, whole: seen.append((done, whole))) == []
    assert seen == [(1, 3), (2, 3), (3, 3)]
    rows = store.rows(all_batches)
    assert [row["says"] == "flown before" for row in rows] == [True, False, False]
    assert run(scenario, store, progress=lambda done, whole: seen.append((done, whole))) == []
    assert seen[3:] == [(3, 3)]


def test_what_is_no_fault_happens_and_is_not_declared() -> None:
    events: tuple[Event, ...] = ("gust", "drop", "hook", "shift", "sag")
    calm = Scenario(name="t", flights=5, faults=("none",), manoeuvres=("hover",), at_s=(3.0, 4.0), fly_on_s=3.0)
    moved = msgspec.structs.replace(calm, events=events)
    flown = [fly(scenario, tuple(range(5))) for scenario in (calm, moved)]
    assert [row["event"] for row in flown[1]] == list(events)
    for row, without in zip(*reversed(flown), strict=True):
        assert (row["seed"], row["at_s"]) == (without["seed"], without["at_s"])
        seen = "off_m", "low_m", "tilt_deg"
        assert [row[key] for key in seen] != [without[key] for key in seen], row
        for each in (row, without):
            assert each["wrong"] == [], each
            assert each["survived"], each


def flown(flight: int, **options: Any) -> dict[str, Any]:
    """The row of one flight of three frames in four manoeuvres, unless ``options`` say otherwise."""
    usual: dict[str, Any] = {
        "airframes": ("octo-x", "octo-plus", "coax-x8"),
        "manoeuvres": ("hover", "turn", "forward", "take-off"),
    }
    (row,) = fly(Scenario(name="t", flights=flight + 1, **usual | options), (flight,))
    return row


@pytest.mark.parametrize(("flight", "seconds"), [(36, 2.5), (9, 4.0), (27, 4.0)])
def test_a_load_that_slid_is_no_loss(flight: int, seconds: float) -> None:
    """In hover (36): a partial loss of motor 5 after 1.9 s."""
    row = flown(flight, faults=("none",), events=("shift",), seed=51, fly_on_s=seconds)
    assert (row["event"], row["wrong"], row["partly"], row["either"]) == ("shift", [], [], []), row
    assert row["said_wrong"] == [], row


def test_a_load_that_slid_below_a_motor_while_the_air_sank_is_not_declared() -> None:
    """In a turn, where the lift seems to lack what the motor would: motors 1 and 6 partly, and 8 was declared."""
    row = flown(41, faults=("none",), events=("shift",), seed=51, fly_on_s=8.0)
    assert (row["event"], row["wrong"], row["either"], row["changes"], row["flaps"]) == ("shift", [], [], 0, 0), row


def test_one_of_the_two_that_works_again_does_not_look_like_the_loss_of_one_across() -> None:
    """In fast flight: motor 7 was declared, and the vehicle crashed."""
    row = flown(44, faults=("intermittent",), seed=71, fly_on_s=4.0)
    assert (row["either"], row["wrong"], row["survived"]) == ([2, 5], [], True), row


def test_a_motor_lost_in_fast_flight_is_not_taken_for_those_on_both_sides_of_it() -> None:
    """Its yaw is what its drag was, beside what it turned; taken for the yaw of 5 and 6, the vehicle crashed."""
    row = flown(103, manoeuvres=MANOEUVRES, level="estimated", seed=43, fly_on_s=1.0)
    assert (row["manoeuvre"], row["motors"], row["named"], row["wrong"]) == ("forward", [7], [7], []), row
    assert row["delay_s"] < 0.3
    assert row["survived"]


def test_an_output_that_is_stuck_is_said_when_the_others_move() -> None:
    row = flown(6, manoeuvres=("hover", "turn", "forward", "climb"), faults=("stuck", "slow"), seed=81, fly_on_s=6.0)
    assert (row["fault"], row["unresponsive"], row["wrong"]) == ("stuck", row["motors"], []), row
    assert row["says"] == f"LAND: motor {row['motors'][0]} does not answer", row
    assert row["delay_s"] < 6.0


SIX = ("hover", "turn", "forward", "climb", "descent", "steps")
ALL_EVENTS = get_args(Event)
ESTIMATED: dict[str, Any] = {"manoeuvres": MANOEUVRES, "level": "estimated", "seed": 45}


def test_motors_that_nothing_answers_to_are_not_lost_and_what_looks_like_it_is_learnt() -> None:
    """By a guessed file a climb looked like the loss of two arms, or two others, for five seconds; then motor 5 was
    declared with motor 4, which failed."""
    row = flown(230, fly_on_s=1.0, **ESTIMATED)
    assert (row["manoeuvre"], row["named"], row["wrong"], row["either"]) == ("climb", [4], [], []), row
    assert row["delay_s"] < 0.1


@pytest.mark.parametrize("flight", [11, 49, 151])
def test_what_a_file_has_wrong_when_the_watch_begins_is_not_allocated_around(flight: int) -> None:
    row = flown(flight, fly_on_s=0.1, **ESTIMATED)
    assert (row["partly"], row["wrong"]) == ([], []), row


def test_what_is_done_about_a_partial_loss_in_fast_flight_does_not_flap() -> None:
    """Allocated around and not, eight times in five seconds."""
    row = flown(54, faults=("partial",), left=(0.5, 0.7), seed=61, fly_on_s=6.0)
    assert (row["partly"], row["flaps"], row["wrong"]) == (row["motors"], 0, []), row


@pytest.mark.parametrize(("flight", "arm"), [(14, [3, 8]), (22, [2, 5])])
def test_of_two_motors_above_each_other_neither_is_named_wrongly_in_fast_flight(flight: int, arm: list[int]) -> None:
    """Their yaw torque was less than what side drag does: motor 8 was named for 3, 2 and 5 for 2, and both crashed,
    which fly on when left alone."""
    scenario = Scenario(
        name="t",
        flights=48,
        airframes=("coax-x8", "octo-x"),
        level="estimated",
        manoeuvres=("forward",),
        fly_on_s=3.0,
    )
    (row,) = fly(scenario, (flight,))
    assert row["motors"][0] in arm
    assert row["wrong"] == [], row
    assert row["survived"], row
    assert row["either"] == arm, row
    assert row["delay_s"] < 0.15, row
    assert row["says"] == f"reallocated: motor {arm[0]} or {arm[1]} lost", row


def of_one_arm(until_s: float = math.inf, **options: Any) -> tuple[VirtualFlight, TrialCompanion]:
    """Motor 3 of a coaxial vehicle fails at 2 s; yaw never tells it from motor 8."""
    tuning = Tuning()
    never_told = msgspec.structs.replace(tuning, decision=msgspec.structs.replace(tuning.decision, mates_sure=10.0))
    plant = airframe.load(vehicles.path_of("coax-x8"))
    fleet = Fleet(
        plant, FleetOptions(seeds=[1], height_m=10.0), [Fault(vehicle=0, motor=3, start_s=2.0, until_s=until_s)]
    )
    trial = TrialOptions(mode=Mode.ALLOCATE, tuning=never_told, **options)
    flight = VirtualFlight(fleet, {0: trial}, airframe="coax-x8")
    return flight, flight.companions[0]


def fly_to(flight: VirtualFlight, until_s: float) -> None:
    while flight.fleet.time_s < until_s:
        flight.step()


def test_the_operators_word_for_one_of_the_two_is_for_both() -> None:
    flight, companion = of_one_arm(until_s=3.0)
    fly_to(flight, 3.5)
    assert companion.output.either == (3, 8)
    assert companion.output.plan is not None
    companion.order(Orders(lift=(3,)))
    fly_to(flight, 4.5)
    assert not companion.output.either
    assert companion.output.plan is None
    assert companion.events == []


def test_one_of_the_two_stays_believed_when_the_telemetry_stops() -> None:
    flight, companion = of_one_arm()
    fly_to(flight, 3.0)
    plan = companion.session.state.planning.plan
    assert companion.output.either == (3, 8)
    assert plan is not None
    while flight.fleet.time_s < 5.0:
        flight.step()
        if flight.fleet.time_s < 3.6:
            companion.down.receive(math.inf)  # lost
        assert companion.output.either == (3, 8)
        assert companion.session.state.planning.plan is plan, "what is in force stays so"
    assert companion.output.mode == Mode.ALLOCATE
    assert companion.session.document(5.0)["either"] == [3, 8]
    assert not flight.fleet.state.crashed.any()


def test_by_a_file_that_nobody_confirmed_one_of_the_two_is_only_reported() -> None:
    flight, companion = of_one_arm(confirmed=False)
    fly_to(flight, 3.0)
    assert not companion.output.either
    assert companion.output.plan is None
    notes = {note.reason: note.text for note in companion.output.notes}
    assert notes[Reason.HELD_BACK].startswith("motor 3")


def test_the_verdict_on_a_log_names_a_motor_all_the_same() -> None:
    flight, companion = of_one_arm(parts=Parts(judged=True))
    fly_to(flight, 3.0)
    assert [event.motor for _, event in companion.events] == [3]
    assert not companion.output.either


def test_a_tenth_less_of_a_motor_is_said_and_nothing_is_done_about_it() -> None:
    row = flown(0, manoeuvres=("hover",), faults=("partial",), left=(0.9, 0.9), at_s=(12.0, 12.0), fly_on_s=8.0)
    assert (row["worn"], row["wrong"], row["partly"], row["weak"]) == (row["motors"], [], [], []), row
    assert row["delay_s"] < 6.0
    assert abs(row["worn_left"] - 0.9) < 0.05
    assert row["says"].startswith(f"motor {row['motors'][0]} gives less"), row


def test_of_two_above_each_other_of_which_one_is_lost_no_yaw_is_made() -> None:
    """In a turning leg the yaw asked for drove the dead one of the two up and the live one down: both were declared at
    last, and the vehicle crashed, which flies on alone."""
    row = flown(
        378,
        airframes=("octo-x", "octo-plus", "coax-x8", "paper-octo"),
        manoeuvres=MANOEUVRES,
        seed=2027,
        fly_on_s=4.0,
    )
    assert (row["airframe"], row["manoeuvre"], row["motors"]) == ("coax-x8", "forward", [8])
    assert (row["either"], row["wrong"], row["survived"]) == ([3, 8], [], True), row
    assert row["tilt_deg"] < row["alone_tilt_deg"], row


def test_what_one_of_two_lacks_while_the_vehicle_turns_is_not_taken_for_all_that_the_other_gives() -> None:
    """Motor 5 had lost a third, which had been learnt; when the turn's end drove it to twice its thrust, what it lacked
    was all that motor 2 above it gave by then, and one of the two was believed lost."""
    row = flown(
        41,
        manoeuvres=("hover", "turn", "forward", "climb"),
        faults=("partial",),
        left=(0.7, 0.7),
        seed=84,
        fly_on_s=9.0,
    )
    assert (row["airframe"], row["manoeuvre"], row["motors"]) == ("coax-x8", "turn", [5])
    assert (row["either"], row["wrong"], row["said_wrong"]) == ([], [], []), row


@pytest.mark.parametrize(
    ("flight", "options"),
    [
        (
            64,
            {
                "manoeuvres": ("hover", "turn", "forward", "steps"),
                "events": ALL_EVENTS,
                "at_s": (10.0, 20.0),
                "seed": 93,
            },
        ),
        (60, {"manoeuvres": SIX, "events": ("gust", "drop", "shift", "sag"), "at_s": (15.0, 25.0), "seed": 61}),
    ],
)
def test_a_battery_that_sags_in_wind_takes_from_all_motors_and_is_no_loss_of_a_few(
    flight: int, options: dict[str, Any]
) -> None:
    """Learning stood still while pairs were suspected, for as long as ten seconds; sets of motors were said to be lost,
    and one that works was allocated around."""
    row = flown(flight, faults=("none",), wind_m_s=(0.0, 8.0), fly_on_s=8.0, **options)
    assert row["event"] == "sag"
    assert (row["partly"], row["among"], row["wrong"], row["said_wrong"]) == ([], [], [], []), row


def test_what_is_said_of_wear_changes_nothing_that_is_believed_or_done() -> None:
    """Two vehicles alike to the last bit, of which one has a companion that never says it."""
    faults = [Fault(vehicle=k, motor=3, start_s=14.0, kind="partial", effectiveness=0.85) for k in (0, 1)]
    options = FleetOptions(seeds=[7, 7], wind_m_s=3.0, turbulence_m_s=0.75, height_m=20.0)
    fleet = Fleet(airframe.load(vehicles.path_of("octo-x"), vehicles=2), options, faults)
    deaf = Tuning().having("wear", improvement_min=200.0, known_blocks=600)
    flight = VirtualFlight(fleet, {0: TrialOptions(), 1: TrialOptions(tuning=deaf)}, airframe="octo-x")
    while fleet.time_s < 21.0:
        flight.step()
        one, other = (companion.output for companion in flight.companions)
        assert one.failed.tolist() == other.failed.tolist()
        assert one.degraded.tolist() == other.degraded.tolist()
        assert (one.plan is None) == (other.plan is None)
        if one.estimate is not None and other.estimate is not None:
            assert one.estimate.residual.tolist() == other.estimate.residual.tolist()
    assert (one.worn or one.weak) == (3,)
    assert other.worn == ()


def test_of_two_above_each_other_the_one_that_yaw_speaks_for_later_is_said_beside_the_other() -> None:
    """In a turn: motor 4 alone was said at last, which is above motor 7."""
    row = flown(
        5,
        manoeuvres=("hover", "turn", "steps", "climb"),
        faults=("partial",),
        left=(0.9, 0.9),
        at_s=(10.0, 20.0),
        fly_on_s=30.0,
        seed=92,
    )
    assert (row["airframe"], row["motors"], row["said_wrong"], row["wrong"]) == ("coax-x8", [7], [], []), row
    assert 7 in row["worn"]
    assert abs(row["worn_left"] - 0.9) < 0.05
