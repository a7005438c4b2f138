"""After a landing: does what was flown ask for a better airframe file?

The daemon's loop keeps samples in flight (calibration/recorder.py). When a flight has ended, a process of its own
(replay/propose.py) calibrates from them; it writes ``proposed-NAME.toml`` into the state folder and says what differs.
The loop starts it on the ground, looks whether it has ended, and ends it when the vehicle is armed again. No file is
ever replaced but an older proposal: to fly with one is the owner's decision.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from nff_companion.calibration.handover import Flown, Outcome, packed
from nff_companion.calibration.recorder import FlightRecorder
from nff_companion.condition import Reason, Statement
from nff_companion.core.vehicle import Vehicle
from nff_companion.session import Session

log = logging.getLogger("nff")

_COMMAND = [sys.executable, "-m", "nff_companion.replay.propose"]
_LOOK_S = 0.5  # between two looks
_ANSWER_MAX = 65536  # bytes: as much as a pipe holds, so that the process never waits for us
_FAREWELL_S = 1.0
_LOST = 1000  # letters of what a process that failed had to say
# Parameters that an adapter compares with the file before it flies: the thrust curve is known where they were.
_COMPARED = {
    "ardupilot": {"MOT_THST_EXPO": "thrust_expo", "MOT_SPIN_MIN": "spin_min"},
    "px4": {"THR_MDL_FAC": "thrust_expo"},
}


@dataclass(frozen=True)
class Source:
    """With which file is flown, and the folder that proposals go to."""

    airframe: str
    thrust_to_weight: float | None
    folder: Path


class Proposer:
    """``turn`` it beside the loop."""

    def __init__(self, source: Source, recorder: FlightRecorder, patience_s: float) -> None:
        self._source, self._recorder, self._patience_s = source, recorder, patience_s
        self._process: subprocess.Popen[bytes] | None = None
        self._dying: subprocess.Popen[bytes] | None = None  # killed, and not gone yet
        self._started_s = self._next_look_s = -float("inf")
        self._flights = 0  # that were calibrated from
        self._outcome: Outcome | None = None
        self._trouble = ""

    def turn(self, session: Session, now_s: float) -> Statement | None:
        """Start, look after and end the process; what the pilot should hear, once."""
        if now_s < self._next_look_s:
            return None
        self._next_look_s = now_s + _LOOK_S
        armed = session.moment().condition.armed is not False
        if self._process is not None:
            if armed:
                self._given_up("armed again: a proposal is made after the next landing")
                return None
            return self._looked_after(now_s)
        if self._dying is not None and self._dying.poll() is not None:
            self._dying = None
        if self._dying is None and self._recorder.flights != self._flights and not armed:
            self._start(session, now_s)
        return None

    def close(self) -> None:
        """End what still runs."""
        if self._process is not None:
            self._given_up("the daemon has ended")
        if self._dying is not None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._dying.wait(_FAREWELL_S)

    def document(self) -> dict[str, Any]:
        """For the monitor."""
        recorder, outcome = self._recorder, self._outcome
        state = "calibrating" if self._process is not None else "waiting" if outcome is None else outcome.outcome
        text = "calibrating from the last flights" if self._process is not None else self._trouble
        if not text:
            text = "after a landing" if outcome is None else outcome.text
        return {
            "state": state,
            "text": text,
            "file": "" if outcome is None else outcome.file,
            "differs": [] if outcome is None else [sentence for _, sentence in outcome.differs],
            "missing": [] if outcome is None else outcome.missing,
            "samples_kept": recorder.samples,
            "megabytes_max": round(1e-6 * recorder.bytes_max, 1),
        }

    # -- the process --------------------------------------------------------------------------------------------

    def _start(self, session: Session, now_s: float) -> None:
        """Hand over what was flown: a file without a name in memory, which the process inherits."""
        self._flights, self._started_s, self._trouble = self._recorder.flights, now_s, ""
        vehicle, adapter = session.companion.vehicle, session.adapter
        time_s, values = self._recorder.taken()
        flown = Flown(
            airframe=self._source.airframe,
            target=str(self._source.folder / f"proposed-{file_name(vehicle.name)}.toml"),
            motors=vehicle.motors,
            samples=len(time_s),
            thrust_to_weight=self._source.thrust_to_weight,
            gyro_filter_hz=vehicle.telemetry.gyro_filter_hz,
            accelerometer_filter_hz=vehicle.telemetry.accelerometer_filter_hz,
            told=_told(vehicle, "" if adapter is None else adapter.name),
        )
        try:
            descriptor = os.memfd_create("nff-flown")
            try:
                _write(descriptor, packed(flown, time_s, values))
                self._process = subprocess.Popen(
                    [*_COMMAND, str(descriptor)],
                    pass_fds=(descriptor,),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NOTIFY_SOCKET": ""},
                )
            finally:
                os.close(descriptor)
        except OSError as error:
            self._failed(f"calibration cannot be started: {error.strerror}")
            return
        log.info("landed: calibrating from %d samples in process %d", len(time_s), self._process.pid)

    def _looked_after(self, now_s: float) -> Statement | None:
        process = self._process
        assert process is not None
        if process.poll() is None:
            if now_s - self._started_s > self._patience_s:
                self._given_up(f"calibration has not ended in {self._patience_s:.0f} s")
            return None
        self._process = None
        answer, said = _ended(process)
        try:
            self._outcome = msgspec.json.decode(answer, type=Outcome)
        except (msgspec.ValidationError, msgspec.DecodeError):
            last = said.decode("utf-8", "replace").strip()[-_LOST:]
            self._failed(f"calibration ended with code {process.returncode}: {last or 'it said nothing'}")
            return None
        return self._told_of(self._outcome)

    def _told_of(self, outcome: Outcome) -> Statement | None:
        level = logging.WARNING if outcome.outcome in ("proposed", "failed") else logging.INFO
        log.log(level, "airframe file: %s", outcome.text)
        if outcome.outcome != "proposed":
            return None
        return Statement(Reason.FILE_PROPOSED, outcome.differs[0][0])

    def _given_up(self, why: str) -> None:
        process, self._process, self._dying = self._process, None, self._process
        assert process is not None
        process.kill()  # nobody waits for it here: a disk may hold it up
        for pipe in (process.stdout, process.stderr):
            assert pipe is not None
            pipe.close()
        self._failed(why)

    def _failed(self, why: str) -> None:
        self._trouble = f"no proposal: {why}"
        self._outcome = Outcome(outcome="failed", text=self._trouble)
        log.warning("airframe file: %s", self._trouble)


def _ended(process: subprocess.Popen[bytes]) -> tuple[bytes, bytes]:
    """What it wrote to standard output and error; the pipes are closed."""
    assert process.stdout is not None
    assert process.stderr is not None
    with process.stdout, process.stderr:
        return process.stdout.read(_ANSWER_MAX), process.stderr.read(_ANSWER_MAX)


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


def file_name(name: str) -> str:
    """An airframe's name as part of a file's."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)[:60]


def _told(vehicle: Vehicle, adapter: str) -> dict[str, float]:
    command = vehicle.command
    return {name: float(getattr(command, key)) for name, key in _COMPARED.get(adapter, {}).items()}
