"""Telemetry to samples, and commands to messages of our dialect."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.autopilots.nff import NffAdapter
from nff_companion.autopilots.schedule import Command, Declare, Drive, Load, Release
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.condition import Reason, Source
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import Message, dialect


def imu(usec: int) -> Message:
    return dialect.MAVLink_highres_imu_message(
        usec, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.0, 0.0, 0.0, 950.0, 0.0, 0.0, 25.0, 63
    )


def servos(usec: int, port: int = 0) -> Message:
    return dialect.MAVLink_servo_output_raw_message(usec % 2**32, port, *[1150 + 100 * k for k in range(8)], *[0] * 8)


@pytest.mark.parametrize("start", [1_000_000, 2**32 - 50_000, 3 * 2**32 + 7])
def test_a_sample_carries_gyro_accelerometer_and_outputs_for_ever(octo: Vehicle, start: int) -> None:
    decoder = TelemetryDecoder(octo)
    for k in range(40):  # across the wrap of the 32 bit clock of the motor outputs
        assert decoder.observe(servos(start + 5000 * k)) is None
        sample = decoder.observe(imu(start + 5000 * k + 2000))
        assert sample is not None
        np.testing.assert_allclose(sample.output, 0.15 + 0.1 * np.arange(8))
        np.testing.assert_allclose(sample.gyro_rad_s, [0.01, 0.02, 0.03], rtol=1e-6)


def test_what_a_sample_carries_does_not_change_with_the_next_messages(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)

    def heard(k: int) -> Sample:
        usec = 1_000_000 + 5000 * k
        decoder.observe(servos(usec))
        decoder.observe(dialect.MAVLink_attitude_quaternion_message(usec // 1000, 1.0, 0.01 * k, 0.0, 0.0, *[0.0] * 3))
        decoder.observe(dialect.MAVLink_local_position_ned_message(usec // 1000, 1.0 * k, 0.0, -5.0, 2.0, 0.0, 0.0))
        decoder.observe(dialect.MAVLink_esc_status_message(0, usec, [1000 + k] * 4, [0.0] * 4, [0.0] * 4))
        sample = decoder.observe(imu(usec + 1000))
        assert sample is not None
        return sample

    def arrays(sample: Sample) -> dict[str, NDArray[np.float64]]:
        values = {f.name: getattr(sample, f.name) for f in fields(sample)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    given = [arrays(heard(k)) for k in range(3)]
    copied = [{name: value.copy() for name, value in each.items()} for each in given]
    for k in range(3, 6):
        heard(k)
    assert {"rotor_speed_rad_s", "rotor_speed_time_s", "position_m", "quaternion", "output"} <= set(given[0])
    for each, before in zip(given, copied, strict=True):
        for name, value in each.items():
            np.testing.assert_array_equal(value, before[name], err_msg=name)
    assert given[0]["rotor_speed_rad_s"][0] != given[1]["rotor_speed_rad_s"][0]


def test_outputs_that_stopped_coming_make_the_sample_unusable(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)
    decoder.observe(servos(1_000_000))
    fresh, old = decoder.observe(imu(1_050_000)), decoder.observe(imu(1_150_000))
    assert fresh is not None
    assert old is not None
    assert np.isfinite(fresh.output).all()
    assert np.isnan(old.output).all()


def test_a_second_output_port_and_unknown_messages_are_not_mistaken(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)
    decoder.observe(servos(1_000_000, port=1))
    decoder.observe(dialect.MAVLink_vfr_hud_message(0.0, 0.0, 0, 0, 0.0, 0.0))
    sample = decoder.observe(imu(1_000_100))
    assert sample is not None
    assert np.isnan(sample.output).all()
    assert sample.position_m is None


def test_targets_that_are_marked_as_ignored_are_none(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)

    def sample(mask: int) -> Sample:
        decoder.observe(
            dialect.MAVLink_position_target_local_ned_message(1000, 1, mask, 1.0, 2.0, 3.0, *[0.0] * 6, 0.5, 0.0)
        )
        found = decoder.observe(dialect.MAVLink_highres_imu_message(1_000_000, *[0.0] * 13, 0x3F))
        assert found is not None
        return found

    target = sample(0).target_position_m
    assert target is not None
    assert target.tolist() == [1.0, 2.0, 3.0]
    assert sample(0).target_yaw_rad == 0.5
    assert sample(0b111).target_position_m is None
    assert sample(1 << 10).target_yaw_rad is None


def test_an_attitude_that_stopped_coming_is_not_handed_on(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)
    decoder.observe(dialect.MAVLink_attitude_quaternion_message(1000, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, [0.0] * 4))
    fresh, old = decoder.observe(imu(1_050_000)), decoder.observe(imu(1_200_000))
    assert fresh is not None
    assert old is not None
    assert fresh.quaternion is not None
    assert old.quaternion is None


def test_an_armed_autopilot_with_fewer_motors_than_the_airframe_is_not_believed(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)
    decoder.observe(dialect.MAVLink_heartbeat_message(13, 3, 128, 4, 4, 3))
    decoder.observe(dialect.MAVLink_servo_output_raw_message(1_000_000, 0, *[1500] * 6, 0, 0, *[0] * 8))
    sample = decoder.observe(imu(1_001_000))
    assert sample is not None
    assert np.isnan(sample.output).all()


def test_an_autopilot_that_does_not_answer_is_not_commanded(octo: Vehicle) -> None:
    adapter = NffAdapter(octo, (1, 1))
    silent = adapter.condition(10.0).command
    assert silent is not None
    assert silent.reason == Reason.SILENT
    adapter.observe(dialect.MAVLink_nff_applied_message(10_000_000, *[0] * 12), 10.0)
    assert adapter.condition(10.5).command is None
    assert adapter.condition(11.5).command == silent


def test_what_is_in_force_is_the_autopilots_word_and_nobody_can_change_it(octo: Vehicle) -> None:
    adapter = NffAdapter(octo, (1, 1))
    assert adapter.condition(10.0).in_force.failed is None, "it has not said"
    adapter.encode(Declare(10.0, np.eye(8, dtype=bool)[0], np.r_[0.0, np.ones(7)]))
    adapter.observe(dialect.MAVLink_nff_applied_message(10_000_000, 0, 0, 0, 0b10, 0, *[0] * 6, 2), 10.0)
    force = adapter.condition(10.0).in_force
    assert force.failed is not None
    assert force.failed.tolist() == [False, True] + [False] * 6, "not what it was told"
    assert force.source == Source.MATRIX
    with pytest.raises(ValueError, match="read-only"):
        force.failed[0] = True


def test_positions_and_targets_are_carried_on_to_the_moment_of_the_sample(octo: Vehicle) -> None:
    decoder = TelemetryDecoder(octo)
    decoder.observe(dialect.MAVLink_local_position_ned_message(1000, 10.0, 0.0, -5.0, 8.0, 0.0, 1.0))
    decoder.observe(dialect.MAVLink_position_target_local_ned_message(1000, 1, 0, 10, 0, -5, 8, 0, 0, *[0.0] * 5))
    now, later, old = decoder.observe(imu(1_000_000)), decoder.observe(imu(1_050_000)), decoder.observe(imu(1_400_000))
    assert now is not None
    assert later is not None
    assert old is not None
    places = now.position_m, later.position_m, later.target_position_m, old.position_m
    wanted = [10.0, 0.0, -5.0], [10.4, 0.0, -4.95], [10.4, 0.0, -5.0], [10.0, 0.0, -5.0]
    for place, expected in zip(places, wanted, strict=True):  # the last: not for longer than is known
        assert place is not None
        np.testing.assert_allclose(place, expected)


def test_no_sequence_is_used_twice_and_every_command_bears_its_time(octo: Vehicle) -> None:
    adapter = NffAdapter(octo, (1, 1))
    plan = make_plan(allocator("trim"), octo.effectiveness, np.r_[0.0, np.ones(7)], octo.hover)
    assert isinstance(plan, Plan)
    failed = np.eye(8, dtype=bool)[0]
    commands: list[Command] = [
        Declare(10.0, failed, np.ones(8)),
        Load(10.1, plan, failed),
        Drive(10.2, np.full(8, 0.5)),
        Release(10.3),
    ]
    messages = [message for command in commands for message in adapter.encode(command)]
    assert [m.get_type() for m in messages] == [
        "NFF_MOTOR_DECLARATION",
        "NFF_ALLOCATION_MATRIX",
        "NFF_ACTUATOR_OVERRIDE",
        "NFF_ALLOCATION_MATRIX",
    ]
    assert [m.sample_usec for m in messages] == [10_000_000, 10_100_000, 10_200_000, 10_300_000]
    assert len({m.sequence for m in messages}) == 4
    assert (messages[0].failed_mask, messages[1].valid, messages[3].valid) == (1, 1, 0)
