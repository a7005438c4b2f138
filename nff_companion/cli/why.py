"""``nff why``."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nff_companion.cli.output import console, print_json, say, say_error
from nff_companion.errors import ConfigError

if TYPE_CHECKING:
    from nff_companion.replay.why import Answer, Question


def why(
    logs: Annotated[
        list[Path], typer.Argument(help="ULog (.ulg), ArduPilot (.bin) or MAVLink (.tlog) logs, and folders of them.")
    ],
    frame: Annotated[str, typer.Option(help="Frame by name, where the log does not say it: `nff airframe list`.")] = "",
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file, instead of one made of the log.")] = "",
    outputs: Annotated[
        str, typer.Option(help="Where a ULog keeps the motors' commands, TOPIC:FIELD:UNIT, when nowhere usual.")
    ] = "",
    page: Annotated[Path | None, typer.Option(help="Folder for an HTML page of each flight.")] = None,
    jobs: Annotated[int, typer.Option(min=0, help="Processes; 0: one a core.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")] = False,
) -> None:
    """Which motor failed in this log? Of any multirotor, without an airframe file.

    Exit code 0: no fault, 1: a fault, 2: a log could not be judged.
    """
    from nff_companion.frames import catalogue
    from nff_companion.replay.document import line
    from nff_companion.replay.why import Question, logs_in, outputs_of

    if airframe and (frame or outputs):
        raise ConfigError(f"--airframe {airframe}: the file says frame and outputs; leave --frame and --outputs out")
    if frame:
        catalogue.by_name(frame)
    if page is not None:
        _make_folder(page)
    question = Question(frame, airframe, outputs_of(outputs) if outputs else None, page is not None)
    flights, wrong, names = [], False, set[str]()
    for answer in _answers(logs_in(logs), question, jobs or os.cpu_count() or 1):
        if answer.error:
            wrong = True
            say_error(answer.error)
        for number, flight in enumerate(answer.documents):
            for note in flight["notes"]:
                say(f"{answer.path}: {note}")
            if not json or flight["verdict"] == "not_judged":
                say(line(flight))
            if page is not None:
                written = _write(page, answer.path, flight["system"], answer.pages[number], names)
                say(f"page: {written}")
        flights += answer.documents
    if json:
        print_json({"flights": flights})
    if wrong or any(flight["verdict"] == "not_judged" for flight in flights):
        raise typer.Exit(2)
    raise typer.Exit(int(any(flight["verdict"] == "fault" for flight in flights)))


def _answers(paths: list[Path], question: Question, jobs: int) -> Iterator[Answer]:
    """In the order of ``paths``, with a bar on standard error while they come."""
    from rich.progress import Progress

    from nff_companion.replay.why import Answer, answer

    with Progress(console=console, transient=True, disable=len(paths) < 2) as bar:
        task = bar.add_task("logs", total=len(paths))
        if min(jobs, len(paths)) < 2:
            for path in paths:
                yield answer(path, question)
                bar.advance(task)
            return
        with ProcessPoolExecutor(min(jobs, len(paths)), multiprocessing.get_context("spawn")) as pool:
            for path, future in [(path, pool.submit(answer, path, question)) for path in paths]:
                try:
                    yield future.result()
                except BrokenProcessPool:
                    yield Answer(path, error=f"{path}: a process that read logs was killed (memory?): try --jobs 1")
                bar.advance(task)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--page {folder}: no such folder can be made: {error.strerror}") from error


def _write(folder: Path, log: Path, system: int | None, text: str, names: set[str]) -> Path:
    """A page under a name that no other page of this run has."""
    stem = log.name if system is None else f"{log.name}-system{system}"
    name, number = f"{stem}.html", 1
    while name in names:
        number += 1
        name = f"{stem}-{number}.html"
    names.add(name)
    path = folder / name
    try:
        path.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error
    return path
