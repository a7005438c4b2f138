"""``nff bench``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nff_companion.cli.output import console, print_json

app = typer.Typer(no_args_is_help=True, help="Measure the daemon's loop and the allocation methods.")
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]


@app.command("loop")
def loop(
    rate: Annotated[float, typer.Option(help="Samples per second.")] = 400.0,
    seconds: Annotated[float, typer.Option(help="How long.")] = 10.0,
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    json: Json = False,
) -> None:
    """Last datagram of a sample in, override that answers it out; beside a bare MAVLink echo."""
    from sitl.trials.loop_bench import measure

    document = measure(rate_hz=rate, seconds=seconds, airframe=airframe)
    if json:
        print_json(document)
        return
    for key, value in document.items():
        console.print(f"{key}: {value}", highlight=False)


@app.command("allocation")
def allocation(
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    hover: Annotated[float, typer.Option(help="Hover fraction h; 0: the airframe's.")] = 0.5,
    json: Json = False,
) -> None:
    """Solve time and torque at hover of every allocation method, healthy and after each one or two failures."""
    from sitl.trials.allocation_bench import measure

    document = measure(airframe=airframe, hover=hover)
    if json:
        print_json(document)
        return
    for name, result in document["methods"].items():
        console.print(f"{name}: median {result['median_us']:.0f} us, p99 {result['p99_us']:.0f} us", highlight=False)
        for case in ("healthy", "1", "1+2", "1+3"):
            if case in result["torque"]:
                console.print(f"   {case:8} {result['torque'][case]}", highlight=False)


@app.command("adaptation")
def adaptation(
    airframe: Annotated[str, typer.Option(help="Airframe that names a network.")] = "octo-x",
    json: Json = False,
) -> None:
    """One adaptation step, basis network included."""
    from sitl.trials.adaptation_bench import measure

    document = measure(airframe)
    if json:
        print_json(document)
        return
    for key, value in document.items():
        console.print(f"{key}: {value}", highlight=False)


@app.command("ardupilot")
def ardupilot(
    arducopter: Annotated[Path | None, typer.Option(help="arducopter SITL binary; or NFF_ARDUCOPTER.")] = None,
    rate: Annotated[list[float] | None, typer.Option("--rate", help="Telemetry rate in Hz; several.")] = None,
    count: Annotated[int, typer.Option(help="Declarations at each rate.")] = 100,
    json: Json = False,
) -> None:
    """Declaration to changed motor output on a real ArduCopter in hover, and the link's load, at telemetry rates."""
    from sitl.trials.fly.arducopter import binary_from
    from sitl.trials.fly.latency import measure

    document = measure(binary_from(arducopter), rate or [50.0, 100.0, 200.0], count)
    if json:
        print_json(document)
        return
    for row in document["rates"]:
        console.print(", ".join(f"{key} {value}" for key, value in row.items()), highlight=False, soft_wrap=True)


@app.command("calibration")
def calibration(
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    vehicles: Annotated[int, typer.Option(help="Each with numbers of its own.", min=1)] = 50,
    seconds: Annotated[float, typer.Option(help="Of ordinary flight.")] = 180.0,
    first_seed: Annotated[int, typer.Option(help="Of the first vehicle.")] = 101,
    identify: Annotated[bool, typer.Option("--identify", help="Fail each motor with each file.")] = False,
    json: Json = False,
) -> None:
    """Calibrate simulated vehicles that are off from their airframe file, and compare with the truth."""
    from sitl.trials.calibration import CalibrationOptions, measure

    options = CalibrationOptions(
        airframe=airframe, vehicles=vehicles, seconds=seconds, first_seed=first_seed, identify=identify
    )
    document = measure(options)
    if json:
        print_json(document)
        return
    for vehicle in document["vehicles"]:
        console.print(", ".join(f"{k} {v}" for k, v in vehicle.items() if k != "failures"), highlight=False)
    for key, value in document["summary"].items():
        console.print(f"{key}: {value}", highlight=False)


@app.command("bound")
def bound(
    airframe: Annotated[list[str] | None, typer.Option(help="Airframe by name or TOML file; several.")] = None,
    vehicles: Annotated[int, typer.Option(help="Each with numbers of its own.", min=1)] = 8,
    json: Json = False,
) -> None:
    """How soon the loss of a motor could be told at best, from the plant's own noise and lag."""
    from sitl.trials.bound import BoundOptions, measure

    documents = [measure(BoundOptions(airframe=name, vehicles=vehicles)) for name in airframe or ["octo-x"]]
    if json:
        print_json({"airframes": documents})
        return
    for document in documents:
        console.print(", ".join(f"{key} {value}" for key, value in document.items()), highlight=False, soft_wrap=True)
