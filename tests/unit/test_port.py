"""The vehicle heard through several ports."""

from __future__ import annotations

import pytest

from nff_companion.autopilots.port import PortChoice


def heard(choice: PortChoice, streams: dict[int, tuple[float, bool]], start_s: float, until_s: float) -> list[int]:
    """Ports whose messages were taken; ``streams``: port to (rate in Hz, whether they are samples)."""
    times = []
    for port, (rate, sample) in streams.items():
        times += [(start_s + k / rate, port, sample) for k in range(int((until_s - start_s) * rate))]
    return [p for t, p, sample in sorted(times) if choice.takes(p, sample=sample, now_s=t)]


def test_a_port_with_samples_is_kept() -> None:
    for other_hz in (195.0, 205.0):
        taken = heard(PortChoice(), {0: (200.0, True), 1: (other_hz, True)}, 0.0, 5.0)
        assert set(taken) == {0}, "a few samples more are no reason to change"


@pytest.mark.parametrize("relay", [(4.0, False), (50.0, False), (10.0, True), (100.0, True)])
@pytest.mark.parametrize("direct", [0, 1])
def test_a_relay_never_keeps_the_vehicle_from_a_port_that_brings_more(relay: tuple[float, bool], direct: int) -> None:
    choice, other = PortChoice(), 1 - direct
    heard(choice, {other: relay}, 0.0, 3.0)  # the relay is heard first
    heard(choice, {other: relay, direct: (200.0, True)}, 3.0, 6.0)
    assert set(heard(choice, {other: relay, direct: (200.0, True)}, 6.0, 8.0)) == {direct}
    heard(choice, {other: relay}, 8.0, 8.8)  # the direct one is enumerated again
    heard(choice, {other: relay, direct: (200.0, True)}, 8.8, 11.0)
    assert set(heard(choice, {other: relay, direct: (200.0, True)}, 11.0, 13.0)) == {direct}


def test_the_other_port_takes_over_before_the_estimate_is_interrupted() -> None:
    choice = PortChoice()
    heard(choice, {0: (200.0, True), 1: (200.0, True)}, 0.0, 3.0)
    assert heard(choice, {1: (200.0, True)}, 3.0, 3.25)
