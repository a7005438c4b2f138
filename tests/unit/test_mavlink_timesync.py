"""TIMESYNC: whom we answer, in whose time, and which answers are ours."""

from __future__ import annotations

import pytest

from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.services.timesync import TimeSync

SECOND = 1_000_000_000
OFFSET = 3 * SECOND  # the autopilot's clock minus ours


def heard(message: Message, system: int = 1, component: int = 1) -> Message:
    (received,) = Codec(1, 191).parse(Codec(system, component).pack(message))
    return received


def request(tail: bytes = b"") -> Message:
    """A request; ``tail`` are the extension fields target_system and target_component of newer dialects."""
    frame = bytearray(Codec(1, 1).pack(dialect.MAVLink_timesync_message(0, 77 + (1 << 56))))
    frame[1] += len(tail)
    frame[-2:] = tail + bytes(2)
    crc = dialect.x25crc(frame[1:-2] + bytes([dialect.MAVLink_timesync_message.crc_extra])).crc
    frame[-2:] = crc.to_bytes(2, "little")
    (received,) = Codec(1, 191).parse(bytes(frame))
    return received


def synchronised(now_ns: int = 5 * SECOND) -> TimeSync:
    sync = TimeSync()
    sync.adopt(1)
    (question,) = sync.tick(now_ns)
    answer = dialect.MAVLink_timesync_message(now_ns + OFFSET + 2_000_000, question.ts1)
    assert sync.observe(heard(answer), now_ns + 4_000_000) == []
    return sync


def test_the_adopted_autopilot_is_answered_in_its_own_time() -> None:
    sync = synchronised()
    assert sync.round_trip_s == pytest.approx(0.004)
    assert sync.offset_s == pytest.approx(3.0)
    (answer,) = sync.observe(request(), 6 * SECOND)
    assert (answer.tc1, answer.ts1) == (9 * SECOND, 77 + (1 << 56))
    assert sync.autopilot_now_ns(6 * SECOND) == 9 * SECOND


def test_nobody_is_answered_in_a_time_that_is_not_the_autopilots() -> None:
    sync = TimeSync()
    sync.adopt(1)
    assert sync.observe(request(), 6 * SECOND) == []
    assert sync.autopilot_now_ns(6 * SECOND) is None


@pytest.mark.parametrize(("system", "component"), [(255, 190), (1, 192), (2, 1)])
def test_others_are_not_answered(system: int, component: int) -> None:
    sync = synchronised()
    assert sync.observe(heard(dialect.MAVLink_timesync_message(0, 77), system, component), 6 * SECOND) == []
    assert TimeSync().observe(heard(dialect.MAVLink_timesync_message(0, 77)), 6 * SECOND) == []


@pytest.mark.parametrize(
    ("tail", "answers"),
    [(b"\x01\xbf", 1), (b"\x00\x00", 1), (b"\x01\x00", 1), (b"\x01", 1), (b"\x01\xc0", 0), (b"\x07\xbf", 0)],
)
def test_a_request_addressed_to_another_component_is_not_ours(tail: bytes, answers: int) -> None:
    assert len(synchronised().observe(request(tail), 6 * SECOND)) == answers


def test_only_the_answer_to_our_own_last_question_counts_and_once() -> None:
    sync = synchronised()
    (question,) = sync.tick(7 * SECOND)
    foreign = dialect.MAVLink_timesync_message(99 * SECOND, question.ts1 - 1000)
    sync.observe(heard(foreign), 7 * SECOND + 1000)
    assert sync.offset_s == pytest.approx(3.0), "the question of a second companion on this computer"
    imposter = dialect.MAVLink_timesync_message(99 * SECOND, question.ts1)
    sync.observe(heard(imposter, 1, 192), 7 * SECOND + 1000)
    assert sync.offset_s == pytest.approx(3.0), "not the autopilot's"
    sync.observe(heard(dialect.MAVLink_timesync_message(10 * SECOND + 2_000_000, question.ts1)), 7_004_000_000)
    trip = sync.round_trip_s
    sync.observe(heard(dialect.MAVLink_timesync_message(10 * SECOND + 2_000_000, question.ts1)), 7_300_000_000)
    assert sync.round_trip_s == trip, "heard again through a router"


def test_a_clock_of_this_century_loses_no_nanosecond() -> None:
    sync = TimeSync()
    sync.adopt(1)
    (question,) = sync.tick(5 * SECOND)
    epoch = 1_764_000_000_123_456_789
    sync.observe(heard(dialect.MAVLink_timesync_message(epoch, question.ts1)), 5 * SECOND)
    assert sync.autopilot_now_ns(5 * SECOND + 1) == epoch + 1


def test_an_autopilot_that_restarts_and_another_one_start_anew() -> None:
    sync = synchronised()
    (question,) = sync.tick(7 * SECOND)
    sync.observe(heard(dialect.MAVLink_timesync_message(SECOND, question.ts1)), 7 * SECOND)
    assert sync.offset_s == pytest.approx(-6.0)
    sync.adopt(2)
    assert sync.offset_s is None
    assert sync.round_trip_s is None
    assert sync.autopilot_now_ns(8 * SECOND) is None
