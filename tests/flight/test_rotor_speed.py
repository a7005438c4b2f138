"""Measured rotor speeds: declared at once; telemetry that lies neither causes nor hides a declaration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core import vehicle
from nff_companion.core.rotor_speed import RotorSpeedState, RotorSpeedWatch
from nff_companion.core.sample import Sample
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session
from sitl import airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight

FAIL_S = 4.0
STOPPED_SHARE = 0.35


@dataclass
class Flown:
    """Declared motors and when; when the telemetry first showed each stopped."""

    declared: dict[int, float]
    shown: dict[int, float]
    session: Session


def honest(sample: Sample) -> Sample:
    return sample


def zero_filled(sample: Sample) -> Sample:
    return replace(sample, rotor_speed_rad_s=np.zeros(8))


def zero_from_now(sample: Sample) -> Sample:
    return zero_filled(sample) if sample.time_s > FAIL_S - 1.0 else sample


def frozen(sample: Sample) -> Sample:
    return replace(sample, rotor_speed_rad_s=np.full(8, 450.0))


def stale(sample: Sample) -> Sample:
    if sample.time_s < FAIL_S - 0.5:
        return sample
    return replace(sample, rotor_speed_time_s=np.full(8, FAIL_S - 0.5), rotor_speed_rad_s=np.zeros(8))


def swapped(sample: Sample) -> Sample:
    assert sample.rotor_speed_rad_s is not None
    speed = sample.rotor_speed_rad_s.copy()
    speed[[2, 7]] = speed[[7, 2]]
    return replace(sample, rotor_speed_rad_s=speed)


def one_dead_sensor(sample: Sample) -> Sample:
    assert sample.rotor_speed_rad_s is not None
    speed = sample.rotor_speed_rad_s.copy()
    if sample.time_s > FAIL_S - 1.0:
        speed[4] = 0.0
    return replace(sample, rotor_speed_rad_s=speed)


LIES = [zero_filled, zero_from_now, frozen, stale, swapped, one_dead_sensor]
STOPPED = [(1, 2), (1, 4), (2, 5), (7, 8), (3,)]
CASES = [*((motors, honest) for motors in STOPPED), *(((), lie) for lie in LIES), *(((3,), lie) for lie in LIES)]
Case = tuple[tuple[int, ...], Callable[[Sample], Sample]]


def watching(case: Case, shown: dict[int, float]) -> Callable[[Sample], Sample]:
    motors, alter = case

    def watch(sample: Sample) -> Sample:
        out = alter(sample)
        assert sample.rotor_speed_rad_s is not None
        for motor in motors:
            if sample.time_s > FAIL_S and sample.rotor_speed_rad_s[motor - 1] < STOPPED_SHARE * 450:
                shown.setdefault(motor, sample.time_s)
        return out

    return watch


@pytest.fixture(scope="module")
def flown() -> dict[Case, Flown]:
    """All cases, in one fleet of vehicles that fly alike."""
    fleet = Fleet(
        airframe.load(vehicle.path_of("octo-x")),
        FleetOptions(seeds=[1] * len(CASES), height_m=10.0, wind_m_s=3.0, turbulence_m_s=0.75, model_error=0.1),
        [Fault(vehicle=k, motor=motor, start_s=FAIL_S) for k, (motors, _) in enumerate(CASES) for motor in motors],
    )
    shown: list[dict[int, float]] = [{} for _ in CASES]
    virtual = VirtualFlight(
        fleet,
        {k: TrialOptions(alter=watching(case, shown[k])) for k, case in enumerate(CASES)},
        airframe="octo-x",
        thrust_to_weight=None,
        rate_hz=200.0,
        link_delay_s=0.0,
        rotor_speeds=True,
    )
    while fleet.time_s < FAIL_S + 2.0:
        virtual.step()
    assert not fleet.state.crashed.any()
    out: dict[Case, Flown] = {}
    for case, companion, seen in zip(CASES, virtual.companions, shown, strict=True):
        declared = {event.motor: time_s for time_s, event in companion.events if event.declared}
        out[case] = Flown(declared, seen, companion.session)
    return out


@pytest.mark.parametrize("motors", STOPPED)
def test_a_stopped_motor_is_declared_at_once(flown: dict[Case, Flown], motors: tuple[int, ...]) -> None:
    found = flown[motors, honest]
    assert tuple(sorted(found.declared)) == motors
    for motor in motors:
        delay = found.declared[motor] - found.shown[motor]
        print(f"motor {motor}: {1e3 * delay:.0f} ms after the telemetry showed it")
        assert delay <= 0.050 + 1e-9


@pytest.mark.parametrize("lie", LIES)
def test_telemetry_that_lies_declares_nothing(flown: dict[Case, Flown], lie: Callable[[Sample], Sample]) -> None:
    assert flown[(), lie].declared == {}


@pytest.mark.parametrize("lie", LIES)
def test_telemetry_that_lies_hides_nothing(flown: dict[Case, Flown], lie: Callable[[Sample], Sample]) -> None:
    declared = flown[(3,), lie].declared
    assert list(declared) == [3]
    assert declared[3] - FAIL_S < 0.1


def test_a_dead_speed_sensor_is_called_one(flown: dict[Case, Flown]) -> None:
    session = flown[(), one_dead_sensor].session
    assert session.companion.speed_faults(session.state) == [5]


def test_a_watch_needs_proof_before_it_believes_a_zero() -> None:
    watch, state = RotorSpeedWatch(4), RotorSpeedState.start(4)
    thrust = np.full(4, 0.4)
    for k in range(100):
        now = 0.01 * k
        speed = np.array([0.0, 400.0 + k % 3, 400.0 + k % 3, 400.0 + k % 2])
        assert not watch.step(state, now, speed, np.full(4, now), thrust).any()


def test_a_hint_that_nothing_confirms_is_withdrawn() -> None:
    watch, state = RotorSpeedWatch(4), RotorSpeedState.start(4)
    thrust = np.full(4, 0.4)
    hinted = []
    for k in range(400):
        now = 0.01 * k
        speed = np.full(4, 400.0 + k % 3)
        if now >= 2.0:
            speed[1] = 0.0
        if watch.step(state, now, speed, np.full(4, now), thrust)[1]:
            hinted.append(now)
    assert 2.0 <= hinted[0] < 2.05
    assert hinted[-1] < hinted[0] + watch.tuning.fault_s + 0.02
    assert watch.faults(state, np.zeros(4, bool)).tolist() == [False, True, False, False]


def test_telemetry_of_both_autopilots_reaches_the_sample() -> None:
    octo = vehicle.load("octo-x")
    decoder = TelemetryDecoder(octo)
    sender, receiver = Codec(1, 1), Codec(1, 191)

    def imu(usec: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotor speeds, and when they were read."""
        message = dialect.MAVLink_highres_imu_message(usec, *[0.0] * 13, 0x3F)
        (received,) = receiver.parse(sender.pack(message))
        sample = decoder.observe(received)
        assert sample is not None
        assert sample.rotor_speed_rad_s is not None
        assert sample.rotor_speed_time_s is not None
        return sample.rotor_speed_rad_s, sample.rotor_speed_time_s

    def say(message: Message) -> None:
        for received in receiver.parse(sender.pack(message)):
            decoder.observe(received)

    imu(1_000_000)
    say(dialect.MAVLink_esc_telemetry_1_to_4_message([0] * 4, [0] * 4, [0] * 4, [0] * 4, [60, 120, 0, 6000], [1] * 4))
    speed, read_s = imu(1_005_000)
    assert speed[:4] == pytest.approx(np.array([60, 120, 0, 6000]) * 2 * np.pi / 60)
    assert np.isnan(speed[4:]).all()
    say(dialect.MAVLink_esc_telemetry_1_to_4_message([0] * 4, [0] * 4, [0] * 4, [0] * 4, [0] * 4, [1] * 4))
    speed, read_s = imu(1_010_000)  # the count stands: the ESC has said nothing new
    assert speed[3] == pytest.approx(6000 * 2 * np.pi / 60)
    assert read_s[3] == pytest.approx(1.0)
    say(dialect.MAVLink_esc_status_message(4, 1_011_000, [-600, 600, 1200, 0], [0.0] * 4, [0.0] * 4))
    speed, read_s = imu(1_015_000)
    assert speed[4:] == pytest.approx(np.array([600, 600, 1200, 0]) * 2 * np.pi / 60)
    assert read_s[4] == pytest.approx(1.011)
