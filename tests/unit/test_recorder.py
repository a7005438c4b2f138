"""What is kept of flights for a calibration: bounded, whole flights of whole vehicles, and as it came."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from nff_companion.calibration.handover import Flown, packed, unpacked
from nff_companion.calibration.recorder import FlightRecorder, samples
from nff_companion.companion import Companion
from nff_companion.companion_state import CompanionState
from nff_companion.condition import Condition, Mode, Reason
from nff_companion.core.fit import Fit, FitVerdict
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError


def sample(time_s: float, *, known: bool = True) -> Sample:
    return Sample(
        time_s=time_s,
        gyro_rad_s=np.array([0.1, -0.2, time_s]),
        specific_force_m_s2=np.array([0.0, 0.0, -9.8]),
        output=np.linspace(0.4, 0.5, 8),
        armed=True,
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]) if known else None,
        velocity_m_s=np.array([1.0, 2.0, 3.0]) if known else None,
    )


def filled(recorder: FlightRecorder, first: int, count: int) -> None:
    for k in range(first, first + count):
        recorder.add(sample(0.005 * k))


def test_it_takes_no_more_than_it_says_and_keeps_the_newest() -> None:
    recorder = FlightRecorder(8, 100)
    filled(recorder, 0, 1234)
    time_s, values = recorder.taken()
    assert recorder.samples == 100
    np.testing.assert_allclose(time_s, 0.005 * np.arange(1134, 1234))
    assert time_s.nbytes + values.nbytes == recorder.bytes_max == 100 * 92


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300, 500.0])
def test_a_velocity_that_no_vehicle_has_is_kept_as_not_known(bad: float) -> None:
    recorder = FlightRecorder(8, 10)
    odd = sample(0.0)
    odd.velocity_m_s = np.full(3, bad)
    with np.errstate(all="raise"):
        recorder.add(odd)
    (kept,) = samples(*recorder.taken())
    assert kept.velocity_m_s is None
    assert kept.quaternion is None


def test_a_flight_in_which_a_motor_fails_is_not_kept_and_those_before_are() -> None:
    recorder = FlightRecorder(8, 100)
    filled(recorder, 0, 60)
    recorder.landed()
    filled(recorder, 1000, 70)  # thirty of them in the place of older ones
    recorder.spoil()
    filled(recorder, 1100, 10)
    np.testing.assert_allclose(recorder.taken()[0], 0.005 * np.arange(30, 60))
    recorder.landed()
    assert recorder.flights == 1
    filled(recorder, 2000, 95)
    np.testing.assert_allclose(recorder.taken()[0][-96:], 0.005 * np.array([59, *range(2000, 2095)]))
    recorder.landed()
    assert recorder.flights == 2


def test_a_failure_in_a_flight_longer_than_the_memory_leaves_nothing() -> None:
    recorder = FlightRecorder(8, 100)
    filled(recorder, 0, 50)
    recorder.landed()
    filled(recorder, 100, 250)
    recorder.spoil()
    recorder.landed()
    assert recorder.samples == 0
    assert recorder.flights == 1


def test_the_same_sample_again_is_kept_once_and_a_clock_that_began_anew_is_another_flight() -> None:
    recorder = FlightRecorder(8, 100)
    for time_s in (1.0, 1.0, 1.005, 1.0):
        recorder.add(sample(time_s))
    recorder.landed()
    recorder.add(sample(0.5))
    assert recorder.taken()[0].tolist() == [1.0, 1.005, 0.5]
    recorder.forget()
    assert recorder.samples == 0


def test_what_is_handed_over_comes_out_as_it_was() -> None:
    recorder = FlightRecorder(8, 10)
    recorder.add(sample(1.0))
    recorder.add(sample(1.005, known=False))
    time_s, values = recorder.taken()
    flown = Flown(airframe="octo-x", target="x", motors=8, samples=2, gyro_filter_hz=20.0, accelerometer_filter_hz=0.0)
    data = packed(flown, time_s, values)
    head, again_s, again = unpacked(data)
    first, second = samples(again_s, again)
    assert head == flown
    np.testing.assert_allclose(first.gyro_rad_s, [0.1, -0.2, 1.0], rtol=1e-6)
    np.testing.assert_allclose(first.output, np.linspace(0.4, 0.5, 8), rtol=1e-6)
    assert first.velocity_m_s is not None
    assert second.quaternion is None
    assert second.velocity_m_s is None
    with pytest.raises(LogError, match="cannot be understood"):
        unpacked(data[:-4])


def hovering(vehicle: Vehicle, rng: np.random.Generator) -> CompanionState:
    companion = Companion(vehicle, 200.0)
    state = companion.start(Mode.OBSERVE)
    for k in range(450):
        hover = sample(0.005 * k)
        hover.gyro_rad_s = 0.002 * rng.standard_normal(3)
        hover.specific_force_m_s2 = np.array([0.0, 0.0, -9.81]) + 0.05 * rng.standard_normal(3)
        hover.output = vehicle.output_for(np.full(vehicle.motors, vehicle.hover))
        state, _ = companion.step(state, hover, Condition())
    return state


def test_nothing_is_kept_while_a_failure_is_weighed_or_declared_unless_the_file_is_contradicted(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    state = hovering(octo, rng)
    assert state.whole
    one = np.zeros(8, bool)
    one[2] = True
    assert not replace(state, failed=one).whole
    assert not replace(state, last=replace(state.last, degraded=one)).whole
    assert not replace(state, held_back=((3,), 1.0)).whole
    assert not replace(state, estimate=None).whole
    wrong = replace(state.fit, fit=Fit(verdict=FitVerdict.DOES_NOT_FIT))
    assert replace(state, held_back=((3,), 1.0), fit=wrong).whole
    assert state.estimate is not None
    state.estimate.decision.candidate = (2,)
    assert not state.whole, "a motor that is being confirmed may be failing"
    assert not replace(state, failed=one, fit=wrong).whole


def test_the_pilot_hears_once_why_a_file_is_not_confirmed(octo: Vehicle, rng: np.random.Generator) -> None:
    state = hovering(octo, rng)
    assert state.estimate is not None
    began = state.estimate.started_s
    state = replace(state, confirmed=False)
    said = [[n.reason for n in state.notes(began + s, 9.0)] for s in (8.0, 9.5, 12.0)]
    assert said == [[], [Reason.FILE_OPEN], []]
    assert replace(state, confirmed=True).notes(began + 9.5, 9.0) == ()
