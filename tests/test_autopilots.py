"""Telemetry to samples, and outputs of the pipeline to commands."""

from __future__ import annotations

import numpy as np
import pytest

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.autopilots.nff import NffDialectAdapter
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import dialect
from nff_companion.pipeline import Mode, Output


def imu(usec: int):
    return dialect.MAVLink_highres_imu_message(
        usec, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.0, 0.0, 0.0, 950.0, 0.0, 0.0, 25.0, 63
    )


def servos(usec: int, port: int = 0):
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

    def sample(mask: int):
        decoder.observe(
            dialect.MAVLink_position_target_local_ned_message(1000, 1, mask, 1.0, 2.0, 3.0, *[0.0] * 6, 0.5, 0.0)
        )
        return decoder.observe(dialect.MAVLink_highres_imu_message(1_000_000, *[0.0] * 13, 0x3F))

    assert sample(0).target_position_m.tolist() == [1.0, 2.0, 3.0]
    assert sample(0).target_yaw_rad == 0.5
    assert sample(0b111).target_position_m is None
    assert sample(1 << 10).target_yaw_rad is None


def output(octo: Vehicle, time_s: float, failed: list[int], plan: Plan | None, mode: Mode = Mode.ALLOCATE) -> Output:
    mask = np.zeros(8, bool)
    mask[[m - 1 for m in failed]] = True
    ones = np.ones(8)
    return Output(time_s, mode, "", True, mask, ones, ones, ~ones.astype(bool), [], plan, None, None, np.zeros(4), 0, 0)


def test_a_declaration_is_repeated_until_confirmed_and_the_matrix_streams(octo: Vehicle) -> None:
    adapter = NffDialectAdapter(octo, (1, 1))
    eta = np.ones(8)
    eta[2] = 0.0
    plan = make_plan(allocator("trim"), octo.effectiveness, eta, octo.hover)
    assert isinstance(plan, Plan)
    kinds = []
    for k in range(60):
        if k == 40:
            adapter.observe(dialect.MAVLink_nff_applied_message(1, 0, 0, 1, 0b100, 1, *[0] * 6, 2))
        kinds += [(k, m.get_type(), m.sequence) for m in adapter.act(output(octo, 10 + 0.005 * k, [3], plan))]
    declared = [k for k, kind, _ in kinds if kind == "NFF_MOTOR_DECLARATION"]
    assert declared[0] == 0
    assert all(k < 40 for k in declared)
    assert len(kinds) == len({s for _, _, s in kinds}), "no sequence is used twice"
    streamed = [k for k, kind, _ in kinds if kind == "NFF_ALLOCATION_MATRIX"]
    assert streamed[0] == 0
    assert max(np.diff(streamed)) <= 11, "fresh well within its time-out"


def test_a_plan_that_is_gone_is_released_at_once(octo: Vehicle) -> None:
    adapter = NffDialectAdapter(octo, (1, 1))
    plan = make_plan(allocator("pinv"), octo.effectiveness, np.r_[0.5, np.ones(7)], octo.hover)
    assert isinstance(plan, Plan)
    adapter.act(output(octo, 10.0, [], plan))
    (message,) = adapter.act(output(octo, 10.005, [], None))
    assert (message.get_type(), message.valid) == ("NFF_ALLOCATION_MATRIX", 0)
    assert adapter.act(output(octo, 10.01, [], None)) == []


def test_observe_sends_no_command(octo: Vehicle) -> None:
    adapter = NffDialectAdapter(octo, (1, 1))
    assert adapter.act(output(octo, 10.0, [1], None, Mode.OBSERVE)) == []


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
    adapter = NffDialectAdapter(octo, (1, 1))
    assert "NFF_APPLIED" in adapter.blocked(10.0, Mode.ALLOCATE)
    adapter.observe(dialect.MAVLink_nff_applied_message(10_000_000, *[0] * 12))
    assert adapter.blocked(10.5, Mode.ALLOCATE) == ""
    assert "NFF_APPLIED" in adapter.blocked(11.5, Mode.ALLOCATE)
