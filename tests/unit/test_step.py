"""One step after the other by hand: each sample is answered once, and what leaves a step stays as it left it."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from golden import flights
from numpy.typing import NDArray
from stepping import Stepped

from nff_companion.companion_state import NO_ORDERS, Orders
from nff_companion.condition import Mode
from nff_companion.core.sample import Sample


def recorded(name: str, count: int) -> list[Sample]:
    return flights.unpack(flights.load(name)[0])[:count]


def test_a_sample_is_answered_once_and_an_older_one_never() -> None:
    samples = recorded("override", 430)
    companion = Stepped(mode=Mode.OVERRIDE)
    outputs = companion.steps(samples)
    assert outputs[-1].override is not None
    loop = companion.state.loop
    for again in (samples[-1], samples[-3], samples[-1]):
        assert companion.respond(again) is None
        assert companion.state.loop is loop, "an answer would have moved it"
        assert companion.step(again).override is None
    assert companion.respond(flights.unpack(flights.load("override")[0])[430]) is not None


def arrays(thing: Any, name: str) -> dict[str, NDArray[np.float64]]:
    """All arrays in ``thing``, by the way to them."""
    if isinstance(thing, np.ndarray):
        return {name: thing}
    if isinstance(thing, tuple | list):
        parts = [(str(k), part) for k, part in enumerate(thing)]
    elif is_dataclass(thing):
        parts = [(f.name, getattr(thing, f.name)) for f in fields(thing)]
    elif isinstance(thing, msgspec.Struct):
        parts = [(f, getattr(thing, f)) for f in thing.__struct_fields__]
    else:
        return {}
    return {way: array for key, part in parts for way, array in arrays(part, f"{name}.{key}").items()}


@pytest.mark.parametrize("mode", [Mode.ALLOCATE, Mode.OVERRIDE])
def test_no_array_that_leaves_a_step_can_be_written_to_or_changes_afterwards(mode: Mode) -> None:
    """Through takeover, a failure in flight, and a lift."""
    companion, kept, ways = Stepped(mode=mode), [], set[str]()
    outputs = [companion.step(None, Orders(adopt=(6,)))]
    for k, sample in enumerate(recorded("single", 620)):
        outputs.append(companion.step(sample, Orders(lift=(6,)) if k == 100 else NO_ORDERS))
        found = arrays(outputs[-1], "output") | {"output.believed": outputs[-1].believed}
        kept.append((found, {way: array.copy() for way, array in found.items()}))
    outputs.append(companion.step(None, Orders(lift=(3,))))
    assert np.flatnonzero(outputs[-2].failed).tolist() == [2]
    for found, copied in kept:
        for way, array in found.items():
            ways.add(way)
            assert not array.flags.writeable, way
            np.testing.assert_array_equal(array, copied[way], err_msg=way)
    assert {"output.plan.matrix", "output.estimate.effectiveness", "output.unallocated", "output.failed"} <= ways
    assert ("output.override" in ways) == (mode == Mode.OVERRIDE)
