"""Outputs of seven flights, kept from before the last rebuilding: nothing may change them unseen."""

from __future__ import annotations

import numpy as np
import pytest
from golden import flights

NAMES = list(flights.FLIGHTS)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_samples_give_the_same_outputs(name: str) -> None:
    inputs, kept, noted = flights.load(name)
    rows, events = flights.replay(flights.FLIGHTS[name], flights.unpack(inputs))
    np.testing.assert_allclose(np.array(rows[:: flights.KEEP_EVERY]), kept, rtol=1e-9, atol=1e-9)
    assert [e[1:3] for e in events] == [e[1:3] for e in noted["events"]]
    np.testing.assert_allclose(np.array(events), np.array(noted["events"]), rtol=1e-9, atol=1e-9)
    same_bits = flights.digest(rows) == noted["digest"]
    print(f"{name}: {'the same bits' if same_bits else 'the same to 1e-9'}; recorded on {noted['machine']}")


@pytest.mark.parametrize("name", NAMES)
def test_each_flight_shows_what_it_is_kept_for(name: str) -> None:
    flight = flights.FLIGHTS[name]
    _, rows, noted = flights.load(name)
    declared = {int(e[1]) for e in noted["events"] if e[2]}
    expected = set() if flight.restart_at_s else {motor for motor, _ in flight.faults}
    assert declared == expected
    modes = set(rows[:, 1])
    assert {"allocate": 1.0, "override": 2.0}[flight.mode] in modes
