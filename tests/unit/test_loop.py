"""When the loop looks at what is due: not between what belongs to one sample, and never late without samples."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any, cast

from nff_companion.daemon.loop import Loop
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session


class Listener:
    """What the loop needs of a session; a HIGHRES_IMU is a sample."""

    system = None

    def __init__(self) -> None:
        counters = SimpleNamespace(samples=0, bad_frames=0, unsendable=0, dropped=0)
        self.reporter = SimpleNamespace(counters=counters, took=lambda seconds: None)
        self.looks = 0

    def take(self, message: Message, port: int, now_s: float) -> list[Any]:
        self.reporter.counters.samples += message.get_type() == "HIGHRES_IMU"
        return []

    def think(self) -> list[Any]:
        return []

    def due(self, now_s: float) -> list[Any]:
        self.looks += 1
        return []


def test_what_is_due_is_looked_at_after_a_sample_or_else_soon() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    now, listener, codec = 100.0, Listener(), Codec(1, 1)
    loop = Loop([f"udpin:127.0.0.1:{port}"], 191, lambda: now)
    state, sample = (
        dialect.MAVLink_extended_sys_state_message(0, 2),
        dialect.MAVLink_highres_imu_message(1, *[0.0] * 13, 0),
    )
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            for after_s, message, looks in (
                (0.004, sample, 0),  # too soon
                (0.006, state, 0),  # its sample is about to come
                (0.007, sample, 1),
                (0.009, state, 1),  # counted from that look on
                (0.020, state, 2),  # no sample comes
                (0.021, sample, 2),
                (0.033, None, 3),  # nothing comes at all
            ):
                now = 100.0 + after_s
                if message is not None:
                    autopilot.sendto(codec.pack(message), ("127.0.0.1", port))
                loop.turn(cast(Session, listener), 1.0 if message is not None else 0.0)
                assert listener.looks == looks, after_s
    finally:
        loop.close()
    assert listener.reporter.counters.samples == 3
