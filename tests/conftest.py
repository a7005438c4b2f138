"""Shared fixtures. Random tests take their seed from NFF_TEST_SEED or draw one, and print it."""

from __future__ import annotations

import importlib.util
import os
import random
import shutil
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it, before numpy looks

import numpy as np
import pytest

from nff_companion.autopilots.px4 import remedy_book
from nff_companion.core import vehicle

DATA = Path(__file__).parent / "data"


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    seed = int(os.environ.get("NFF_TEST_SEED", random.SystemRandom().randrange(2**31)))
    print(f"{request.node.name}: seed {seed}")
    return np.random.default_rng(seed)


@pytest.fixture(scope="session")
def octo() -> vehicle.Vehicle:
    return vehicle.load("octo-x")


@pytest.fixture
def nothing_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """What PX4's adapter computes ahead takes time and changes nothing in its tests."""
    monkeypatch.setattr(remedy_book, "sets_ahead", lambda motors: [])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for variable, what in (("NFF_ARDUCOPTER", "ArduCopter"), ("NFF_PX4", "PX4")):
        if not os.environ.get(variable):
            terminalreporter.write_line(f"{variable} is not set: NO REAL {what} WAS FLOWN (README, Real firmware)")
    if importlib.util.find_spec("torch") is None:
        terminalreporter.write_line("torch is not installed: NO NETWORK WAS TRAINED (make train-test)")
    if not (shutil.which("chromium") or shutil.which("chromium-browser")):
        terminalreporter.write_line("chromium is not installed: NO PAGE OF nff why WAS OPENED in a browser")
    if not os.environ.get("NFF_DATA"):
        terminalreporter.write_line(
            "NFF_DATA is not set: the tests on recorded flights DID NOT RUN (README, section Data)", red=True, bold=True
        )
