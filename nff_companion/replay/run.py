"""``nff replay``: what the companion would have said in this flight."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.companion import Companion
from nff_companion.condition import Condition, Mode
from nff_companion.core import basis_network
from nff_companion.core.decision import Event
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import LogError
from nff_companion.replay import dataflash, tlog, ulog

_SETTLE_S = 0.3  # the effectiveness reported is that of so long after the declaration
_SAMPLES_MIN = 100
_RATES_HZ = (25.0, 1000.0)


def read(path: Path, vehicle: Vehicle) -> tuple[float, list[tuple[float, Sample]]]:
    """(time of the first record, [(time of arrival, sample)]). Raises LogError."""
    if not path.is_file():
        raise LogError(f"{path} is not a file")
    suffix = path.suffix.lower()
    if suffix in (".ulg", ".ulog"):
        rows = list(ulog.samples(path, vehicle))
        first = rows[0][0] if rows else 0.0
    elif suffix == ".bin":
        rows = list(dataflash.samples(path, vehicle))
        first = rows[0][0] if rows else 0.0
    elif suffix == ".tlog":
        rows = list(tlog.samples(path, vehicle))
        first = tlog.first_stamp(path)
    else:
        raise LogError(f"{path}: suffix {suffix!r} is unknown; .ulg, .bin and .tlog can be read")
    if len(rows) < _SAMPLES_MIN:
        raise LogError(
            f"{path} has {len(rows)} inertial samples; {_SAMPLES_MIN} are needed (HIGHRES_IMU, sensor_combined)"
        )
    return first, rows


def rate_of(samples: Iterable[Sample]) -> float:
    """Rate in Hz at which a live link would have been configured."""
    gaps = np.diff([s.time_s for s in samples])
    rate = 1.0 / float(np.median(gaps[gaps > 0.0]))
    return float(np.clip(rate, *_RATES_HZ))


def replay(path: Path, vehicle: Vehicle, tuning: Tuning | None = None) -> dict[str, Any]:
    """Faults found in one log; ``time_s`` from its first record. Raises LogError."""
    first, rows = read(path, vehicle)
    network = basis_network.for_vehicle(vehicle, "airframe")
    companion = Companion(vehicle, rate_of(sample for _, sample in rows), tuning, network=network)
    state, nobody = companion.start(Mode.OBSERVE), Condition()
    faults: list[dict[str, Any]] = []
    settling: list[tuple[float, Event, dict[str, Any]]] = []
    for stamp, sample in rows:
        state, output = companion.step(state, sample, nobody)
        for event in output.events:
            if event.declared:
                fault = {
                    "motor": event.motor,
                    "time_s": round(stamp - first, 4),
                    "effectiveness": round(event.effectiveness, 3),
                    "confidence": round(event.confidence, 4),
                }
                faults.append(fault)
                settling.append((sample.time_s + _SETTLE_S, event, fault))
        while settling and sample.time_s >= settling[0][0]:
            _, event, fault = settling.pop(0)
            if output.flying:
                fault["effectiveness"] = round(min(float(output.effectiveness[event.motor - 1]), 1.0), 3)
    return {
        "file": str(path),
        "duration_s": round(rows[-1][0] - first, 3),
        "samples": len(rows),
        "bad_samples": state.bad_samples,
        "faults": faults,
    }
