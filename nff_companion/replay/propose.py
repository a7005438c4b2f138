"""``python -m nff_companion.replay.propose DESCRIPTOR``: the airframe file that the daemon's own flights ask for.

Started by the daemon after a landing, which hands over an open file of what was flown (calibration/handover.py). It is
``nff calibrate`` on these samples, in a process of its own that yields to everything else; one line of JSON on standard
output says what came of it.
"""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path

import msgspec
import numpy as np

from nff_companion.calibration import airframe
from nff_companion.calibration.differences import differences
from nff_companion.calibration.handover import Flown, Outcome, unpacked
from nff_companion.calibration.recorder import samples
from nff_companion.core import vehicle as vehicles
from nff_companion.core.airframe_file import AirframeFile
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import DEFAULT
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import LogError, NffError, NotJudged
from nff_companion.replay import calibrate
from nff_companion.replay.calibrate import Calibration, OtherOrder, TooShort
from nff_companion.replay.flight import LogFlight, Reading
from nff_companion.replay.parameters import Parameters
from nff_companion.state_file import StateFile

_KINDLY = 19  # nice value
_FIRST_KILLED = b"1000"  # oom_score_adj: raised, which anybody may
_ORDINARY = "fly a minute with stops and starts to all sides, climbs, and turns to both sides"


def proposed(flown: Flown, rows: list[Sample]) -> Outcome:
    """The outcome; where it is ``proposed`` the file has been written."""
    name = Path(flown.target).stem
    try:
        text, vehicle = _file_flown(flown)
        flight = _flight(flown, rows)
        other = ""
        try:
            found = calibrate.of_flights([flight], text, vehicle, name)
        except OtherOrder as error:
            other, text = error.order.text, airframe.reordered(text, error.order)
            corrected = Vehicle(msgspec.convert(tomllib.loads(text), AirframeFile))
            found = calibrate.of_flights([flight], text, corrected, name)
        return _outcome(flown, vehicle, found, other)
    except TooShort as error:
        return Outcome(outcome="missing", text=f"no proposal: {error}; {_ORDINARY}", missing=[_ORDINARY])
    except NotJudged as error:
        return Outcome(outcome="refused", text=f"no proposal: {error}")
    except MemoryError:
        return Outcome(outcome="failed", text="no proposal: not enough memory; lower tuning.proposal.memory_s")
    except (NffError, msgspec.ValidationError, OSError) as error:
        return Outcome(outcome="failed", text=f"no proposal: {error}")


def _outcome(flown: Flown, vehicle: Vehicle, found: Calibration, other: str) -> Outcome:
    made = Vehicle(msgspec.convert(tomllib.loads(found.text), AirframeFile))
    differs = [(f"{other}?", f"{other}, as the motion shows")] if other else []
    differs += differences(vehicle, made, found.fit, DEFAULT.fit)
    missing = [verdict.advice for verdict in found.verdicts if not verdict.enough]
    missing = list(dict.fromkeys(missing))
    said = "; ".join(sentence for _, sentence in differs)
    if missing:
        text = f"no proposal: {'; '.join(missing)}" + (f" (so far: {said})" if said else "")
        return Outcome(outcome="missing", text=text, differs=differs, missing=missing, flown_s=found.flown_s)
    if not differs:
        return Outcome(outcome="agrees", text="the flights agree with the airframe file", flown_s=found.flown_s)
    target = Path(flown.target)
    if target.exists() and target.samefile(vehicles.path_of(flown.airframe)):
        text = f"{target} is the airframe file that is flown: copy it elsewhere and fly the copy; {said}"
        return Outcome(outcome="failed", text=f"no proposal: {text}", differs=differs, flown_s=found.flown_s)
    text = airframe.unconfirmed(found.text) if other else found.text
    StateFile(target, "proposed airframe file").write(text.encode())
    text = f"{target} is proposed: {said}"
    return Outcome(outcome="proposed", text=text, differs=differs, file=str(target), flown_s=found.flown_s)


def _file_flown(flown: Flown) -> tuple[str, Vehicle]:
    """Text of the file with which it was flown, and its vehicle. Raises ConfigError, OSError."""
    text = vehicles.path_of(flown.airframe).read_text(encoding="utf-8")
    return text, vehicles.load(flown.airframe, thrust_to_weight=flown.thrust_to_weight)


def _flight(flown: Flown, rows: list[Sample]) -> LogFlight:
    """The flights as a reader of logs would hand them over. Raises TooShort."""
    if len(rows) < 2:
        raise TooShort("0 s of flight of a whole vehicle")
    told = Parameters()
    for key, value in flown.told.items():
        told.put(rows[0].time_s, key, value)
    telemetry = TelemetryTable(flown.gyro_filter_hz, flown.accelerometer_filter_hz)
    reading = Reading([(sample.time_s, sample) for sample in rows], "motor outputs", _outputs_hz(rows))
    return LogFlight(
        path=Path("the last flights"),
        autopilot="",
        system=None,
        parameters=told,
        frame=None,
        first_s=rows[0].time_s,
        take_off_s=rows[0].time_s,
        read=lambda _: reading,
        fit=lambda vehicle: vehicle.with_telemetry(telemetry),
    )


def _outputs_hz(rows: list[Sample]) -> float:
    """At which the outputs were new; between two of them the decoder holds the last."""
    new = np.flatnonzero((np.diff([sample.output for sample in rows], axis=0) != 0.0).any(axis=1))
    gaps = np.diff(np.array([sample.time_s for sample in rows])[new])
    gaps = gaps[gaps > 0.0]
    return 1.0 / float(np.median(gaps)) if len(gaps) else 0.0


def yield_to_all() -> None:
    """This process runs when nothing else wants to, and is the first to go when memory is short."""
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # the daemon's is SCHED_FIFO
    os.nice(_KINDLY)
    with open("/proc/self/oom_score_adj", "wb") as file:
        file.write(_FIRST_KILLED)


def main() -> None:
    """The process."""
    yield_to_all()
    with os.fdopen(int(sys.argv[1]), "rb") as file:
        file.seek(0)
        data = file.read()
    try:
        flown, time_s, values = unpacked(data)
        outcome = proposed(flown, samples(time_s, values))
    except LogError as error:
        outcome = Outcome(outcome="failed", text=f"no proposal: {error}")
    sys.stdout.write(msgspec.json.encode(outcome).decode() + "\n")


if __name__ == "__main__":
    main()
