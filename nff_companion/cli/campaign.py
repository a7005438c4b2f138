"""``nff campaign``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nff_companion.cli.output import console, print_json, say, say_error
from nff_companion.errors import ConfigError


def campaign(
    file: Annotated[Path, typer.Argument(help="What to fly (docs/campaigns.md).")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the flights, taken up where it was left; else beside the file.")
    ] = None,
    scheduler: Annotated[str, typer.Option(help="Address of a Dask scheduler; empty: this machine.")] = "",
    workers: Annotated[int, typer.Option(min=0, help="Processes on this machine; 0: one a core.")] = 0,
    flight: Annotated[int, typer.Option(help="Fly this one alone, print its row, keep nothing.")] = -1,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")] = False,
) -> None:
    """Fly a campaign of failures in virtual time. Exit code 0: flown, 1: some flights could not be flown."""
    from sitl.trials.campaign import page, summary
    from sitl.trials.campaign.fly import fly
    from sitl.trials.campaign.run import run
    from sitl.trials.campaign.scenario import batches, read
    from sitl.trials.campaign.store import Store

    scenario = read(file)
    if flight >= 0:
        if flight >= scenario.flights:
            raise ConfigError(f"--flight {flight}: {file} has flights 0 to {scenario.flights - 1}")
        print_json(fly(scenario, (flight,))[0])
        return
    folder = out or file.with_suffix("")
    store = Store(folder, scenario)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(scenario.name, total=scenario.flights)
        troubles = run(
            scenario,
            store,
            scheduler=scheduler,
            workers=workers,
            progress=lambda done, _: bar.update(task, completed=done),
        )
    rows = store.rows(batches(scenario))
    document = summary.document(rows)
    page.write(folder / "index.html", scenario, document, rows)
    if json:
        print_json(document)
    else:
        _print(document, page.line)
        say(f"{len(rows)} flights in {folder}: flights.parquet, index.html")
    for trouble in troubles:
        say_error(trouble)
    if troubles:
        raise typer.Exit(1)


def _print(document: dict[str, Any], line: Any) -> None:
    for row in document["exceptions"]:
        say(line(row))
    for key, table in document["tables"].items():
        for name, counts in table.items():
            say(f"{key} {name}: {_counts(counts)}")
    say(f"all: {_counts(document['whole'])}")


def _counts(counts: dict[str, Any]) -> str:
    return ", ".join(f"{name} {value}" for name, value in counts.items() if value is not None)
