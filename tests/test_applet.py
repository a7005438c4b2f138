"""The shipped Lua applet and its watchdog in a real Lua 5.3: what they honour, refuse, hold and give up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from applet_bench import AppletBench, Kind, TunnelMessage

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots.ardupilot import factors as units
from nff_companion.autopilots.ardupilot import tunnel
from sitl.autopilot.ardupilot import lua_host


@pytest.fixture
def bench(tmp_path: Path) -> AppletBench:
    bench = AppletBench(tmp_path)
    bench.heartbeat()
    bench.fly(0.1)
    return bench


def rows(bench: AppletBench, mask: int) -> np.ndarray:
    plans = tables.compute(bench.vehicle, allocator("trim"))
    return units.of_plans(bench.vehicle, plans)[mask]


def near(bench: AppletBench, table: np.ndarray) -> bool:
    return bool(np.allclose(bench.factors, table / tunnel.FACTOR_SCALE, atol=1e-6))


def test_stock_factors_are_the_firmwares_own(bench: AppletBench) -> None:
    stock = bench.fleet.autopilot._stock
    assert np.allclose(bench.factors, stock, atol=2e-4)
    assert bench.applied["source"] == 0
    assert bench.applied["motors"] == 8
    assert bench.applied["tables"] == 37
    assert bench.applied["flags"] & 0b1011 == 0b1011


def test_a_declaration_switches_to_its_table_and_stops_the_motor(bench: AppletBench) -> None:
    bench.declare(0b1)
    bench.fly(0.01)
    assert bench.applied["failed"] == 1
    assert bench.applied["declaration_sequence"] == bench.sequence
    assert near(bench, rows(bench, 0b1))
    bench.fly(0.05)
    assert bench.applied["source"] == 1
    assert bench.pwm[0] == 1000
    assert np.isnan(bench.pwm[1:]).all()


def test_a_pair_switches_and_a_lifted_one_goes_back(bench: AppletBench) -> None:
    bench.declare(0b101)
    bench.fly(0.02)
    assert near(bench, rows(bench, 0b101))
    bench.declare(0)
    bench.fly(0.1)
    assert near(bench, rows(bench, 0))
    assert np.isnan(bench.pwm).all()


def test_three_motors_without_a_table_lose_their_rows(bench: AppletBench) -> None:
    bench.declare(0b111)
    bench.fly(0.02)
    assert (bench.factors[:3] == 0.0).all()
    assert np.allclose(bench.factors[3:], rows(bench, 0)[3:] / tunnel.FACTOR_SCALE)


def test_a_fresh_table_replaces_the_installed_one(bench: AppletBench) -> None:
    table = rows(bench, 0b1) // 2
    bench.send(TunnelMessage(Kind.TABLE, {"failed": 1, "flags": 0}, table))
    bench.fly(0.02)
    stored = next(m for m in bench.heard if m.kind == Kind.STORED)
    assert stored.values["check"] == tunnel.check(np.ascontiguousarray(table, "<i2").tobytes())
    bench.declare(1)
    bench.fly(0.02)
    assert near(bench, table)


def test_the_streamed_matrix_rules_until_it_expires(bench: AppletBench) -> None:
    bench.declare(1)
    refined = (rows(bench, 1) * 0.9).astype(np.int16)
    bench.matrix(1, refined, timeout_ms=200)
    bench.fly(0.1)
    assert near(bench, refined)
    assert bench.applied["source"] == 2
    bench.fly(0.2)
    assert near(bench, rows(bench, 1))
    assert bench.applied["source"] == 1


def test_link_loss_reverts_the_matrix_and_holds_the_mask(bench: AppletBench) -> None:
    bench.declare(1)
    bench.matrix(1, (rows(bench, 1) * 0.9).astype(np.int16), timeout_ms=2000)
    bench.fly(0.5)
    assert bench.applied["source"] == 2
    bench.fly(0.7)
    assert bench.applied["source"] == 1
    assert bench.applied["flags"] & tunnel.Flag.LINK == 0
    bench.fly(3.0)
    assert near(bench, rows(bench, 1))
    assert bench.pwm[0] == 1000


def test_a_partial_loss_is_given_up_with_the_link(bench: AppletBench) -> None:
    bench.matrix(0, (rows(bench, 0) * 0.9).astype(np.int16), timeout_ms=2000)
    bench.fly(0.2)
    assert bench.applied["source"] == 2
    bench.fly(1.2)
    assert bench.applied["source"] == 0
    assert near(bench, rows(bench, 0))


def test_overrides_drive_single_channels_and_expire(bench: AppletBench) -> None:
    pwm = np.array([1500, 0, 1600, 0, 0, 0, 0, 0])
    bench.override(pwm, timeout_ms=50)
    bench.fly(0.02)
    assert bench.pwm[0] == 1500
    assert bench.pwm[2] == 1600
    assert np.isnan(bench.pwm[[1, 3, 4, 5, 6, 7]]).all()
    bench.fly(0.05)
    assert np.isnan(bench.pwm).all()


def test_an_override_never_drives_a_motor_that_is_declared_failed(bench: AppletBench) -> None:
    bench.declare(1)
    bench.fly(0.01)
    bench.override(np.full(8, 1500))
    bench.fly(0.02)
    assert bench.pwm[0] == 1000
    assert (bench.pwm[1:] == 1500).all()


@pytest.mark.parametrize(
    ("send", "reason"),
    [
        (lambda b: b.declare(1, age_ms=400), "stale"),
        (lambda b: b.declare(1, age_ms=-200), "stale"),
        (lambda b: b.declare(0b11111), "range"),
        (lambda b: b.declare(1 << 8), "range"),
        (lambda b: b.matrix(1, rows(b, 1)), "range"),  # motor 1 is not declared
        (lambda b: b.matrix(0, rows(b, 0), timeout_ms=5000), "range"),
        (lambda b: b.matrix(0, rows(b, 0), timeout_ms=0), "range"),
        (lambda b: b.matrix(0, rows(b, 0)[:6]), "dimension"),
        (lambda b: b.matrix(0, -rows(b, 0)), "range"),  # throttle the wrong way
        (lambda b: b.matrix(0, rows(b, 0), age_ms=300), "stale"),
        (lambda b: b.override(np.full(8, 2500)), "range"),
        (lambda b: b.override(np.full(8, 900)), "range"),
        (lambda b: b.override(np.full(8, 1500), timeout_ms=500), "range"),
        (lambda b: b.override(np.full(6, 1500)), "dimension"),
        (lambda b: b.override(np.full(8, 1500), age_ms=300), "stale"),
        (lambda b: b.send(TunnelMessage(Kind.TABLE, {"failed": 1, "flags": 0}, rows(b, 0))), "range"),
        (lambda b: b.send_bytes(b"\x01\x03\x00"), "format"),
        (lambda b: b.send_bytes(b"\x07\x03\x00\xa5"), "format"),
        (lambda b: b.send(TunnelMessage(Kind.STORED, {"failed": 1, "check": 1})), "format"),
    ],
)
def test_what_must_not_be_obeyed_is_counted_and_changes_nothing(bench: AppletBench, send, reason: str) -> None:
    before = bench.factors.copy()
    send(bench)
    bench.fly(0.1)
    assert bench.applied[reason] == 1
    assert sum(bench.applied[name] for name in tunnel.REFUSALS) == 1
    assert np.array_equal(bench.factors, before)
    assert np.isnan(bench.pwm).all()
    assert bench.applied["failed"] == 0


def test_an_older_matrix_does_not_replace_a_newer_one(bench: AppletBench) -> None:
    newer = (rows(bench, 0) * 0.9).astype(np.int16)
    bench.matrix(0, newer)
    bench.fly(0.01)
    bench.matrix(0, rows(bench, 0), sequence=bench.sequence)
    bench.fly(0.1)
    assert bench.applied["replay"] == 1
    assert near(bench, newer)


def test_strangers_are_not_heard(bench: AppletBench) -> None:
    declaration = {"sample_ms": bench.now_ms, "failed": 1}
    bench.send(TunnelMessage(Kind.DECLARATION, dict(declaration)), system=7)
    bench.send(TunnelMessage(Kind.DECLARATION, dict(declaration)), component=190)
    bench.fly(0.1)
    assert bench.applied["failed"] == 0
    assert bench.applied["accepted"] == 1  # the heartbeat


def test_disarmed_nothing_is_driven_and_everything_is_forgotten(bench: AppletBench) -> None:
    bench.declare(1)
    bench.fly(0.05)
    bench.fleet.autopilot.disarm(0)
    bench.fly(0.1)
    assert bench.applied["failed"] == 0
    assert near(bench, rows(bench, 0))
    bench.declare(1)
    bench.override(np.full(8, 1500))
    bench.matrix(0, rows(bench, 0))
    bench.fly(0.1)
    assert bench.applied["disarmed"] == 3
    assert np.isnan(bench.pwm).all()


def test_the_pilots_stop_wins_over_overrides(bench: AppletBench) -> None:
    bench.override(np.full(8, 1500), timeout_ms=100)
    bench.fly(0.02)
    assert (bench.pwm == 1500).all()
    bench.autopilot.pilot_stops = True
    bench.fly(0.01)
    assert (bench.pwm == 1000).all()
    bench.fly(0.1)
    assert np.isnan(bench.pwm).all(), "the firmware's own stop holds from here"
    bench.override(np.full(8, 1500))
    bench.fly(0.1)
    assert np.isnan(bench.pwm).all()
    assert bench.applied["disarmed"] == 1


def test_a_frame_with_a_wrong_crc_is_refused(bench: AppletBench) -> None:
    data = bytearray(TunnelMessage(Kind.DECLARATION, {"sequence": 5, "sample_ms": bench.now_ms, "failed": 4}).pack())
    data[8] ^= 1  # the mask becomes another one
    bench.send_bytes(bytes(data))
    bench.fly(0.1)
    assert bench.applied["failed"] == 0
    assert bench.applied["format"] == 1


def test_without_the_scripted_frame_only_outputs_are_taken(tmp_path: Path) -> None:
    bench = AppletBench(tmp_path, scripted=False)
    bench.heartbeat()
    bench.fly(0.1)
    assert bench.applied["flags"] & tunnel.Flag.MATRIX == 0
    bench.matrix(0, rows(bench, 0))
    bench.override(np.full(8, 1500))
    bench.fly(0.02)
    assert (bench.pwm == 1500).all()
    bench.fly(0.1)
    assert bench.applied["unsupported"] == 1
    assert bench.autopilot.port.factors is None


def test_when_the_applet_dies_the_watchdog_holds_the_mask(bench: AppletBench) -> None:
    bench.fly(1.1)
    assert bench.applied["flags"] & tunnel.Flag.WATCHDOG
    bench.declare(1)
    bench.matrix(1, (rows(bench, 1) * 0.5).astype(np.int16), timeout_ms=2000)
    bench.fly(0.1)
    bench.autopilot.scripts.stop("nff_companion.lua")
    bench.fly(1.0)
    assert near(bench, rows(bench, 1))
    assert bench.pwm[0] == 1000
    assert any("applet stopped" in text for _, _, text in bench.autopilot.texts)
    assert not bench.fleet.state.crashed[0]
    bench.fleet.autopilot.disarm(0)
    bench.fly(0.1)
    assert np.isnan(bench.pwm).all()


def test_an_error_inside_the_applet_leaves_safe_factors_and_says_so(bench: AppletBench) -> None:
    bench.declare(1)
    bench.matrix(1, (rows(bench, 1) * 0.5).astype(np.int16), timeout_ms=2000)
    bench.fly(0.05)

    def broken() -> bool:
        raise RuntimeError("binding failed")

    bench.autopilot.scripts._runtime.globals()[b"host_prelude"][b"armed"] = broken
    bench.fly(0.05)
    assert near(bench, rows(bench, 1))
    assert any("NFF:" in text and "binding failed" in text for _, _, text in bench.autopilot.texts)
    assert "nff_companion.lua" in bench.autopilot.scripts.running


def test_a_burst_stays_within_the_instruction_limit(bench: AppletBench) -> None:
    for mask in range(1, 25):
        bench.send(TunnelMessage(Kind.TABLE, {"failed": 1, "flags": 0}, rows(bench, 1)))
        assert mask
    bench.matrix(0, rows(bench, 0))
    bench.fly(0.1)
    assert bench.autopilot.scripts.removed == {}
    assert bench.applied["accepted"] >= 25


def test_a_script_that_loops_is_removed_as_the_firmware_does(tmp_path: Path) -> None:
    bench = AppletBench(tmp_path)
    endless = tmp_path / "endless.lua"
    endless.write_text("pcall(function() while true do end end) return 1, 1", encoding="utf-8")
    bench.autopilot.scripts.start(endless)
    bench.fly(0.05)
    assert "time limit" in bench.autopilot.scripts.removed["endless.lua"]
    assert lua_host.INSTRUCTION_LIMIT == 100_000
