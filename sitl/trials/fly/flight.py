"""What flights on any firmware have in common: the binary, the companion beside a test, a document of both flights."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nff_companion.errors import ConfigError
from sitl.trials.fly.companion_state import CompanionState
from sitl.trials.fly.pilot import FlightError, Pilot
from sitl.trials.machine import RATE_RATIO, Figures, judge
from sitl.trials.process import DaemonProcess, keep_files

CONFIG, LOG, SOCKET = "companion.toml", "companion.log", "s"  # in the flight's folder
_READY_S = 40.0
_ASK_S = 0.3


class SlowMachineError(FlightError):
    """The machine was too slow to begin; ``machine`` is that part of the document."""

    def __init__(self, message: str, machine: dict[str, Any]) -> None:
        super().__init__(message)
        self.machine = machine


def binary_from(path: Path | None, environment: str, option: str) -> Path:
    """A firmware's binary from an option or the environment. Raises ConfigError when there is none."""
    text = str(path) if path is not None else os.environ.get(environment, "")
    if not text:
        raise ConfigError(f"give the {option.lstrip('-')} SITL binary by {option} PATH or {environment}=PATH")
    found = Path(text).resolve()
    if not os.access(found, os.X_OK):
        raise ConfigError(f"{found} is not an executable file")
    return found


@dataclass(slots=True)
class Beside:
    """The daemon beside a flight, and what it says of itself."""

    daemon: DaemonProcess
    state: CompanionState
    rate_hz: float  # of telemetry, asked for

    def test(
        self, fly: Callable[[], dict[str, Any]], clock: Callable[[], float], *, expected: bool
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """The summary that ``fly()`` returns, with the daemon's ``status``; and whether the machine kept up.

        ``clock``: the vehicle's, in s. ``expected``: the companion should act. Raises FlightError.
        """
        self.state.begin()
        began, wall = clock(), time.monotonic()
        summary = fly()
        flown_s, wall_s = clock() - began, time.monotonic() - wall
        status = summary["status"] = self.state.document()
        if self.daemon.process.poll() is not None:
            raise FlightError(f"the companion ended with code {self.daemon.process.returncode}")
        autopilot = status.get("autopilot") or {}
        figures = Figures(
            flown_s=flown_s,
            wall_s=wall_s,
            asked_hz=self.rate_hz,
            rate_hz=self.state.mean_rate_hz,
            commands_sent=status.get("counters", {}).get("commands_sent", 0),
            stale=autopilot.get("refused", {}).get("stale", 0),
            expected=expected,
            acted=autopilot.get("allocation", "stock") != "stock" or bool(autopilot.get("failed")),
        )
        return summary, judge(figures)


@contextmanager
def companion(pilot: Pilot, folder: Path, text: str, *, rate_hz: float, ready_s: float = _READY_S) -> Iterator[Beside]:
    """The daemon with configuration ``text``, asking for ``rate_hz``, ready. Raises FlightError, SlowMachineError."""
    config = folder / CONFIG
    config.write_text(text, encoding="utf-8")
    with DaemonProcess(config, folder / LOG) as daemon:
        beside = Beside(daemon, CompanionState(folder / SOCKET), rate_hz)
        _await_ready(beside, pilot, ready_s)
        yield beside


def _await_ready(beside: Beside, pilot: Pilot, ready_s: float) -> None:
    state, process = beside.state, beside.daemon.process

    def ended() -> bool:
        return process.poll() is not None

    try:
        pilot.wait(lambda: state.ready() or ended(), ready_s, "the companion to be ready", state.refresh, _ASK_S)
    except FlightError as error:
        rate_hz = state.mean_rate_hz
        # Telemetry that does not come at all is no matter of speed.
        if not rate_hz or rate_hz >= RATE_RATIO * beside.rate_hz:
            raise FlightError(f"{error}; the companion says: {state.text}") from error
        rates = f"telemetry came at {rate_hz:.0f} of {beside.rate_hz:.0f} Hz"
        reason = f"the companion was not ready within {ready_s:.0f} s: {rates}"
        machine = {"too_slow": True, "reason": reason, "asked_hz": beside.rate_hz, "rate_hz": round(rate_hz, 1)}
        raise SlowMachineError(reason, machine) from error
    if ended():
        raise FlightError(f"the companion ended with code {process.returncode} before the flight: see {LOG}")


def both(
    options: dict[str, Any],
    fly: Callable[[bool, Path], dict[str, Any]],
    *,
    baseline: bool,
    keep: Path | None,
) -> dict[str, Any]:
    """The flight without and with the companion; the document that ``nff fly`` prints.

    ``fly(with_companion, folder)`` returns a summary, with ``machine`` in it when the companion flew. ``keep``: a
    folder for what each flight leaves behind.
    """
    document: dict[str, Any] = {"options": options}
    for name, with_companion in (("baseline", False), ("companion", True)):
        if not with_companion and not baseline:
            continue
        with tempfile.TemporaryDirectory(prefix="nff-fly-") as folder:
            try:
                document[name] = fly(with_companion, Path(folder))
            except SlowMachineError as error:
                return {**document, "error": str(error), "machine": error.machine}
            finally:
                if keep is not None:
                    keep_files(Path(folder), keep / name)
    document["machine"] = document["companion"].pop("machine")
    return document
