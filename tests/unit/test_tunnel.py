"""Python and Lua encode every message of the tunnel to the same bytes, and read each other's."""

from __future__ import annotations

import random
import struct
from importlib import resources
from typing import Any

import numpy as np
import pytest
from lupa.lua53 import LuaRuntime

from nff_companion.autopilots.ardupilot import tunnel
from nff_companion.autopilots.ardupilot.tunnel import Kind, TunnelMessage, unpack
from nff_companion.errors import TunnelError
from nff_companion.mavlink.codec import Codec

Lua = tuple[Any, Any]  # the runtime and the module
_BYTES = {"flags": 255, "motors": 12, "source": 3, "tables": 255}


@pytest.fixture(scope="module")
def lua() -> Lua:
    runtime = LuaRuntime(encoding=None)
    folder = resources.files("nff_companion") / "autopilots" / "ardupilot" / "lua" / "modules"
    return runtime, runtime.execute((folder / "nff_protocol.lua").read_bytes())


def example(kind: Kind, draw: random.Random) -> TunnelMessage:
    motors = draw.randint(3, 12)
    values = {}
    for name in tunnel._LAYOUTS[kind][1]:
        largest = 2**31 - 1 if name.endswith("_ms") and name != "timeout_ms" else _BYTES.get(name, 2**16 - 1)
        values[name] = draw.randint(0, largest)
    message = TunnelMessage(kind, values)
    if "motors" in values:
        values["motors"] = motors
    if kind in (Kind.TABLE, Kind.MATRIX):
        rows = [[draw.randint(-32768, 32767) for _ in range(4)] for _ in range(motors)]
        message.factors = np.array(rows, np.int16)
    elif kind == Kind.OVERRIDE:
        message.pwm = np.array([draw.randint(0, 2200) for _ in range(motors)], np.uint16)
    return message


@pytest.mark.parametrize("kind", list(Kind))
def test_lua_packs_and_reads_what_python_does(kind: Kind, lua: Lua) -> None:
    runtime, protocol = lua
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    draw = random.Random(seed)
    for _ in range(50):
        message = example(kind, draw)
        fields = runtime.table()
        for name, value in message.values.items():
            fields[name.encode()] = value
        if message.factors is not None:
            fields[b"factors"] = message.factors.astype("<i2").tobytes()
        if message.pwm is not None:
            fields[b"pwm"] = message.pwm.astype("<u2").tobytes()
        data = message.pack()
        assert protocol[b"pack"](int(kind), fields) == data
        read = protocol[b"unpack"](data)
        assert {name: read[name.encode()] for name in message.values} == message.values
        again = unpack(data)
        assert again.values == message.values
        if message.factors is not None:
            assert again.factors is not None
            assert np.array_equal(again.factors, message.factors)
        if message.pwm is not None:
            assert again.pwm is not None
            assert np.array_equal(again.pwm, message.pwm)
        assert protocol[b"check"](data) == tunnel.check(data)


def test_both_give_a_table_and_all_tables_the_same_check(lua: Lua, rng: np.random.Generator) -> None:
    _, protocol = lua
    tables = {int(mask): rng.bytes(64) for mask in rng.permutation(200)[:36]}
    each = {mask: protocol[b"table_check"](mask, table) for mask, table in tables.items()}
    assert each == {mask: tunnel.table_check(mask, table) for mask, table in tables.items()}
    together = tunnel.tables_check(tables)
    assert together == sum(check for mask, check in each.items() if mask) % protocol[b"CHECKS"]
    assert tunnel.tables_check(dict(reversed(tables.items()))) == together
    first, second = [mask for mask in tables if mask][:2]
    swapped = {**tables, first: tables[second], second: tables[first]}
    assert tunnel.tables_check(swapped) != together, "which motors a table is for counts"
    assert tunnel.tables_check({**tables, 0: b"another"}) == together, "the stock one has a check of its own"


def test_every_message_fits_for_twelve_motors() -> None:
    for kind in Kind:
        message = example(kind, random.Random(3))
        if message.factors is not None:
            message.factors = np.zeros((12, 4), np.int16)
        if message.pwm is not None:
            message.pwm = np.zeros(12, np.uint16)
        if "motors" in message.values:
            message.values["motors"] = 12
        assert len(message.pack()) <= 128


def test_what_was_cut_changed_or_is_newer_is_refused_with_a_reason(lua: Lua) -> None:
    _, protocol = lua
    good = TunnelMessage(Kind.DECLARATION, {"sequence": 1, "instance": 9, "sample_ms": 5, "failed": 1}).pack()

    def sealed(body: bytes) -> bytes:
        return body + struct.pack("<HB", tunnel.check(body), 0xA5)

    for bad, reason in (
        (good[:-1], "end mark"),
        (good[:-1] + b"\0", "end mark"),
        (sealed(b"\x01" + good[1:-3]), "version 1, expected 2: install the applet of this release"),
        (sealed(good[:1] + b"\x63" + good[2:-3]), "kind 99"),
        (sealed(good[:4]), "at least"),
        (sealed(good[:-3] + b"\x01"), "carries 1 bytes"),
        (good[:-4] + b"\x05" + good[-3:], "changed on the way"),
        (b"", "end mark"),
    ):
        with pytest.raises(TunnelError, match=reason):
            unpack(bad)
        assert protocol[b"unpack"](bad) is None


def test_no_single_flipped_bit_gets_through(lua: Lua) -> None:
    _, protocol = lua
    good = TunnelMessage(Kind.DECLARATION, {"sequence": 7, "instance": 3, "sample_ms": 12345, "failed": 4}).pack()
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises(TunnelError):
            unpack(bytes(bad))
        assert protocol[b"unpack"](bytes(bad)) is None


def test_a_tunnel_of_someone_else_is_left_alone() -> None:
    codec = Codec(1, 1)
    data = TunnelMessage(Kind.STORED, {"sequence": 1, "failed": 2, "check": 3}).pack()
    frame = codec.pack(tunnel.wrap(data, (1, 191), payload_type=200))
    (message,) = Codec(1, 191).parse(frame)
    assert tunnel.unwrap(message) is None
    frame = codec.pack(tunnel.wrap(data, (1, 191), payload_type=tunnel.TO_COMPANION))
    (message,) = Codec(1, 191).parse(frame)
    inner = tunnel.unwrap(message)
    assert inner is not None
    assert inner.values == {"sequence": 1, "failed": 2, "check": 3}
