"""The battery's voltage in a log, and how much less of it there is under load."""

from __future__ import annotations

from pathlib import Path

import log_files
import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.calibration.battery import sag
from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, dialect
from nff_companion.replay.run import flights, reading

DT_S, LATE_S = 0.005, 0.5
OCTO = vehicle.load("arducopter-octa-x")


def flown(rng: np.random.Generator, ratio: float, noise_v: float = 0.02) -> tuple[NDArray[np.float64], ...]:
    """Readings at 2 Hz in three minutes, thrust."""
    steps = rng.standard_normal(180).repeat(200)
    thrust = 7.0 * (1.0 + 0.05 * np.convolve(steps, np.full(100, 0.01), mode="same"))
    at = np.arange(LATE_S + 0.3, LATE_S + 179.0, 0.5)
    load = np.interp(at, LATE_S + DT_S * np.arange(len(thrust)), thrust / thrust.mean())
    volts = 22.0 * (1.0 + ratio * (load - 1.0) - 2e-4 * at) + noise_v * rng.standard_normal(len(at))
    return np.column_stack([at, volts]), thrust


@pytest.mark.parametrize("ratio", [0.0, -0.02, -0.08])
def test_the_sag_is_found_while_the_battery_runs_down(ratio: float, rng: np.random.Generator) -> None:
    told, thrust = flown(rng, ratio)
    found = sag([told], [thrust], [DT_S], [LATE_S])
    assert found is not None
    assert abs(found.ratio - ratio) < 4.0 * found.deviation < 0.03
    assert found.applied(thrust) == pytest.approx(
        thrust * (1.0 + ratio * (thrust / thrust.mean() - 1.0)) ** 2, rel=0.01
    )


def test_each_flight_has_a_battery_of_its_own(rng: np.random.Generator) -> None:
    (first, thrust), (second, other) = flown(rng, -0.03), flown(rng, -0.03)
    second[:, 1] += 2.0
    found = sag([first, second], [thrust, other], [DT_S] * 2, [LATE_S] * 2)
    assert found is not None
    assert found.ratio == pytest.approx(-0.03, abs=0.004)


@pytest.mark.parametrize("wrong", ["few", "none", "noise", "rises", "zeros", "outside", "constant"])
def test_what_no_battery_does_is_not_taken_for_one(wrong: str, rng: np.random.Generator) -> None:
    told, thrust = flown(rng, 0.1 if wrong == "rises" else -0.03, noise_v=8.0 if wrong == "noise" else 0.02)
    told = {"few": told[:20], "none": told[:0], "zeros": told * (1.0, 0.0), "outside": told + np.array([1e6, 0.0])}.get(
        wrong, told
    )
    if wrong == "constant":
        told[:, 1] = 16.2
    assert sag([told], [thrust], [DT_S], [LATE_S]) is None


def test_readings_of_the_first_battery_are_taken_from_every_kind_of_log(tmp_path: Path) -> None:
    told = [
        dialect.MAVLink_sys_status_message(0, 0, 0, 0, volts, -1, -1, 0, 0, 0, 0, 0, 0) for volts in (22_000, 65_535)
    ]
    for path in (
        log_files.tlog(tmp_path / "a.tlog", extra=told),
        log_files.ulog(tmp_path / "a.ulg", battery=True),
        log_files.dataflash(tmp_path / "a.bin", battery=True),
    ):
        found = reading(flights(path)[0], OCTO)
        assert len(found.battery)
        assert (found.battery[:, 1] == 22.0).all()
        times = [sample.time_s for _, sample in found.rows]
        assert (found.battery[:, 0] > times[0] - 0.1).all()
        assert (found.battery[:, 0] < times[-1] + 1.1).all()


def test_a_log_without_voltage_has_no_readings(tmp_path: Path) -> None:
    for path in (
        log_files.tlog(tmp_path / "a.tlog", keep=lambda message: message.get_type() != "SYS_STATUS"),
        log_files.ulog(tmp_path / "a.ulg"),
        log_files.dataflash(tmp_path / "a.bin"),
    ):
        assert reading(flights(path)[0], OCTO).battery.shape == (0, 2)


@pytest.mark.parametrize("clock", ["autopilot's", "ground station's"])
def test_a_clock_that_was_set_leaves_no_reading(clock: str, tmp_path: Path) -> None:
    rows = [row for row in log_files.records() if row[2].get_type() != "SYS_STATUS"]
    told = dialect.MAVLink_sys_status_message(0, 0, 0, 0, 22_000, -1, -1, 0, 0, 0, 0, 0, 0)
    frames = [(t, frame) for t, frame, _ in rows]
    middle = len(frames) // 2
    reading_of_it = (frames[middle][0], Codec(1, 1).pack(told))
    before, after = [*frames[:middle], reading_of_it], frames[middle:]
    if clock == "autopilot's":
        later_s = frames[-1][0] - frames[0][0] + 1.0
        written = before + after + [(t + later_s, frame) for t, frame in frames]  # the same clock again: a reboot
    else:
        written = before + [(t - 3.0, frame) for t, frame in after]
    path = log_files.write_tlog(tmp_path / "a.tlog", written)
    assert reading(flights(path)[0], OCTO).battery.shape == (0, 2)
