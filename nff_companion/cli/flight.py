"""``nff sitl`` and ``nff demo``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nff_companion.cli.output import console, print_json, setup_logging
from nff_companion.daemon.configuration import MODES
from nff_companion.errors import ConfigError

if TYPE_CHECKING:
    from sitl.fleet import Fleet

_LOGGED_S = 180.0

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]


def parse_failures(texts: list[str]) -> list[tuple[int, float]]:
    """``["1@5", "3@8"]`` to [(1, 5.0), (3, 8.0)]. Raises ConfigError."""
    out = []
    for text in texts:
        motor, _, seconds = text.partition("@")
        try:
            out.append((int(motor), float(seconds)))
        except ValueError as error:
            raise ConfigError(f"--fail {text!r} is not MOTOR@SECONDS, as in 1@5") from error
    return out


def _logged(fleet: Fleet, log: Path, seconds: float, px4: dict[str, float] | None) -> None:
    """In virtual time. ``px4``: parameters of a PX4 that are not stock. Raises ConfigError."""
    from sitl.trials.flown_log import write

    if log.suffix != ".tlog":
        raise ConfigError(f"--log {log}: the suffix must be .tlog")
    if not fleet.state.position_m[0, 2] < 0.0:
        raise ConfigError("--log: the flight begins in the air; give --height METRES")
    try:
        write(fleet, [log], seconds, parameters=px4 is not None, px4=px4)
    except OSError as error:
        raise ConfigError(f"{log} cannot be written: {error.strerror}") from error
    console.print(f"{log}: {seconds:.0f} s of flight", highlight=False, soft_wrap=True)


def sitl(
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    endpoint: Annotated[
        list[str] | None, typer.Option("--endpoint", help="MAVLink endpoint; may be given several times.")
    ] = None,
    fail: Annotated[list[str] | None, typer.Option("--fail", help="MOTOR@SECONDS; may be given several times.")] = None,
    wind: Annotated[float, typer.Option(help="Mean wind in m/s; turbulence is a quarter of it.")] = 0.0,
    model_error: Annotated[float, typer.Option(help="Errors of mass, inertia, thrust in percent.")] = 0.0,
    level: Annotated[
        str, typer.Option(help="How far off its file it is in all else: exact, calibrated, geometry or estimated.")
    ] = "exact",
    height: Annotated[float, typer.Option(help="Start in the air at this height in m; 0: on the ground.")] = 0.0,
    latency: Annotated[float, typer.Option(help="Latency of the link in ms.")] = 0.0,
    jitter: Annotated[float, typer.Option(help="Jitter of the link in ms.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Loss of datagrams in percent.")] = 0.0,
    corruption: Annotated[float, typer.Option(help="Corruption of datagrams in percent.")] = 0.0,
    seconds: Annotated[float, typer.Option(help="End after so long; 0: never.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 1,
    thrust_to_weight: Annotated[float, typer.Option(help="Replaces the airframe's; 0: as the file says.")] = 0.0,
    personality: Annotated[
        str,
        typer.Option(
            help="plain; ardupilot: stock messages, and our applet in a real Lua; px4: v1.16, by its parameters."
        ),
    ] = "plain",
    serve_px4: Annotated[bool, typer.Option("--serve-px4", help="Be the physics of a real PX4, TCP 4560.")] = False,
    serve_ardupilot: Annotated[
        bool, typer.Option("--serve-ardupilot", help="Be the physics of a real ArduPilot, JSON on UDP 9002.")
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option("--log", help="Fly stops and starts, climbs and turns by itself, and write this .tlog."),
    ] = None,
    json: Json = False,
) -> None:
    """Emulate a vehicle that speaks MAVLink, in real time; or be the physics of a real autopilot."""
    if serve_px4 and serve_ardupilot:
        raise ConfigError("--serve-px4 and --serve-ardupilot exclude each other: one plant, one brain")
    if personality not in ("plain", "ardupilot", "px4"):
        raise ConfigError(f"personality {personality!r} is unknown: choose plain, ardupilot or px4")
    px4: dict[str, float] | None = {} if personality == "px4" else None
    if (serve_px4 or serve_ardupilot) and level != "exact":
        raise ConfigError("--level is for the vehicle that nff sitl flies itself: leave it out with --serve-...")
    if serve_px4 or serve_ardupilot:
        from sitl.trials.serve import ServeOptions, serve

        setup_logging()
        options_served = ServeOptions(
            airframe=airframe,
            thrust_to_weight=thrust_to_weight or None,
            failures=parse_failures(fail or []),
            wind_m_s=wind,
            model_error=0.01 * model_error,
            seconds=seconds,
            seed=seed,
        )
        document = serve(options_served, px4=serve_px4, say=lambda text: console.print(text, highlight=False))
        if json:
            print_json(document)
        return
    from nff_companion.core import vehicle
    from sitl import airframe as plant_airframe
    from sitl.faults import Fault
    from sitl.fleet import Fleet, FleetOptions
    from sitl.link_model import LinkOptions
    from sitl.server import Server
    from sitl.trials.demo import crash_report
    from sitl.uncertainty import LEVELS

    if level not in LEVELS:
        raise ConfigError(f"level {level!r} is unknown: choose one of {', '.join(LEVELS)}")
    setup_logging()
    urls = endpoint or ["udpout:127.0.0.1:14561", "udpout:127.0.0.1:14540"]
    faults = [Fault(vehicle=0, motor=m, start_s=s) for m, s in parse_failures(fail or [])]
    options = FleetOptions(
        seeds=[seed],
        wind_m_s=wind,
        turbulence_m_s=0.25 * wind,
        model_error=0.01 * model_error,
        uncertainty=LEVELS[level](),
        height_m=height,
    )
    plant = plant_airframe.load(vehicle.path_of(airframe), thrust_to_weight=thrust_to_weight or None)
    fleet = Fleet(plant, options, faults)
    if log is not None:
        _logged(fleet, log, seconds or _LOGGED_S, px4)
        return
    link = LinkOptions(latency_s=1e-3 * latency, jitter_s=1e-3 * jitter, loss=0.01 * loss, corruption=0.01 * corruption)
    card = None
    if personality == "ardupilot":
        from sitl.trials.virtual import Workshop, temporary_card

        card = temporary_card()
        Workshop.prepare(vehicle.load(airframe, thrust_to_weight=thrust_to_weight or None), "trim", card.name)
    server = Server(fleet, urls, link=link, seed=seed, card=None if card is None else Path(card.name), px4=px4)
    console.print(f"{airframe} on {', '.join(urls)}", highlight=False)
    try:
        server.run(seconds or float("inf"))
    except KeyboardInterrupt:
        console.print("stopped")
    finally:
        server.close()
        if card is not None:
            card.cleanup()
    if json:
        print_json(crash_report(server))


def demo(
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    fail: Annotated[list[str] | None, typer.Option("--fail", help="MOTOR@SECONDS; may be given several times.")] = None,
    wind: Annotated[float, typer.Option(help="Turbulent wind in m/s.")] = 4.0,
    rate: Annotated[float, typer.Option(help="Telemetry rate in Hz.")] = 200.0,
    mode: Annotated[str, typer.Option(help="observe, allocate or override.")] = "allocate",
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 1,
    report: Annotated[Path, typer.Option(help="Picture to write: .html, .png or .svg.")] = Path("demo.report.html"),
    keep: Annotated[Path | None, typer.Option(help="Folder for the daemon's configuration and log.")] = None,
    json: Json = False,
) -> None:
    """Fly the same flight twice over UDP, without and with the companion, and compare.

    Exit code 0: the flight with the companion ended in the air; 1: it crashed; 3: the machine was too slow, so that
    the flight says neither.
    """
    from sitl.trials import demo as demonstration
    from sitl.trials import machine as machines
    from sitl.trials.report import write_report

    if mode not in MODES:
        raise ConfigError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
    options = demonstration.DemoOptions(
        airframe=airframe,
        failures=parse_failures(fail if fail else ["1@5", "3@8"]),
        wind_m_s=wind,
        rate_hz=rate,
        mode=mode,
        seed=seed,
    )
    result = demonstration.run(options, say=lambda text: console.print(text, highlight=False), keep=keep)
    write_report(report, result)
    console.print(f"picture: {report}", highlight=False, soft_wrap=True)
    if json:
        print_json(result.document)
        console.print(machines.line(result.document["machine"]), highlight=False, soft_wrap=True)
    else:
        console.print(demonstration.side_by_side(result.document), highlight=False, soft_wrap=True)
    raise typer.Exit(machines.exit_code(result.document))
