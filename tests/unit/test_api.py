"""What others may import, and rely on."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from golden import flights

import nff_companion
from nff_companion import Companion, Condition, Mode, load_vehicle


def test_everything_that_is_promised_is_there() -> None:
    for name in nff_companion.__all__:
        assert getattr(nff_companion, name) is not None
    with pytest.raises(AttributeError, match="choose one of"):
        _ = nff_companion.nonsense


def test_a_flight_in_five_lines_names_the_motor() -> None:
    samples = flights.unpack(flights.load("single")[0])
    companion = Companion(load_vehicle("octo-x"), rate_hz=200.0)
    state = companion.start(Mode.OBSERVE)
    for sample in samples:
        state, output = companion.step(state, sample, Condition())
    assert np.flatnonzero(output.failed).tolist() == [2]


def test_the_package_alone_loads_nothing() -> None:
    code = "import sys, nff_companion; print([m for m in ('numpy', 'highspy', 'pymavlink') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_types_are_shipped() -> None:
    assert (Path(nff_companion.__file__).parent / "py.typed").is_file()
