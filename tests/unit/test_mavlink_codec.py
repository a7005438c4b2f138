"""Framing: what is found between garbage, and what is not lost to it."""

from __future__ import annotations

import time

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from nff_companion.mavlink.codec import Codec, Message, dialect

HEARTBEAT = dialect.MAVLink_heartbeat_message(14, 3, 128, 4, 4, 3)
NO_HEADER = st.binary(max_size=40).map(lambda data: bytes(byte for byte in data if byte not in (0xFD, 0xFE)))


def numbered(count: int, **options: bool) -> list[bytes]:
    """Frames of one sender whose sequence numbers run from 0."""
    sender = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    if options.pop("signed", False):
        sender.signing.secret_key = bytes(32)
        sender.signing.sign_outgoing = True
    out = []
    for sequence in range(count):
        sender.seq = sequence
        out.append(bytes(HEARTBEAT.pack(sender, force_mavlink1=options.get("version_1", False))))
    return out


def sequences(messages: list[Message]) -> list[int]:
    return [message.get_seq() for message in messages]


@pytest.mark.parametrize(
    "garbage",
    [
        b"\xfd\xff",
        b"\xfe\xff",
        b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00",  # a header of our own dialect: believed until its checksum fails
        b"\xfd\xff\x01\x00\x00\x01\x01\x1e\x00\x00",
        b"\xfe\xff\x00\x01\x01\x00",
    ],
    ids=["FD", "FE", "heartbeat", "signed", "version 1"],
)
def test_frames_within_a_false_frame_of_a_stream_are_found(garbage: bytes) -> None:
    codec, frames = Codec(1, 191), numbered(40)
    heard = sequences(codec.parse(garbage))
    for frame in frames:
        heard += sequences(codec.parse(frame))
    assert heard == list(range(40))
    assert codec.bad_frames == 1


def test_frames_behind_a_false_header_in_one_datagram_are_found() -> None:
    codec = Codec(1, 191)
    assert sequences(codec.parse_datagram(b"\xfd\xff" + b"".join(numbered(8)))) == list(range(8))
    assert codec.bad_frames == 1


def test_a_frame_never_continues_in_the_next_datagram() -> None:
    codec, (first, second) = Codec(1, 191), numbered(2)
    assert codec.parse_datagram(first[:-3]) == []
    assert codec.bad_frames == 1
    assert codec.parse_datagram(first[-3:]) == []
    assert codec.bad_frames == 2
    assert sequences(codec.parse_datagram(second)) == [1]
    assert sequences(codec.parse_datagram(first + second)) == [0, 1]
    assert codec.bad_frames == 2


@pytest.mark.parametrize("options", [{}, {"signed": True}, {"version_1": True}], ids=lambda o: "".join(o) or "plain")
def test_frames_of_both_versions_and_signed_ones_are_accepted(options: dict[str, bool]) -> None:
    frames = numbered(6, **options)
    stream, datagrams, bytewise = Codec(1, 191), Codec(1, 191), Codec(1, 191)
    assert sequences(stream.parse(b"".join(frames))) == list(range(6))
    assert [s for frame in frames for s in sequences(datagrams.parse_datagram(frame))] == list(range(6))
    assert [s for byte in b"".join(frames) for s in sequences(bytewise.parse(bytes([byte])))] == list(range(6))
    assert stream.bad_frames == datagrams.bad_frames == bytewise.bad_frames == 0


def test_a_frame_of_a_message_we_do_not_know_is_no_bad_frame_and_hides_nothing() -> None:
    unknown = b"\xfd\x04\x00\x00\x07\x01\x01\xff\xff\x7f" + b"abcd" + b"\x12\x34"
    codec, frames = Codec(1, 191), numbered(2)
    assert codec.parse_datagram(unknown) == []
    assert sequences(codec.parse_datagram(frames[0] + unknown + frames[1])) == [0, 1]
    assert sequences(codec.parse(frames[0] + unknown + frames[1])) == [0, 1]
    assert codec.bad_frames == 0
    # Its checksum is not known to us: such a header may be false, and what it spans is looked at.
    longer = b"\xfd\xff\x00\x00\x07\x01\x01\xff\xff\x7f"
    assert sequences(codec.parse(longer + b"".join(frames))) == [0, 1]


def test_a_new_connection_does_not_continue_the_frame_of_the_old_one() -> None:
    codec, frames = Codec(1, 191), numbered(3)
    codec.parse(b"\xfd\xff\x00\x00\x00\x01\x01\x00\x00\x00")
    codec.forget()
    assert sequences(codec.parse(frames[0])) == [0]


@pytest.mark.parametrize("byte", [b"\xfd", b"\xfe", b"\xff"])
def test_a_datagram_of_nothing_but_headers_costs_little(byte: bytes) -> None:
    codec = Codec(1, 191)
    began = time.process_time()
    for _ in range(10):
        assert codec.parse_datagram(byte * 65000) == []
    assert time.process_time() - began < 0.2, "ten of them in a tenth of the watchdog's time"
    assert codec.bad_frames >= 10


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(NO_HEADER, st.sampled_from(["plain", "signed", "version_1"])), max_size=8),
    NO_HEADER,
    st.lists(st.integers(1, 60), min_size=1, max_size=12),
)
def test_all_frames_between_garbage_without_headers_are_found(
    parts: list[tuple[bytes, str]], end: bytes, sizes: list[int]
) -> None:
    kinds = {"plain": numbered(8), "signed": numbered(8, signed=True), "version_1": numbered(8, version_1=True)}
    data = b"".join(garbage + kinds[kind][k] for k, (garbage, kind) in enumerate(parts)) + end
    assert in_chunks(Codec(1, 191), data, sizes) == list(range(len(parts)))
    assert sequences(Codec(1, 191).parse_datagram(data)) == list(range(len(parts)))


SPITEFUL = st.sampled_from(list(b"\xfd\xfe\xff\x00\x01")).map(lambda byte: bytes([byte]))


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.lists(st.one_of(st.binary(max_size=7), SPITEFUL), max_size=8).map(b"".join), max_size=4),
    st.lists(st.integers(1, 60), min_size=1, max_size=12),
)
def test_no_garbage_hides_a_frame_for_good(garbage: list[bytes], sizes: list[int]) -> None:
    frames = numbered(len(garbage))
    data = b"".join(g + frame for g, frame in zip(garbage, frames, strict=True))
    # What follows ends the longest false frame.
    heard = in_chunks(Codec(1, 191), data + bytes(600), sizes)
    assert [s for s in heard if s < len(frames)] == list(range(len(frames)))
    assert sequences(Codec(1, 191).parse_datagram(data)) == list(range(len(frames)))


def in_chunks(codec: Codec, data: bytes, sizes: list[int]) -> list[int]:
    heard, at, k = [], 0, 0
    while at < len(data):
        size = sizes[k % len(sizes)]
        heard += sequences(codec.parse(data[at : at + size]))
        at, k = at + size, k + 1
    return heard
