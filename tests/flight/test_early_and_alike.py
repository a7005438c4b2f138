"""Losses in the first moments of a flight, two at once that cannot be told apart, and a motor at full output, flown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nff_companion.autopilots import times
from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle as vehicles
from nff_companion.core.estimate import Weighed
from nff_companion.core.identification import Identification
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from sitl import airframe as plant_airframe
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions
from sitl.trials.campaign.fly import fly
from sitl.trials.campaign.scenario import Scenario
from sitl.trials.first_seconds import TakeOff
from sitl.trials.personality import prepared
from sitl.trials.virtual import Alter, TrialOptions, VirtualFlight, temporary_card
from sitl.uncertainty import LEVELS


def started(
    airframe: str,
    seeds: list[int],
    faults: Sequence[Fault] = (),
    *,
    level: str = "exact",
    height_m: float = 0.0,
    alter: Alter | None = None,
) -> VirtualFlight:
    options = FleetOptions(
        seeds=seeds, model_error=0.1, uncertainty=LEVELS[level](), wind_m_s=4.0, turbulence_m_s=1.0, height_m=height_m
    )
    plants = plant_airframe.load(vehicles.path_of(airframe), vehicles=len(seeds))
    trials = dict.fromkeys(range(len(seeds)), TrialOptions(mode=Mode.ALLOCATE))
    return VirtualFlight(Fleet(plants, options, list(faults)), trials, airframe=airframe, alter=alter)


def taken_off(flight: VirtualFlight, until_s: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Times (N,) at which each passes 0.2 m."""
    script, low = TakeOff(flight.fleet, turn=False), np.full(flight.fleet.vehicles, np.nan)
    for _ in range(round(until_s * AUTOPILOT_RATE_HZ)):
        script.step(flight.fleet.time_s)
        flight.step()
        passed = np.isnan(low) & (flight.fleet.state.position_m[:, 2] < -0.2)
        low[passed] = flight.fleet.time_s
    return low


LOST = ((1,), (4,), (7,), (1, 7), (5, 7), (5, 6))


def test_motors_that_stop_20_cm_above_the_ground_are_named_at_once() -> None:
    seeds = list(range(21, 21 + len(LOST)))
    at_s = taken_off(started("octo-x", seeds), 3.0)
    faults = [
        Fault(vehicle=k, motor=motor, start_s=float(at_s[k]), kind="total")
        for k, motors in enumerate(LOST)
        for motor in motors
    ]
    flight = started("octo-x", seeds, faults)
    taken_off(flight, 5.0)
    for k, motors in enumerate(LOST):
        events = flight.companions[k].events
        assert {event.motor for _, event in events} <= set(motors)
        if len(motors) == 1:
            assert [event.motor for _, event in events] == list(motors)
            assert events[0][0] - at_s[k] < 0.25
        else:
            assert [event.motor for _, event in events] == list(motors)
            assert events[1][0] - at_s[k] < 0.3
    assert not flight.fleet.state.crashed.any()


def test_a_take_off_by_a_file_that_is_far_off_declares_nothing() -> None:
    """By its thrust curve it lifts a third less than it does: as if two of the six motors were gone."""
    flight = started("hexa-x", [101], level="estimated")
    taken_off(flight, 5.0)
    assert flight.companions[0].output.flying
    assert flight.companions[0].events == []


OPPOSITE = ((1, 2), (7, 8), (3, 6), (4, 5))  # of octo-x: two of each turn the yaw alone, to the same side
FAILS_S = 3.0


class Alike:
    """Four vehicles that lose opposite pairs; ``said`` of each, ``named_s`` when, or inf, ``off_deg`` (cycles, 4) tilt
    after the failure."""

    def __init__(self, tuning: Tuning, airframe: str = "octo-x", personality: str = "plain") -> None:
        n = len(OPPOSITE)
        faults = [Fault(vehicle=k, motor=motor, start_s=FAILS_S) for k, lost in enumerate(OPPOSITE) for motor in lost]
        options = FleetOptions(
            seeds=[5 + k for k in range(n)],
            model_error=0.1,
            uncertainty=LEVELS["calibrated"](),
            wind_m_s=4.0,
            turbulence_m_s=1.0,
            height_m=30.0,
        )
        plants = plant_airframe.load(vehicles.path_of(airframe), vehicles=n)
        trials = dict.fromkeys(range(n), TrialOptions(mode=Mode.ALLOCATE, tuning=tuning))
        self.said: list[set[Reason]] = [set() for _ in range(n)]
        self.named_s, tilts = np.full(n, math.inf), []
        with temporary_card() as card:
            ready = prepared(personality, vehicles.load(airframe), TrialOptions().allocation, card)
            fleet = Fleet(plants, options, faults)
            self.flight = VirtualFlight(fleet, trials, airframe=airframe, workshop=ready.workshop, px4=ready.px4)
            for _ in range(round((FAILS_S + 1.2) * AUTOPILOT_RATE_HZ)):
                self.flight.step()
                if fleet.time_s > FAILS_S:
                    tilts.append(np.degrees(rotation.tilt_of(fleet.state.quaternion)))
                for k, companion in enumerate(self.flight.companions):
                    output = companion.output
                    self.said[k].add(companion.session.moment().verdict.reason)
                    named = set((output.failed.nonzero()[0] + 1).tolist())
                    assert named <= set(OPPOSITE[k])
                    assert OPPOSITE[k] in output.among or not output.among
                    if named:
                        self.named_s[k] = min(self.named_s[k], fleet.time_s - FAILS_S)
        self.tilt_deg = np.array(tilts)
        assert not fleet.state.crashed.any()


LEFT_ALONE = Tuning().having("probe", thrust_max=0.0)


@pytest.mark.parametrize(("airframe", "personality"), [("octo-x", "plain"), ("arducopter-octa-x", "ardupilot")])
def test_opposite_motors_are_told_apart_by_a_test_that_the_vehicle_hardly_feels(
    airframe: str, personality: str
) -> None:
    tested, alone = (Alike(tuning, airframe, personality) for tuning in (Tuning(), LEFT_ALONE))
    asked = [Reason.PROBING in said for said in tested.said]
    assert any(asked)
    for k, probed in enumerate(asked):
        assert Reason.PROBING not in alone.said[k]
        assert Reason.PARTIAL not in tested.said[k] | alone.said[k]
        if not probed:
            continue
        assert tested.named_s[k] < 1.0
        until = round(tested.named_s[k] * AUTOPILOT_RATE_HZ)
        assert np.abs(tested.tilt_deg - alone.tilt_deg)[:until, k].max() < 1.0


@pytest.mark.parametrize("lost", ["uplink", "downlink", "samples"])
def test_a_test_whose_end_is_lost_ends_by_itself(lost: str) -> None:
    """In the middle of a test the link is cut, one way or the other, or the gyro is not a number any more."""
    faults = [Fault(vehicle=k, motor=motor, start_s=FAILS_S) for k, pair in enumerate(OPPOSITE) for motor in pair]
    cut_s: list[float] = []

    def alter(sample: Sample) -> Sample:
        return replace(sample, gyro_rad_s=np.full(3, np.nan)) if lost == "samples" and cut_s else sample

    seeds = [5 + k for k in range(len(OPPOSITE))]
    flight = started("octo-x", seeds, faults, level="calibrated", height_m=30.0, alter=alter)
    tested, ports = set[int](), flight.fleet.autopilot.ports
    while flight.fleet.time_s < FAILS_S + 1.0:
        flight.step()
        now_s = flight.fleet.time_s
        if not cut_s:
            tested = {k for k, port in enumerate(ports) if port.matrix_at(now_s) is not None}
            cut_s += [now_s] if tested else []
            continue
        for k, companion in enumerate(flight.companions):
            if lost != "samples":
                (companion.up if lost == "uplink" else companion.down).receive(math.inf)  # lost
            if now_s > cut_s[0] + times.PROBE_TIMEOUT_S + 0.05:
                assert ports[k].matrix_at(now_s) is None or companion.output.failed.any()
    assert tested
    if lost != "uplink":  # which we cannot know of but by the autopilot's silence
        assert {companion.output.mode for companion in flight.companions} == {Mode.OBSERVE}
    assert not flight.fleet.state.crashed.any()
    assert np.degrees(rotation.tilt_of(flight.fleet.state.quaternion)).max() < 20.0


def test_two_that_look_like_one_between_them_are_told_in_time() -> None:
    """Drawn in fast flight: for 65 ms the pair looks like motor 3, or 7; one of the vehicles crashed, which flies on
    when it is left alone."""
    scenario = Scenario(
        name="pairs", flights=224, manoeuvres=("hover", "climb", "turn", "forward"), motors=2, seed=31, fly_on_s=2.0
    )
    for row in fly(scenario, (71, 151)):
        assert row["named"] == row["motors"]
        assert row["survived"]
        assert row["delay_s"] < 1.0
        assert "LAND" not in row["says"]


def test_a_motor_at_full_output_is_said_and_nobody_else_is_blamed() -> None:
    flight = started("octo-x", [4], [Fault(vehicle=0, motor=3, start_s=3.0, kind="high")], height_m=40.0)
    companion, said = flight.companions[0], []
    while flight.fleet.time_s < 6.0 and not flight.fleet.state.crashed.any():
        flight.step()
        if flight.fleet.cycle % (AUTOPILOT_RATE_HZ // 10) == 0:
            said.append(companion.session.moment().verdict)
    assert companion.events == []
    assert "LAND: motor 3 pulls more than asked" in [verdict.text for verdict in said if verdict.reason == Reason.MORE]
    assert not companion.output.degraded.any()


def test_a_motor_that_fails_while_no_telemetry_comes_is_no_error_of_the_file() -> None:
    seeds, end_s = list(range(50, 54)), 6.3
    faults = [Fault(vehicle=k, motor=k + 1, start_s=6.0, kind="total") for k in range(len(seeds))]
    flight = started("octo-x", seeds, faults, height_m=40.0)
    while flight.fleet.time_s < 7.0:
        flight.step()
        if 5.98 < flight.fleet.time_s < end_s:
            for companion in flight.companions:
                companion.down.receive(math.inf)  # lost
    for k, companion in enumerate(flight.companions):
        assert [event.motor for _, event in companion.events] == [k + 1]
        assert companion.events[0][0] - end_s < 0.1


@pytest.mark.parametrize("later_s", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("motors", [(3,), (1, 2)])
def test_what_fails_soon_after_something_was_refuted_is_named(
    motors: tuple[int, ...], later_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What looked like losses was the file's and is learnt at once; a loss that comes then is none of it."""
    weighed, refuted_s = Identification.weighed, 3.0
    done = list[float]()

    def refuting(self: Identification, state: Any, seen: Any, onset: Any, measurement: Any) -> Weighed:
        if measurement.time_s - 1.0 >= refuted_s and not done:
            done.append(measurement.time_s)
            return Weighed(refuted=True)
        return weighed(self, state, seen, onset, measurement)

    monkeypatch.setattr(Identification, "weighed", refuting)
    faults = [Fault(vehicle=0, motor=motor, start_s=refuted_s + later_s) for motor in motors]
    flight = started("octo-x", [1], faults, height_m=10.0)
    fleet = flight.fleet
    while fleet.time_s < refuted_s + later_s + 0.8:
        flight.step()
    named = {event.motor: time_s - refuted_s - later_s for time_s, event in flight.companions[0].events}
    assert done
    assert tuple(sorted(named)) == motors
    assert max(named.values()) < (0.1 if len(motors) == 1 else 0.7)
