"""The estimator as a whole: what it hands out stays as it was, and it is asked in one way."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from golden import flights
from numpy.typing import NDArray

from nff_companion.core import basis_network
from nff_companion.core.estimator import Estimate, Estimator, Measurement, Motion
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle

DT = 0.005


def motion(sample: Sample) -> Motion:
    assert sample.velocity_m_s is not None
    assert sample.quaternion is not None
    return Motion(sample.velocity_m_s, sample.quaternion)


def measurements(octo: Vehicle, name: str) -> list[Measurement]:
    samples = flights.unpack(flights.load(name)[0])
    return [
        Measurement(
            time_s=sample.time_s,
            dt_s=DT,
            gyro=sample.gyro_rad_s,
            specific_force=sample.specific_force_m_s2,
            command=octo.thrust_fraction(sample.output),
            motion=motion(sample),
            allocation_norm=2.0,
        )
        for sample in samples[400:]
    ]


def arrays(estimate: Estimate) -> dict[str, NDArray[np.float64]]:
    values = {f.name: getattr(estimate, f.name) for f in fields(estimate)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("flight", ["single", "pair"])
def test_what_was_handed_out_never_changes_afterwards(octo: Vehicle, flight: str) -> None:
    """Through a declaration, and through several turns of the ring of the onsets."""
    estimator = Estimator(octo, DT, network=basis_network.for_vehicle(octo, "airframe"))
    first, *rest = measurements(octo, flight)
    state = estimator.start(first.time_s, first.gyro, first.specific_force, first.command)
    kept = []
    for measurement in rest:
        state, estimate = estimator.step(state, measurement)
        kept.append((arrays(estimate), {name: value.copy() for name, value in arrays(estimate).items()}))
    assert any(given["failed"].any() for given, _ in kept), "a motor is declared"
    for given, copied in kept:
        for name in copied:
            np.testing.assert_array_equal(given[name], copied[name], err_msg=name)


def test_what_is_given_is_not_written_to(octo: Vehicle) -> None:
    estimator = Estimator(octo, DT)
    first, *rest = measurements(octo, "single")
    state = estimator.start(first.time_s, first.gyro, first.specific_force, first.command)
    for measurement in rest:
        for array in (measurement.gyro, measurement.specific_force, measurement.command):
            array.flags.writeable = False
        state, _ = estimator.step(state, measurement)
    assert state.decision.failed.sum() == 1
