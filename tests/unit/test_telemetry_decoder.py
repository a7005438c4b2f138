"""Times since boot and since 1970, in one telemetry: ages are those of the messages, whichever clock they are of."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.admission import refusal
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core import vehicle
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.mavlink.codec import dialect

OCTA = vehicle.load("octo-x")
UNIX_S = 1_710_773_350.0
BOOT_S = 83.0


class Telemetry:
    """A 200 Hz stream whose messages have clocks of their own, in s at its beginning."""

    def __init__(self, *, imu_s: float, servo_s: float, state_s: float) -> None:
        self._imu_s, self._servo_s, self._state_s = imu_s, servo_s, state_s
        self._decoder = TelemetryDecoder(OCTA)
        armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED
        self._decoder.observe(dialect.MAVLink_heartbeat_message(2, 3, armed, 0, 4, 3))

    def sample(self, at_s: float, servo_at_s: float | None = None, state_at_s: float | None = None) -> Sample:
        """At ``at_s``, with outputs and state of those moments; None: they do not come."""
        if servo_at_s is not None:
            usec = round(1e6 * (self._servo_s + servo_at_s)) % 2**32
            self._decoder.observe(dialect.MAVLink_servo_output_raw_message(usec, 0, *[1500] * 8))
        if state_at_s is not None:
            ms = round(1e3 * (self._state_s + state_at_s)) % 2**32
            self._decoder.observe(dialect.MAVLink_attitude_quaternion_message(ms, 1.0, *[0.0] * 6))
            self._decoder.observe(dialect.MAVLink_local_position_ned_message(ms, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0))
        imu = dialect.MAVLink_highres_imu_message(round(1e6 * (self._imu_s + at_s)), *[0.0] * 13, 0x3F)
        found = self._decoder.observe(imu)
        assert found is not None
        return found


CLOCKS = [
    {"imu_s": BOOT_S, "servo_s": BOOT_S, "state_s": BOOT_S},
    {"imu_s": UNIX_S, "servo_s": UNIX_S, "state_s": UNIX_S},
    {"imu_s": UNIX_S, "servo_s": BOOT_S, "state_s": BOOT_S},
    {"imu_s": BOOT_S, "servo_s": UNIX_S, "state_s": UNIX_S},
    {"imu_s": 4300.0, "servo_s": 4300.0, "state_s": 4300.0},  # the 32 bits of SERVO_OUTPUT_RAW have wrapped
]


@pytest.mark.parametrize("clocks", CLOCKS)
def test_a_sample_is_whole_whatever_the_clocks_of_its_messages(clocks: dict[str, float]) -> None:
    telemetry = Telemetry(**clocks)
    for k in range(100):
        found = telemetry.sample(0.005 * k, 0.005 * k - 0.002, 0.005 * k - 0.002)
        if k > 1:
            assert np.isfinite(found.output).all()
            assert found.quaternion is not None
            assert found.position_m is not None
            assert refusal(found, 8, Tuning().companion) is None
    assert found.time_s == pytest.approx(clocks["imu_s"] + 0.495, abs=1e-6)


@pytest.mark.parametrize("clocks", CLOCKS)
def test_what_stops_coming_is_old_whatever_its_clock(clocks: dict[str, float]) -> None:
    telemetry = Telemetry(**clocks)
    for k in range(100):
        telemetry.sample(0.005 * k, 0.005 * k, 0.005 * k)
    assert np.isfinite(telemetry.sample(0.55).output).all()
    assert np.isnan(telemetry.sample(0.62).output).all()
    assert telemetry.sample(0.62).quaternion is None
    assert telemetry.sample(1.1).position_m is None


@pytest.mark.parametrize("clocks", CLOCKS)
def test_a_time_that_stands_still_is_old_and_no_other_clock(clocks: dict[str, float]) -> None:
    telemetry = Telemetry(**clocks)
    for k in range(100):
        telemetry.sample(0.005 * k, 0.005 * k, 0.005 * k)
    for at_s in (1.0, 9.0, 11.0, 30.0, 60.0):  # the same measurement again and again
        found = telemetry.sample(at_s, 0.495, 0.495)
        assert np.isnan(found.output).all()
        assert found.quaternion is None


def test_outputs_are_taken_from_the_channels_that_are_named() -> None:
    decoder = TelemetryDecoder(vehicle.load("h250"), [4, 5, 6, 7])
    pulses = [900] * 4 + [1100, 1200, 1300, 1400]
    decoder.observe(dialect.MAVLink_servo_output_raw_message(1_000_000, 0, *pulses))
    found = decoder.observe(dialect.MAVLink_highres_imu_message(1_000_000, *[0.0] * 13, 0x3F))
    assert found is not None
    np.testing.assert_allclose(found.output, [0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("imu_s", [BOOT_S, UNIX_S, 83.1234567])
def test_a_rotor_speed_that_is_only_repeated_is_not_read_again(imu_s: float) -> None:
    decoder = TelemetryDecoder(OCTA)
    times = set()
    for k in range(400):
        usec = round(1e6 * (BOOT_S + 0.013 * (k // 20)))
        decoder.observe(dialect.MAVLink_esc_status_message(0, usec, [5000] * 4, [12.0] * 4, [1.0] * 4))
        found = decoder.observe(
            dialect.MAVLink_highres_imu_message(round(1e6 * (imu_s + 0.0007 * k)), *[0.0] * 13, 0x3F)
        )
        assert found is not None
        assert found.rotor_speed_time_s is not None
        times.add(float(found.rotor_speed_time_s[0]))
    assert len(times) in (20, 21)  # the first may be read before the first sample told the time


def test_rotor_speeds_of_one_index_grow_old_while_another_goes_on() -> None:
    decoder = TelemetryDecoder(OCTA)
    read_s = np.nan
    for k in range(6000):
        at_usec = round(1e6 * BOOT_S) + 5000 * k
        for index, usec in ((0, at_usec), (4, round(1e6 * BOOT_S) + 5000 * min(k, 400))):
            decoder.observe(dialect.MAVLink_esc_status_message(index, usec, [5000] * 4, [12.0] * 4, [1.0] * 4))
        found = decoder.observe(dialect.MAVLink_highres_imu_message(at_usec, *[0.0] * 13, 0x3F))
        assert found is not None
        assert found.rotor_speed_time_s is not None
        read_s = float(found.rotor_speed_time_s[5])
    assert read_s == pytest.approx(BOOT_S + 2.0, abs=0.01)


@pytest.mark.parametrize("drift", [-2e-4, 0.0, 5e-5, 2e-4])
def test_clocks_that_drift_apart_are_followed(drift: float) -> None:
    telemetry = Telemetry(imu_s=BOOT_S, servo_s=UNIX_S, state_s=UNIX_S)
    for k in range(25_000):
        there_s = (1.0 - drift) * 0.09 * k
        found = telemetry.sample(0.09 * k, there_s, there_s)
        if k > 1:
            assert np.isfinite(found.output).all(), f"after {0.09 * k} s"


@pytest.mark.parametrize("step_s", [-2.0, -0.15, 0.15, 2.0, 3600.0])
def test_a_clock_that_is_set_is_followed_again(step_s: float) -> None:
    telemetry = Telemetry(imu_s=BOOT_S, servo_s=UNIX_S, state_s=UNIX_S)
    for k in range(16_000):
        there_s = 0.005 * k + (step_s if k > 200 else 0.0)
        found = telemetry.sample(0.005 * k, there_s, there_s)
    assert np.isfinite(found.output).all()
    assert found.quaternion is not None
