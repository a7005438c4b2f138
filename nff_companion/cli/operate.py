"""``nff run``, ``status``, ``lift``, ``mode``, ``doctor``, ``check``."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from nff_companion.cli.output import console, print_json, say, setup_logging
from nff_companion.daemon.configuration import default_status_socket
from nff_companion.errors import EndpointError

Socket = Annotated[str, typer.Option("--socket", help="Status socket of the daemon.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]


Configuration = Annotated[Path | None, typer.Option("--config", help="Configuration file (TOML).")]
Airframe = Annotated[str, typer.Option(help="Instead of --config, with --endpoint: airframe by name or TOML file.")]
Endpoint = Annotated[str, typer.Option(help="Instead of --config: of the autopilot, as udpin:0.0.0.0:14550.")]


def run(config: Configuration = None, airframe: Airframe = "", endpoint: Endpoint = "", json: Json = False) -> None:
    """Run the daemon until it is told to stop."""
    from nff_companion.daemon import configuration, service

    setup_logging()
    code = service.run(configuration.given(config, airframe, endpoint))
    if json:
        print_json({"config": None if config is None else str(config), "exit": code})
    raise typer.Exit(code)


def _table(state: dict[str, Any]) -> Any:
    from rich.table import Table
    from rich.text import Text

    table = Table(title=f"{state['airframe']}   {state['mode'].upper()}: {state['reason']}")
    for column in ("motor", "effectiveness", "+-", "decision"):
        table.add_column(column, justify="right")
    colours = {"failed": "red", "degraded": "yellow", "healthy": "green"}
    for motor in state["motors"]:
        eta, deviation = motor["effectiveness"], motor["deviation"]
        colour = colours.get(motor["decision"], "white")
        table.add_row(
            str(motor["motor"]),
            "-" if eta is None else f"{eta:.2f}",
            "-" if deviation is None else f"{deviation:.2f}",
            Text(motor["decision"], colour),
        )
    autopilot = state["autopilot"]
    allocation = "no autopilot heard" if autopilot is None else f"motors driven by: {autopilot['allocation']}"
    proposal = state.get("proposal", {"state": "off"})
    age = "never" if state["sample_age_s"] is None else f"{state['sample_age_s']:.2f} s ago"
    table.caption = (
        f"{state['rate_hz']:.0f} Hz, step {state['step_us']:.0f} us, last sample {age}; {allocation}; "
        f"bad samples {state['counters']['bad_samples']}, bad frames {state['counters']['bad_frames']}, "
        f"dropped frames {state['counters']['dropped']}, unallocated {state['unallocated']}"
        + "".join(f"; {name} {s['hz']:.0f} of {s['asked_hz']:.0f} Hz" for name, s in state["slow_streams"].items())
        + "".join(f"; motor {motor}: speed sensor" for motor in state["speed_sensor_faults"])
        + "".join(f"; {note}" for note in state.get("notes", []))
        + (f"; airframe file: {state['airframe_fit']['text']}" if "airframe_fit" in state else "")
        + (f"; {proposal['text']}" if proposal.get("state") not in ("off", "waiting") else "")
    )
    return table


def status(
    json: Json = False,
    once: Annotated[bool, typer.Option("--once", help="Show once instead of following.")] = False,
    socket: Socket = "",
) -> None:
    """Show what the companion believes and does."""
    from rich.live import Live

    from nff_companion.daemon.status_server import ask

    path = socket or default_status_socket()
    if json or once:
        state = ask(path, {"command": "status"})
        if json:
            print_json(state)
        else:
            console.print(_table(state))
        return
    with Live(console=console, refresh_per_second=5) as live:
        while True:
            try:
                live.update(_table(ask(path, {"command": "status"})))
            except EndpointError as error:
                live.update(str(error))
            except KeyboardInterrupt:
                return
            time.sleep(0.2)


def _command(socket: str, request: dict[str, Any], json: bool) -> None:
    from nff_companion.daemon.status_server import ask

    answer = ask(socket or default_status_socket(), request)
    if json:
        print_json(answer)
    else:
        console.print(answer.get("error") or f"{answer['mode']}: {answer['reason']}")
    raise typer.Exit(1 if "error" in answer else 0)


def lift(motor: Annotated[int, typer.Argument(help="Motor, from 1.")], json: Json = False, socket: Socket = "") -> None:
    """Lift the declaration of a motor: you say that it works."""
    _command(socket, {"command": "lift", "motor": motor}, json)


def mode(
    name: Annotated[str, typer.Argument(help="observe, allocate or override.")], json: Json = False, socket: Socket = ""
) -> None:
    """Set the mode of the running daemon."""
    _command(socket, {"command": "mode", "mode": name}, json)


def doctor(
    config: Configuration = None,
    airframe: Airframe = "",
    endpoint: Endpoint = "",
    timeout: Annotated[float, typer.Option(help="Longest time to listen, in s.")] = 20.0,
    json: Json = False,
) -> None:
    """Check link, autopilot, applet, parameters, motor order and rates before arming. Exit code 1: not ready."""
    from rich.text import Text

    from nff_companion.daemon import configuration
    from nff_companion.daemon.doctor import Doctor

    findings = Doctor(configuration.given(config, airframe, endpoint)).examine(timeout)
    marks = {True: ("ok  ", "green"), False: ("NOT ", "red"), None: ("note", "")}
    for finding in findings:
        console.print(Text.assemble(marks[finding.ok], f" {finding.name}: {finding.detail}"), soft_wrap=True)
    ready = all(finding.ok is not False for finding in findings)
    if json:
        found = [{"name": f.name, "ok": f.ok, "detail": f.detail} for f in findings]
        print_json({"ready": ready, "findings": found})
    raise typer.Exit(0 if ready else 1)


def check(
    config: Annotated[Path, typer.Option("--config", help="Configuration file (TOML).")],
    seconds: Annotated[float, typer.Option(min=1.0, help="Of flight to look at, in s.")] = 20.0,
    wait: Annotated[float, typer.Option(min=0.0, help="Longest wait for the flight, in s.")] = 120.0,
    json: Json = False,
) -> None:
    """Compare the airframe file with the vehicle that flies; start it before arming. Changes nothing.

    Exit code 0: it fits, 1: it does not, 2: not known.
    """
    from nff_companion.core.fit import FitVerdict
    from nff_companion.daemon import configuration
    from nff_companion.daemon.fit_check import FitCheck
    from nff_companion.reporting import Moment, fit_numbers

    def said(moment: Moment) -> None:
        say(f"{moment.verdict.text}; airframe file: {moment.output.fit.text}")

    fit = FitCheck(configuration.load(config)).watch(seconds, wait, said)
    say(f"airframe file: {fit.text}")
    if json:
        print_json(fit_numbers(fit))
    codes = {FitVerdict.FITS: 0, FitVerdict.DOES_NOT_FIT: 1, FitVerdict.UNKNOWN: 2}
    raise typer.Exit(codes[fit.verdict])
