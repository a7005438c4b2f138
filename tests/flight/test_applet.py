"""The shipped Lua applet and its watchdog in a real Lua 5.3: what they honour, refuse, hold and give up."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from applet_bench import INSTANCE, AppletBench, Kind, TunnelMessage
from numpy.typing import NDArray

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


def rows(bench: AppletBench, mask: int) -> NDArray[np.int16]:
    plans = tables.compute(bench.vehicle, allocator("trim"))
    return units.of_plans(bench.vehicle, plans)[mask]


def near(bench: AppletBench, table: NDArray[np.int16]) -> bool:
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
    bench.fleet.autopilot.disarm(0)
    bench.table(1, table)
    bench.fly(0.02)
    stored = next(m for m in bench.heard if m.kind == Kind.STORED)
    assert stored.values["check"] == tunnel.table_check(1, tunnel.table_bytes(table))
    bench.fleet.autopilot.armed[0] = True
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
        (lambda b: b.table(1, rows(b, 1)), "armed"),
        (lambda b: b.table(0, rows(b, 0)), "armed"),
        (lambda b: b.send_bytes(b"\x02\x03\x00"), "format"),
        (lambda b: b.send_bytes(b"\x07\x03\x00\xa5"), "format"),
        (lambda b: b.send(TunnelMessage(Kind.STORED, {"failed": 1, "check": 1})), "format"),
    ],
)
def test_what_must_not_be_obeyed_is_counted_and_changes_nothing(
    bench: AppletBench, send: Callable[[AppletBench], None], reason: str
) -> None:
    before = bench.factors.copy()
    send(bench)
    bench.fly(0.1)
    assert bench.applied[reason] == 1
    assert sum(bench.applied[name] for name in tunnel.REFUSALS) == 1
    assert np.array_equal(bench.factors, before)
    assert np.isnan(bench.pwm).all()
    assert bench.applied["failed"] == 0


@pytest.mark.parametrize("armed", [False, True])
def test_nobody_replaces_the_table_of_no_failure(bench: AppletBench, armed: bool) -> None:
    bench.fleet.autopilot.armed[0] = armed
    before = bench.factors.copy()
    bench.table(0, (rows(bench, 0) * 0.5).astype(np.int16))
    bench.fly(0.1)
    assert np.array_equal(bench.factors, before)
    assert bench.applied["armed" if armed else "range"] == 1
    assert bench.applied["accepted"] == 1  # the heartbeat


def test_armed_no_table_is_taken(bench: AppletBench) -> None:
    bench.table(1, (rows(bench, 1) * 0.5).astype(np.int16))
    bench.declare(1)
    bench.fly(0.1)
    assert bench.applied["armed"] == 1
    assert near(bench, rows(bench, 1))


def stored_tables(bench: AppletBench) -> dict[int, bytes]:
    plans = tables.compute(bench.vehicle, allocator("trim"))
    return {mask: tunnel.table_bytes(table) for mask, table in units.of_plans(bench.vehicle, plans).items()}


def test_the_applet_says_what_is_on_its_card_one_table_a_run(bench: AppletBench) -> None:
    stored = stored_tables(bench)
    assert bench.applied["stock_check"] == tunnel.check(stored[0])
    bench.fly(0.3)
    assert bench.applied["flags"] & tunnel.Flag.CHECKED
    assert bench.applied["tables_check"] == tunnel.tables_check(stored)
    bench.heard.clear()
    for _ in range(10):  # the link is kept
        bench.heartbeat()
        bench.fly(0.2)
    named = {m.values["table"]: m.values["table_check"] for m in bench.heard if m.kind == Kind.APPLIED}
    assert named == {mask: tunnel.table_check(mask, table) for mask, table in stored.items() if mask}


def test_the_check_of_all_tables_follows_a_new_one(bench: AppletBench) -> None:
    bench.fleet.autopilot.disarm(0)
    stored = stored_tables(bench)
    for mask, factor in ((1, 0.5), (1, 0.7), (0b111, 0.0)):  # replaced, replaced again, and one that was not there
        table = (rows(bench, 1 if mask == 1 else 0) * factor).astype(np.int16)
        stored[mask] = tunnel.table_bytes(table)
        bench.table(mask, table)
    bench.fly(0.4)
    assert bench.applied["tables_check"] == tunnel.tables_check(stored)
    assert bench.applied["tables"] == len(stored)


def test_a_late_declaration_does_not_undo_a_newer_one(bench: AppletBench) -> None:
    late = tunnel.following(bench.sequence)
    bench.sequence = late
    sample_ms = bench.now_ms - 5
    bench.declare(0b11)
    bench.fly(0.02)
    bench.declare(0b1, values={"sequence": late, "sample_ms": sample_ms})
    bench.fly(0.1)
    assert bench.applied["failed"] == 0b11
    assert bench.applied["replay"] == 1


def test_a_late_declaration_does_not_undo_a_lifted_one(bench: AppletBench) -> None:
    bench.declare(0b1)
    first = bench.sequence
    sample_ms = bench.now_ms - 5
    bench.fly(0.02)
    bench.declare(0)
    bench.fly(0.02)
    bench.declare(0b1, values={"sequence": first, "sample_ms": sample_ms})
    bench.fly(0.1)
    assert bench.applied["failed"] == 0
    assert bench.applied["replay"] == 1


def test_sequences_wrap(bench: AppletBench) -> None:
    bench.sequence = 2**16 - 2
    for mask in (0b1, 0b11, 0b111):
        bench.declare(mask)
        bench.fly(0.02)
        assert bench.applied["failed"] == mask
    assert bench.sequence == 1


def test_a_second_failure_is_taken_after_more_messages_than_half_the_sequences(bench: AppletBench) -> None:
    bench.declare(0b1)
    bench.fly(0.02)
    bench.sequence = (bench.sequence + 40_000) % 2**16  # half an hour of heartbeats and matrices
    for _ in range(6):
        bench.heartbeat()
        bench.fly(0.2)
    bench.declare(0b11)
    bench.fly(0.02)
    assert bench.applied["failed"] == 0b11


def test_of_two_companions_that_disagree_the_first_is_obeyed_and_both_hear_of_whom(bench: AppletBench) -> None:
    other: dict[str, Any] = {"component": 192, "instance": 99, "channel": 1}
    bench.declare(0b1)
    bench.fly(0.02)
    bench.told.clear()
    loads = []
    for k in range(40):
        bench.declare(0b10, **other)
        bench.heartbeat(**other)
        if k % 8 == 0:
            bench.heartbeat()
        bench.fly(0.025)
        loads.append(bench.factors.copy())
    assert bench.applied["failed"] == 0b1
    assert bench.applied["occupied"] == 80
    assert all(np.array_equal(load, loads[0]) for load in loads)
    heard = {(channel, component) for channel, component, m in bench.told if m.kind == Kind.APPLIED}
    assert heard == {(0, 191), (1, 192)}
    assert {m.values["owner"] for _, _, m in bench.told if m.kind == Kind.APPLIED} == {INSTANCE}


def test_a_restarted_companion_takes_over_when_the_killed_one_was_silent(bench: AppletBench) -> None:
    bench.sequence = 30_000
    bench.declare(0b1)
    bench.fly(0.02)
    bench.sequence = 0  # it begins anew
    for _ in range(4):
        bench.declare(0b11, instance=99)
        bench.fly(0.2)
        assert bench.applied["failed"] == 0b1
        assert bench.applied["owner"] == INSTANCE
    bench.fly(0.2)
    bench.declare(0b11, instance=99)
    bench.fly(0.02)
    assert bench.applied["owner"] == 99
    assert bench.applied["failed"] == 0b11
    bench.heartbeat()
    bench.fly(0.1)
    assert bench.applied["owner"] == 99, "the first one comes back too late"


def test_after_a_goodbye_the_next_is_obeyed_at_once_and_declarations_stay(bench: AppletBench) -> None:
    bench.declare(0b1)
    bench.matrix(1, (rows(bench, 1) * 0.9).astype(np.int16))
    bench.fly(0.02)
    bench.release()
    bench.fly(0.02)
    bench.heartbeat(instance=99)
    bench.fly(0.1)
    assert bench.applied["owner"] == INSTANCE, "a release alone is no goodbye"
    bench.release(leaving=True)
    bench.fly(0.02)
    assert bench.applied["owner"] == 0
    assert bench.applied["failed"] == 0b1
    bench.heartbeat()  # was on its way
    bench.sequence = 0
    bench.declare(0b11, instance=99)
    bench.fly(0.1)
    assert bench.applied["owner"] == 99
    assert bench.applied["failed"] == 0b11
    assert bench.applied["occupied"] == 2


def test_a_companion_of_another_release_hears_of_which_the_applet_is(tmp_path: Path) -> None:
    bench = AppletBench(tmp_path)
    bench.send_bytes(b"\x01\x01\x05\x00\x01\x00\x00\xa5", channel=1)
    bench.fly(0.1)
    (channel, component, message), *_ = bench.told
    assert (channel, component, message.kind) == (1, 191, Kind.APPLIED)
    assert message.values["format"] == 1
    assert message.values["owner"] == 0


def test_whether_the_matrix_in_force_gives_up_yaw_is_said(bench: AppletBench) -> None:
    for flags, said in ((tunnel.YAW_RELEASED, True), (0, False)):
        bench.matrix(0, rows(bench, 0), flags=flags, timeout_ms=100)
        bench.fly(0.08)
        assert bool(bench.applied["flags"] & tunnel.Flag.YAW_RELEASED) == said
    bench.matrix(0, rows(bench, 0), flags=tunnel.YAW_RELEASED, timeout_ms=100)
    bench.fly(0.2)
    assert not bench.applied["flags"] & tunnel.Flag.YAW_RELEASED


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
    values = {"sequence": 5, "instance": INSTANCE, "sample_ms": bench.now_ms, "failed": 4}
    frame = bytearray(TunnelMessage(Kind.DECLARATION, values).pack())
    frame[10] ^= 1  # the mask becomes another one
    bench.send_bytes(bytes(frame))
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
    bench.fleet.autopilot.disarm(0)
    table = rows(bench, 1)
    for _ in range(25):
        bench.table(1, table)
    bench.fly(0.1)
    assert bench.autopilot.scripts.removed == {}
    assert bench.applied["accepted"] == 26


def test_a_script_that_loops_is_removed_as_the_firmware_does(tmp_path: Path) -> None:
    bench = AppletBench(tmp_path)
    endless = tmp_path / "endless.lua"
    endless.write_text("pcall(function() while true do end end) return 1, 1", encoding="utf-8")
    bench.autopilot.scripts.start(endless)
    bench.fly(0.05)
    assert "time limit" in bench.autopilot.scripts.removed["endless.lua"]
    assert lua_host.INSTRUCTION_LIMIT == 100_000
