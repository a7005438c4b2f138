"""ArduPilot logs: an excerpt of a stock ArduCopter's (octa X, take-off and hover at 10 m)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nff_companion.core import vehicle
from nff_companion.errors import LogError
from nff_companion.replay.run import rate_of, read, replay
from nff_companion.training.dataset import record

LOG = Path(__file__).parents[1] / "data" / "arducopter.bin"


def test_a_log_gives_samples_with_state_and_motor_outputs() -> None:
    octa = vehicle.load("arducopter-octa-x")
    _, rows = read(LOG, octa)
    samples = [sample for _, sample in rows]
    assert rate_of(samples) == pytest.approx(25.0, abs=0.5)
    last = samples[-1].position_m
    assert last is not None
    assert -last[2] == pytest.approx(10.0, abs=0.1)
    hover = samples[-100:]
    for sample in hover:
        assert sample.quaternion is not None
        assert np.linalg.norm(sample.quaternion) == pytest.approx(1.0, abs=1e-3)
        assert sample.specific_force_m_s2[2] == pytest.approx(-9.81, abs=0.3)
        assert sample.armed
    assert samples[0].armed, "a log begins at arming"
    # Octa X hovers on all motors alike, at the share of full thrust that its weight is.
    thrust = np.mean([octa.thrust_fraction(sample.output) for sample in hover], axis=0)
    np.testing.assert_allclose(thrust, octa.hover, atol=0.05)


def test_it_can_be_replayed_and_trained_on() -> None:
    octa = vehicle.load("arducopter-octa-x")
    assert replay(LOG, octa)["faults"] == []
    _, rows = read(LOG, octa)
    flight = record(octa, 25.0, [sample for _, sample in rows], LOG.name)
    assert np.abs(flight.residual.mean(axis=0)).max() < 1.0
    assert np.isfinite(flight.features).all()


def test_a_log_of_another_airframe_or_of_nothing_is_refused(tmp_path: Path) -> None:
    junk = tmp_path / "junk.bin"
    junk.write_bytes(b"\x00" * 4096)
    with pytest.raises(LogError):
        read(junk, vehicle.load("octo-x"))


def test_a_flight_of_quite_another_vehicle_is_not_trained_on() -> None:
    with pytest.raises(LogError, match="the airframe has 4 motors"):
        read(LOG, vehicle.load("h250"))
    wrong = vehicle.load("arducopter-octa-x", thrust_to_weight=12.0)
    _, rows = read(LOG, wrong)
    with pytest.raises(LogError, match="check airframe"):
        record(wrong, 25.0, [s for _, s in rows], "flight.bin")
