"""Frames onto a line that takes what it will: whole, in order, or not at all."""

from __future__ import annotations

import socket

import hypothesis.strategies as st
from hypothesis import given, settings

from nff_companion.mavlink.send_queue import SendQueue


class Line:
    """Takes as many bytes a write as its list says; then none."""

    def __init__(self, takes: list[int]) -> None:
        self.takes = takes
        self.received = b""

    def write(self, data: bytes) -> int:
        if not self.takes:
            raise BlockingIOError
        count = min(self.takes.pop(0), len(data))
        if count == 0:
            raise BlockingIOError
        self.received += data[:count]
        return count


def test_the_rest_of_a_frame_goes_before_the_next() -> None:
    line = Line([3])
    queue = SendQueue(line.write)
    assert queue.send(b"abcdefgh")
    assert queue.send(b"ijkl")
    assert line.received == b"abc"
    line.takes += [2, 100, 100]
    assert queue.flush()
    assert line.received == b"abcdefghijkl"


def test_a_full_queue_takes_no_part_of_a_frame() -> None:
    line = Line([1])
    queue = SendQueue(line.write, limit_bytes=10)
    assert [queue.send(b"12345"), queue.send(b"67890"), queue.send(b"abcde")] == [True, True, False]
    line.takes += [100] * 5
    assert queue.flush()
    assert line.received == b"1234567890"
    assert queue.send(b"abcde")


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 9), max_size=60), st.integers(1, 40))
def test_what_arrives_is_what_was_accepted(takes: list[int], limit: int) -> None:
    line = Line(takes)
    queue = SendQueue(line.write, limit_bytes=limit)
    accepted = b""
    for k in range(40):
        frame = bytes([65 + k]) * (1 + k % 7)
        if queue.send(frame):
            accepted += frame
    line.takes += [100] * 200
    queue.flush()
    assert line.received == accepted


def test_a_socket_that_nobody_reads_gets_whole_frames() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        queue = SendQueue(ours.send)
        accepted = sum(queue.send(b"%07d" % k) for k in range(200_000))
        theirs.setblocking(False)
        received = b""
        while len(received) < 7 * accepted:
            received += theirs.recv(1 << 20)
            queue.flush()
        assert received == b"".join(b"%07d" % k for k in range(accepted))
