"""What a session takes over, keeps and gives back: vehicle, port, declarations, beside other companions."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from sessions import autopilot_heartbeat, bare_session, companion_heartbeat, flight, fly, from_autopilot, reason

from nff_companion.autopilots.twins import Rank
from nff_companion.companion_state import Orders
from nff_companion.condition import Mode, Reason
from nff_companion.core.sample import Sample
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session
from sitl.faults import Fault
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight


def sent_by(companion: TrialCompanion) -> list[Message]:
    """What waits on its way up."""
    codec = Codec(1, 1)
    return [message for _, data in companion.up.queue for message in codec.parse(data)]


def usec(companion: TrialCompanion, trial: VirtualFlight) -> int:
    """Now, by the autopilot's clock."""
    return round(1e6 * companion.session.autopilot_time_s(trial.fleet.time_s))


# -- orders -------------------------------------------------------------------------------------------------------


def test_a_lift_while_observing_never_stops_a_motor() -> None:
    trial = flight([Fault(vehicle=0, motor=3, start_s=4.0), Fault(vehicle=0, motor=6, start_s=6.0)])
    companion, port = fly(trial, 5.0), trial.fleet.autopilot.ports[0]
    assert port.failed.tolist() == [False, False, True] + [False] * 5
    companion.order(Orders(mode=Mode.OBSERVE))
    fly(trial, 7.0)
    assert np.flatnonzero(companion.output.failed).tolist() == [2, 5], "believed"
    companion.order(Orders(lift=(3,)))
    fly(trial, 7.5)
    assert not port.failed.any(), "3 is lifted, and 6 was only believed"


@pytest.mark.parametrize("order", [Orders(mode=Mode.ALLOCATE), None], ids=["an order", "a sample that is not finite"])
def test_a_second_vehicle_in_flight_never_takes_the_help_away(order: Orders | None) -> None:
    bad = {"now": False}

    def alter(sample: Sample) -> Sample:
        return replace(sample, gyro_rad_s=np.full(3, np.nan)) if bad["now"] else sample

    trial = flight([Fault(vehicle=0, motor=4, start_s=6.0)], alter=alter)
    companion = fly(trial, 4.0)
    for k in range(5):
        companion.session.take(autopilot_heartbeat(2), 0, trial.fleet.time_s)
        if order is not None:
            companion.order(order)
        bad["now"] = order is None
        trial.step()
        trial.step()
        bad["now"] = False
        fly(trial, 5.0 + k)
    assert companion.output.mode == Mode.ALLOCATE
    assert reason(companion) == Reason.REALLOCATED
    assert trial.fleet.autopilot.ports[0].failed[3]


# -- takeover -----------------------------------------------------------------------------------------------------


def test_one_that_waited_takes_over_what_the_other_one_declared() -> None:
    """The other one declares motor 3, which this one never sees: it stands on the autopilot's word."""
    trial = flight([])
    companion, port = fly(trial, 0.5), trial.fleet.autopilot.ports[0]
    other = Codec(1, 191)
    for k in range(6):
        companion.session.take(companion_heartbeat(99), 0, trial.fleet.time_s)
        if k == 4:
            declared = dialect.MAVLink_nff_motor_declaration_message(usec(companion, trial), 10**6, 4, 1, 1)
            companion.autopilot.take(other.pack(declared))
        fly(trial, 1.5 + k)
    assert reason(companion) == Reason.TWIN
    assert port.failed[2]
    fly(trial, 12.0)
    assert companion.output.mode == Mode.ALLOCATE
    assert companion.output.failed.tolist() == [False, False, True] + [False] * 5
    assert port.failed[2], "a dead motor is not handed back"
    companion.order(Orders(lift=(3,)))
    fly(trial, 12.5)
    assert not port.failed.any()


def test_what_the_other_one_lifted_is_not_declared_again() -> None:
    trial = flight([Fault(vehicle=0, motor=3, start_s=4.0, until_s=5.0)])
    companion, port = fly(trial, 4.6), trial.fleet.autopilot.ports[0]
    assert port.failed[2]
    for k in range(4):
        companion.session.take(companion_heartbeat(99), 0, trial.fleet.time_s)
        companion.order(Orders(mode=Mode.OBSERVE))
        fly(trial, 5.0 + k)
    lifted = dialect.MAVLink_nff_motor_declaration_message(usec(companion, trial), 10**6, 0, 1, 1)
    companion.autopilot.take(Codec(1, 191).pack(lifted))
    companion.session.take(companion_heartbeat(99), 0, trial.fleet.time_s)
    fly(trial, 9.0)
    companion.order(Orders(mode=Mode.ALLOCATE))
    fly(trial, 15.0)
    assert not port.failed.any()


def test_a_declaration_taken_over_is_forgotten_at_disarming_although_nothing_flew() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=3.0)])
    companion = fly(trial, 5.0)
    assert companion.output.failed.any()
    grounded = {"armed": True}

    def alter(sample: Sample) -> Sample:
        return replace(sample, armed=grounded["armed"], output=np.zeros(8), thrust=None, landed=True)

    again = VirtualFlight(trial.fleet, {0: TrialOptions(mode=Mode.ALLOCATE)}, airframe="octo-x", alter=alter)
    companion = again.companions[0]
    fly(again, trial.fleet.time_s + 1.0)
    assert companion.output.failed[3]
    grounded["armed"] = False
    fly(again, trial.fleet.time_s + 0.2)
    assert not companion.output.failed.any()


def test_another_vehicle_does_not_inherit_what_was_believed_of_the_last() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=3.0)])
    session = fly(trial, 5.0).session
    assert session.output.failed.any()
    session.due(11.0)
    assert session.adapter is None
    assert session.moment().verdict.reason == Reason.WAITING, "for whoever comes"
    session.take(autopilot_heartbeat(2), 0, 11.5)
    assert session.system == 2
    assert not session.output.failed.any()


# -- what is said -------------------------------------------------------------------------------------------------


def test_a_lift_that_the_autopilot_refuses_is_said() -> None:
    trial = flight([Fault(vehicle=0, motor=5, start_s=4.0, until_s=5.0)])
    companion = fly(trial, 6.0)
    port = trial.fleet.autopilot.ports[0]
    assert port.failed[4]
    companion.order(Orders(lift=(5,)))
    companion.up.queue.clear()
    while trial.fleet.time_s < 7.5:
        companion.up.queue.clear()
        trial.step()
    assert port.failed[4]
    assert reason(companion) == Reason.NOT_CONFIRMED


def test_silence_is_said_without_a_number_that_grows_old_and_the_autopilots_word_goes_on() -> None:
    trial = flight([])
    companion = fly(trial, 3.0)
    for k in range(60):
        companion.session.take(autopilot_heartbeat(armed=k < 30), 0, 3.0 + 0.1 * k)
        companion.session.due(3.0 + 0.1 * k)
    assert companion.session.moment().verdict.text == "telemetry stopped"
    assert companion.session.document(9.0)["autopilot"]["armed"] is False


def test_a_vehicle_that_came_back_as_another_system_is_said_in_the_reason_and_then_followed() -> None:
    """An autopilot that restarted with another SYSID_THISMAV: for as long as the first may come back, it is said."""
    trial = flight([], mode=Mode.OBSERVE)
    session = fly(trial, 3.0).session
    said = {}
    for k in range(60):
        now_s = 3.0 + 0.1 * k
        session.take(autopilot_heartbeat(7), 0, now_s)
        session.due(now_s)
        said[k] = session.document(now_s)
    assert said[10]["reason"] == "telemetry stopped: not from 1, system 7 is heard"
    assert said[59]["autopilot"]["system"] == 7


def test_one_sample_again_and_again_is_silence() -> None:
    held: list[Sample] = []

    def alter(sample: Sample) -> Sample:
        held.append(sample)
        return sample if sample.time_s < 4.0 else next(s for s in held if s.time_s >= 4.0)

    companion = fly(flight([], alter=alter), 6.0)
    assert companion.output.mode == Mode.OBSERVE
    assert reason(companion) == Reason.TELEMETRY_STOPPED


def test_a_wrong_rate_in_flight_declares_nothing() -> None:
    trial = flight([Fault(vehicle=0, motor=4, start_s=7.0)])
    companion = fly(trial, 4.0)
    assert companion.output.mode == Mode.ALLOCATE
    message = dialect.MAVLink_command_long_message(
        1, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, float(dialect.MAVLINK_MSG_ID_HIGHRES_IMU), 1e4, *[0.0] * 5
    )
    while trial.fleet.time_s < 9.0:
        companion.autopilot.take(Codec(1, 190).pack(message))  # a ground station wants it slower
        trial.step()
    assert reason(companion) == Reason.RATE
    assert not companion.output.failed.any()
    assert not companion.events


# -- the check before the flight ----------------------------------------------------------------------------------


def test_a_check_is_no_companion_for_those_who_fly() -> None:
    checking, flying = bare_session(act=False, instance=3), bare_session(instance=9)
    flying.take(autopilot_heartbeat(armed=True), 0, 0.0)
    for k in range(60):
        for item in checking.take(autopilot_heartbeat(armed=True), 0, 0.1 * k) + checking.due(0.1 * k):
            if item.message.get_type() == "HEARTBEAT":
                (heard,) = Codec(1, 194).parse(Codec(1, 192).pack(item.message))
                flying.take(heard, 0, 0.1 * k)
        flying.due(0.1 * k)
    assert flying.moment().verdict.reason != Reason.TWIN


def test_a_check_asks_nothing_before_it_knows_that_the_vehicle_is_disarmed() -> None:
    session = bare_session(act=False)
    attitude = from_autopilot(dialect.MAVLink_attitude_message(0, *[0.0] * 6))
    kinds = Counter(i.message.get_type() for k in range(10) for i in session.take(attitude, 0, 0.1 * k))
    assert not kinds


@pytest.mark.parametrize(
    ("rate_hz", "said"), [(170.0, "HIGHRES_IMU 170 of 200 Hz"), (230.0, "samples at 230 instead of 200 Hz")]
)
def test_a_check_names_a_rate_that_the_daemon_would_refuse(rate_hz: float, said: str) -> None:
    session = bare_session(act=False)
    hear_samples(session, rate_hz, 8.0)
    rates = next(f for f in session.findings(8.0) if f.name == "rates")
    assert rates.ok is False
    assert said in rates.detail


def hear_samples(session: Session, rate_hz: float, seconds: float) -> None:
    session.take(autopilot_heartbeat(), 0, 0.0)
    for k in range(1, round(seconds * rate_hz)):
        now = k / rate_hz
        imu = dialect.MAVLink_highres_imu_message(round(1e6 * now), 0, 0, -9.81, *[0.0] * 10, 63)
        session.take(from_autopilot(imu), 0, now)
        session.due(now)


@pytest.mark.parametrize(("rate_hz", "built_hz"), [(185.0, 185.0), (212.0, 212.0), (170.0, 200.0), (100.0, 200.0)])
def test_the_estimator_is_built_for_the_rate_that_arrives_or_refuses_it(rate_hz: float, built_hz: float) -> None:
    """10 % beside what was agreed it may be; beyond, nothing is estimated from it."""
    session = bare_session()
    hear_samples(session, rate_hz, 2.0)
    assert session.companion.rate_hz == pytest.approx(built_hz, rel=0.005)
    assert session.document(2.0)["built_for_hz"] == pytest.approx(built_hz, rel=0.005)
    assert (session.moment().condition.samples is None) == (rate_hz == built_hz)


def test_streams_that_this_autopilot_lacked_are_asked_for_again_after_it_was_gone() -> None:
    session = bare_session()
    asked: Counter[int] = Counter()
    optional = dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED

    def hear(start: float, seconds: float) -> int:
        asked.clear()
        for k in range(int(10 * seconds)):
            now = start + 0.1 * k
            out = session.take(autopilot_heartbeat(), 0, now) + session.due(now)
            asked.update(int(i.message.param1) for i in out if i.message.get_type() == "COMMAND_LONG")
        return asked[optional]

    first = hear(0.0, 20.0)
    assert 0 < first < 10
    session.due(30.0)
    assert hear(31.0, 20.0) == first


def test_the_bystander_of_a_pair_says_so() -> None:
    trial = flight([])
    companion = fly(trial, 4.0)
    companion.session.take(companion_heartbeat(99, rank=Rank.CANDIDATE), 0, 4.0)
    fly(trial, 4.5)
    assert reason(companion) == Reason.HEALTHY, "it claims"
    beats = [m for m in sent_by(companion) if m.get_type() == "HEARTBEAT"]
    assert all(beat.custom_mode >> 24 == Rank.CLAIMANT for beat in beats)
