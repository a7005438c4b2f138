"""``nff why``: which motor failed in this log, of any multirotor, without an airframe file."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.airframe_file import LogTable
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError, LogError, NotJudged
from nff_companion.replay import run
from nff_companion.replay.airframe_of_log import Made, made_of
from nff_companion.replay.document import document
from nff_companion.replay.flight import LogFlight
from nff_companion.replay.judge import Judgement, judge
from nff_companion.replay.page.page import page
from nff_companion.replay.thinning import thinned
from nff_companion.replay.trace import Trace

SUFFIXES = (".ulg", ".ulog", ".bin", ".tlog")


@dataclass(frozen=True)
class Question:
    """``frame``: of the catalogue, empty: the log says it. ``airframe``: a file instead of what is made of the log.
    ``outputs``: where a ULog keeps the motors' commands, None: it is found."""

    frame: str = ""
    airframe: str = ""
    outputs: LogTable | None = None
    pages: bool = False
    tuning: Tuning | None = None


@dataclass(frozen=True)
class Answer:
    """Of one file: a document for each flight and, where asked for, a page. ``error``: the file is no log."""

    path: Path
    documents: list[dict[str, Any]] = field(default_factory=list)
    pages: list[str] = field(default_factory=list)
    error: str = ""


def logs_in(paths: list[Path]) -> list[Path]:
    """The files, and of folders the logs in them, sorted; each once. A folder without any stands for itself."""
    out: dict[Path, None] = {}
    for path in paths:
        inside = path.rglob("*") if os.path.isdir(path) else ()  # unlike Path.is_dir it raises nothing
        found = sorted(p for p in inside if p.suffix.lower() in SUFFIXES and not os.path.isdir(p))
        out |= dict.fromkeys(found or [path])
    return list(out)


def outputs_of(text: str) -> LogTable:
    """``TOPIC:FIELD:UNIT``, FIELD with {} for the motor's index. Raises ConfigError."""
    try:
        topic, field, unit = text.rsplit(":", 2)
        table = msgspec.convert({"topic": topic, "field": field, "unit": unit}, LogTable)
    except ValueError:  # of msgspec too
        table = None
    if table is None or not table.topic or table.field.count("{}") != 1:
        raise ConfigError(
            f"--outputs {text!r}: give TOPIC:FIELD:UNIT, FIELD with {{}} for the motor's index from 0, UNIT N, output"
            " or pwm, as unknown_logger:tdes[{}]:N"
        )
    return table


def answer(path: Path, question: Question) -> Answer:
    """Of one file. Nothing but what is wrong with the question is raised (ConfigError)."""
    with _uncollected():
        if os.path.isdir(path):
            return Answer(path, error=f"{path}: no log ({', '.join(SUFFIXES)}) is in this folder")
        try:
            found = run.flights(path)
        except LogError as error:
            return Answer(path, error=str(error))
        documents, pages = [], []
        for flight in found:
            said, html = _of_flight(flight, question)
            documents.append(said)
            pages += [html] if question.pages else []
        return Answer(path, documents, pages)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Looking for cycles among the objects of a whole log, of which there are none, costs a fifth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _of_flight(flight: LogFlight, question: Question) -> tuple[dict[str, Any], str]:
    made: Made | None = None
    trace, duration_s = None, 0.0
    try:
        made = _made(flight, question)
        found = made.samples
    except NotJudged as error:
        judgement = Judgement("not_judged", str(error), 0.0, 0, None, [])
    else:
        rows = found.rows
        fitted = flight.fit(made.vehicle)
        trace = Trace(fitted) if question.pages else None
        rate_hz = run.rate_of_rows(rows)
        duration_s = rows[-1][0] - flight.first_s
        judgement = judge(
            fitted, rows, rate_hz, flight.first_s, found.outputs, found.outputs_hz, question.tuning, trace
        )
    said = document(flight, judgement, duration_s)
    said["airframe"] = None if made is None else _airframe(made, question)
    vehicle = None if made is None else made.vehicle
    return said, page(said, vehicle, None if trace is None else trace.course()) if question.pages else ""


def _made(flight: LogFlight, question: Question) -> Made:
    """Raises NotJudged; ConfigError for an airframe file or a frame's name that cannot be used."""
    if not question.airframe:
        return made_of(flight, question.frame or None, question.outputs)
    vehicle = vehicle_model.load(question.airframe)
    found = run.reading(flight, vehicle)
    return Made(vehicle, [f"airframe {vehicle.name}, as given"], replace(found, rows=thinned(found.rows)))


def _airframe(made: Made, question: Question) -> dict[str, Any]:
    vehicle: Vehicle = made.vehicle
    return {
        "name": vehicle.name,
        "made_of": "file" if question.airframe else "log",
        "motors": vehicle.motors,
        "arm_m": round(float(np.hypot(*vehicle.position_m.T).max()), 4),
        "mass_kg": round(vehicle.mass_kg, 4),
        "inertia_kg_m2": [float(f"{value:.4g}") for value in vehicle.inertia_kg_m2],
        "max_thrust_n": round(vehicle.motor.max_thrust_n, 4),
        "torque_per_thrust_m": round(vehicle.motor.torque_per_thrust_m, 5),
        "time_constant_s": round(vehicle.motor.time_constant_up_s, 4),
        "hover": round(vehicle.hover, 4),
        "how": list(made.notes),
    }
