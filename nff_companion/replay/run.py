"""``nff replay``: what the companion would have said in this flight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError, NotJudged
from nff_companion.replay import dataflash, tlog, ulog
from nff_companion.replay.document import document
from nff_companion.replay.flight import LogFlight, Reading, Row
from nff_companion.replay.judge import Judgement, judge
from nff_companion.replay.table import Table

_SAMPLES_MIN = 100
_RATES_HZ = (25.0, 1000.0)
_RATE_MIN_HZ = 20.0
_READERS = {".ulg": ulog.flights, ".ulog": ulog.flights, ".bin": dataflash.flights, ".tlog": tlog.flights}


def flights(path: Path) -> list[LogFlight]:
    """The flights of a log, one of each vehicle that is in it, before an airframe is chosen. Raises LogError."""
    try:
        is_file = path.is_file()
    except OSError as error:  # a name too long, a folder that may not be entered
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    if not is_file:
        raise LogError(f"{path} is not a file")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise LogError(f"{path}: suffix {path.suffix!r} is unknown; .ulg, .bin and .tlog can be read")
    return reader(path)


def reading(flight: LogFlight, vehicle: Vehicle) -> Reading:
    """The samples of a flight for an airframe. Raises NotJudged where they are too few."""
    return checked(flight.read(vehicle))


def checked(found: Reading) -> Reading:
    """The same. Raises NotJudged where the samples are too few."""
    if len(found.rows) >= 2:
        rate_hz = _rate(found.rows)
        if rate_hz < _RATE_MIN_HZ:
            raise NotJudged(f"inertial samples at {rate_hz:.0f} Hz: {_RATE_MIN_HZ:.0f} Hz or more are needed")
    if len(found.rows) < _SAMPLES_MIN:
        raise NotJudged(
            f"{len(found.rows)} inertial samples; {_SAMPLES_MIN} are needed (HIGHRES_IMU, sensor_combined, IMU)"
        )
    return found


def read(path: Path, vehicle: Vehicle) -> tuple[float, list[tuple[float, Sample]]]:
    """(time of the first record, [(time of arrival, sample)]) of a log with one flight. Raises LogError."""
    flight = _only(path)
    try:
        return flight.first_s, list(reading(flight, vehicle).rows)
    except NotJudged as error:
        raise NotJudged(f"{path}: {error}") from error


def rate_of(samples: Iterable[Sample]) -> float:
    """Rate in Hz at which a live link would have been configured."""
    return rate_of_rows([(sample.time_s, sample) for sample in samples])


def replay(path: Path, vehicle: Vehicle, tuning: Tuning | None = None) -> dict[str, Any]:
    """The document of the one flight in a log; ``time_s`` from its first record. Raises LogError."""
    return _judged(_only(path), vehicle, tuning)


def replay_all(path: Path, vehicle: Vehicle, tuning: Tuning | None = None) -> list[dict[str, Any]]:
    """The document of each flight in a log. Raises LogError where it cannot be read."""
    return [_judged(flight, vehicle, tuning) for flight in flights(path)]


def rate_of_rows(rows: Sequence[Row]) -> float:
    """The same of rows."""
    return float(np.clip(_rate(rows), *_RATES_HZ))


def _rate(rows: Sequence[Row]) -> float:
    gaps = np.diff(rows.time_s if isinstance(rows, Table) else [sample.time_s for _, sample in rows])
    gaps = gaps[gaps > 0.0]
    return 1.0 / float(np.median(gaps)) if len(gaps) else 0.0


def _only(path: Path) -> LogFlight:
    found = flights(path)
    if len(found) > 1:
        raise LogError(f"{path} has {len(found)} vehicles (systems {', '.join(str(f.system) for f in found)})")
    return found[0]


def _judged(flight: LogFlight, vehicle: Vehicle, tuning: Tuning | None) -> dict[str, Any]:
    try:
        found = reading(flight, vehicle)
    except NotJudged as error:
        return document(flight, Judgement("not_judged", str(error), 0.0, 0, None, []), 0.0)
    rows = found.rows
    rate_hz = rate_of_rows(rows)
    fitted = flight.fit(vehicle)
    judgement = judge(fitted, rows, rate_hz, flight.first_s, found.outputs, found.outputs_hz, tuning)
    return document(flight, judgement, rows[-1][0] - flight.first_s)
