"""``nff train`` and ``nff score``."""

from __future__ import annotations

import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from nff_companion.cli.output import console, print_json
from nff_companion.errors import ConfigError, LogError

if TYPE_CHECKING:
    from nff_companion.core.vehicle import Vehicle
    from nff_companion.training.dataset import Condition, Dataset
    from nff_companion.training.score import Score

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]
Logs = Annotated[list[Path] | None, typer.Option("--log", help="Flight log: .ulg, .bin or .tlog; several.")]
Airframe = Annotated[str, typer.Option(help="Airframe by name or TOML file.")]
_SEGMENT_S = 60.0  # so much of a log is one condition
_HELD_OUT = 4  # every so many-th log is kept for the score; of fewer logs, every so many-th minute
_TEST_FLIGHTS = 12
_MINUTES_MIN, _CONDITIONS_MIN = 3.0, 3  # of logs, to train on and to score on


def train(
    airframe: Airframe,
    out: Annotated[Path, typer.Option(help="The network, .npz.")],
    log: Logs = None,
    simulate: Annotated[int, typer.Option(min=0, help="So many simulated flights of one minute.")] = 0,
    seed: Annotated[int, typer.Option(min=1, help="Of the training; the same seed gives the same network.")] = 1,
    iterations: Annotated[int, typer.Option(min=1, help="Steps of the training.")] = 3000,
    functions: Annotated[int, typer.Option(min=1, help="Basis functions k, at most.")] = 6,
    adversary: Annotated[float, typer.Option(min=0.0, help="Weight of the adversary; 0: none.")] = 0.02,
    workers: Annotated[int, typer.Option(min=0, help="Processes that simulate; 0: one a core.")] = 0,
    json: Json = False,
) -> None:
    """Learn the basis of an airframe from flights without failures. Interrupted, it goes on where it was."""
    from rich.progress import Progress

    # Deterministic matrix products on a GPU need it, before torch is loaded.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    from nff_companion.core import vehicle as vehicle_model
    from nff_companion.core.basis_network import check
    from nff_companion.training.daiml import Trainer, TrainingOptions
    from nff_companion.training.score import score

    if bool(log) == bool(simulate):
        raise ConfigError("give either --log FILE (several) or --simulate N")
    if out.suffix != ".npz":
        raise ConfigError(f"--out {out}: the suffix must be .npz")
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: there is no folder {out.parent}")
    began = time.monotonic()
    vehicle = vehicle_model.load(airframe)
    if log:
        known, unseen, held_out = _held_out(vehicle, log)
    else:
        from sitl.trials.training import simulate as fly

        held_out = "whole flights"
        console.print(f"flying {simulate} flights to train on and {_TEST_FLIGHTS} to score", highlight=False)
        known = fly(airframe, simulate, seed=seed - 1, workers=workers or None)
        unseen = fly(airframe, _TEST_FLIGHTS, test=True, seed=seed - 1, workers=workers or None)
    flown_s = time.monotonic() - began
    options = TrainingOptions(seed=seed, iterations=iterations, functions=functions, adversary=adversary)
    trainer = Trainer(known, options)
    with Progress(console=console) as bar:
        task = bar.add_task("training", total=iterations)
        trainer.run(
            out.with_suffix(".checkpoint"),
            out.with_suffix(".csv"),
            lambda iteration, loss: bar.update(task, completed=iteration, description=f"training, loss {loss:.4f}"),
        )
    command = shlex.join(["nff", *sys.argv[1:]])
    trained = trainer.basis({"airframe": vehicle.name, "fingerprint": vehicle.fingerprint, "command": command})
    result = score(vehicle, trained, unseen)
    trained.metadata["score"] = msgspec.to_builtins(result)
    # What was only foretold in flights that it has seen parts of is claimed of none.
    trained.metadata["held_out"] = held_out
    trained.metadata["covers"] = result.covered if held_out == "whole flights" else []
    check(trained, vehicle, str(out))  # what flight would refuse is not written
    trained.save(out)
    document: dict[str, Any] = {
        "network": str(out),
        "seconds": round(time.monotonic() - began, 1),
        "seconds_of_flights": round(flown_s, 1),
        **trained.metadata,
    }
    if json:
        print_json(document)
        return
    _print_score(result)
    if held_out != "whole flights":
        console.print(f"scored on {held_out}: give {_HELD_OUT} logs or more for a score that counts", highlight=False)
    console.print(f"{out}: {known.minutes:.0f} min of flight, {document['seconds']:.0f} s", highlight=False)


def score_command(
    airframe: Airframe,
    network: Annotated[str, typer.Option(help="airframe: what its file names; a shipped name or an .npz file.")] = (
        "airframe"
    ),
    log: Logs = None,
    simulate: Annotated[int, typer.Option(min=0, help="So many simulated flights of one minute.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated flights.")] = 2,
    json: Json = False,
) -> None:
    """One-step-ahead prediction of a network on flights that it was not trained on, beside a constant phi."""
    from nff_companion.core import vehicle as vehicle_model
    from nff_companion.core.basis_network import for_vehicle, left_out
    from nff_companion.training.dataset import Dataset
    from nff_companion.training.score import score

    if bool(log) == bool(simulate):
        raise ConfigError("give either --log FILE (several) or --simulate N")
    vehicle = vehicle_model.load(airframe)
    named = network != "airframe" or (vehicle.network != "" and not left_out(vehicle, network))
    basis = for_vehicle(vehicle, network) if named else None
    if basis is None:
        raise ConfigError(f"{airframe} names no network: give --network")
    if log:
        data = Dataset([part for flight in _flights(vehicle, log) for part in flight])
    else:
        from sitl.trials.training import simulate as fly

        data = fly(airframe, simulate, test=True, seed=seed)
    result = score(vehicle, basis, data)
    if json:
        print_json(msgspec.to_builtins(result))
        return
    _print_score(result)


def _flights(vehicle: Vehicle, logs: list[Path]) -> list[list[Condition]]:
    """The conditions of each log. Raises LogError."""
    from nff_companion.replay.run import rate_of, read
    from nff_companion.training.dataset import record, split

    flights = []
    for path in logs:
        _, rows = read(path, vehicle)
        samples = [sample for _, sample in rows]
        flights.append(split(record(vehicle, rate_of(samples), samples, path.name), _SEGMENT_S))
    return flights


def _held_out(vehicle: Vehicle, logs: list[Path]) -> tuple[Dataset, Dataset, str]:
    """Conditions to train on, conditions to score on, and what these are. Raises LogError."""
    from nff_companion.training.dataset import Dataset

    flights = _flights(vehicle, logs)
    conditions = [part for flight in flights for part in flight]
    minutes = Dataset(conditions).minutes
    if minutes < _MINUTES_MIN or len(conditions) < _CONDITIONS_MIN:
        raise LogError(
            f"the logs hold {minutes:.1f} min of usable flight in {len(conditions)} parts: at least"
            f" {_MINUTES_MIN:.0f} min in {_CONDITIONS_MIN} parts are needed"
        )
    if len(flights) >= _HELD_OUT:
        unseen = [part for flight in flights[_HELD_OUT - 1 :: _HELD_OUT] for part in flight]
    else:
        unseen = conditions[_HELD_OUT - 1 :: _HELD_OUT] or conditions[-1:]
    known = [c for c in conditions if not any(c is other for other in unseen)]
    kept = "whole flights" if len(flights) >= _HELD_OUT else "other minutes of the same flights"
    return Dataset(known), Dataset(unseen), kept


def _print_score(result: Score) -> None:
    from nff_companion.core.vehicle import AXES

    for index, axis in enumerate(AXES):
        console.print(
            f"{axis:7} explained {result.explained[index]:.3f} (constant phi {result.constant_explained[index]:.3f}),"
            f" error {result.error_over_constant[index]:.2f} of the constant's,"
            f" {result.error_over_fast_constant[index]:.2f} of one following in {result.fast_constant_follow_s:.1f} s,"
            f" a0 alone {result.prior_explained[index]:.2f},"
            f" {result.error_rms[index]:.3f} of {result.residual_rms[index]:.3f} SI rms"
            f"{'' if axis in result.covered else '; NOT COVERED'}",
            highlight=False,
        )
