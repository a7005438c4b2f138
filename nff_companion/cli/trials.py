"""``nff survey`` and ``nff replay``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nff_companion.cli.output import print_json, say, say_error
from nff_companion.daemon.configuration import MODES
from nff_companion.errors import ConfigError, LogError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]


def survey(
    singles: Annotated[bool, typer.Option("--singles", help="Every single failure (the default).")] = False,
    pairs: Annotated[bool, typer.Option("--pairs", help="Every simultaneous double failure.")] = False,
    healthy: Annotated[float, typer.Option("--healthy", help="Minutes to fly without a failure instead.")] = 0.0,
    wrong_file: Annotated[
        int, typer.Option("--wrong-file", min=0, help="So many flights with a wrong airframe file instead.")
    ] = 0,
    first_seconds: Annotated[
        int, typer.Option("--first-seconds", min=0, help="So many of each kind from the ground: what is known in 10 s.")
    ] = 0,
    compare: Annotated[bool, typer.Option("--compare", help="Healthy flights without the companion too.")] = False,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds for each set of failures.")] = 3,
    first_seed: Annotated[int, typer.Option(min=1, help="The seeds count from it.")] = 1,
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    rate: Annotated[float, typer.Option(help="Telemetry rate in Hz.")] = 200.0,
    link_delay: Annotated[float, typer.Option(help="Delay of the link each way in ms.")] = 10.0,
    model_error: Annotated[float, typer.Option(help="Errors of mass, inertia, thrust in percent.")] = 10.0,
    level: Annotated[
        str, typer.Option(help="How far off the file is in all else: exact, calibrated, geometry or estimated.")
    ] = "calibrated",
    wind: Annotated[float, typer.Option(help="Mean wind in m/s; turbulence is a quarter of it.")] = 4.0,
    speed: Annotated[float, typer.Option(help="Flight speed in m/s; 0: hover.")] = 0.0,
    forward: Annotated[bool, typer.Option("--forward", help="Legs of up to 12 m/s in all directions.")] = False,
    network: Annotated[str, typer.Option(help="Basis: airframe, none, drag, a shipped name or a file.")] = "airframe",
    joint: Annotated[float, typer.Option(help="Losses and an error of phi a together; 0: in turn.")] = 0.0,
    mode: Annotated[str, typer.Option(help="observe, allocate or override.")] = "allocate",
    detector: Annotated[
        str, typer.Option(help="sparse, or a peer: published, imm, rls, thrust-loss, current.")
    ] = "sparse",
    personality: Annotated[
        str, typer.Option(help="plain; ardupilot: on the wire, with our applet in a real Lua; px4: emulated.")
    ] = "plain",
    rotor_speeds: Annotated[bool, typer.Option("--rotor-speeds", help="The ESCs report speeds.")] = False,
    thrust_to_weight: Annotated[float, typer.Option(help="Replaces the airframe's; 0: as the file says.")] = 0.0,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0: one a core.")] = 0,
    json: Json = False,
) -> None:
    """Fly every failure in virtual time, with and without the companion."""
    from nff_companion.core import vehicle
    from sitl.trials import survey as surveys
    from sitl.trials.personality import PERSONALITIES
    from sitl.uncertainty import LEVELS

    if mode not in MODES:
        raise ConfigError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
    if singles and pairs:
        raise ConfigError("--singles and --pairs exclude each other: run two surveys")
    if personality not in PERSONALITIES:
        raise ConfigError(f"personality {personality!r} is unknown: choose one of {', '.join(PERSONALITIES)}")
    if level not in LEVELS:
        raise ConfigError(f"level {level!r} is unknown: choose one of {', '.join(LEVELS)}")
    if wrong_file:
        _wrong_files(wrong_file, airframe, first_seed, workers or None, personality=personality, json=json)
        return
    if first_seconds:
        _first_seconds(first_seconds, airframe, first_seed, json=json)
        return
    options = surveys.SurveyOptions(
        airframe=airframe,
        personality=personality,
        compare=compare,
        rotor_speeds=rotor_speeds,
        forward=forward,
        network=network,
        joint=joint,
        thrust_to_weight=thrust_to_weight or None,
        seeds=seeds,
        first_seed=first_seed,
        rate_hz=rate,
        link_delay_s=1e-3 * link_delay,
        model_error=0.01 * model_error,
        wind_m_s=wind,
        speed_m_s=speed,
        mode=MODES[mode],
        detector=detector,
        level=level,
    )
    if healthy > 0.0:
        document = surveys.run_healthy(options, healthy, workers or None)
    else:
        sets = surveys.failure_sets(vehicle.load(airframe).motors, pairs=pairs)
        document = surveys.run(options, sets, workers or None)
    if json:
        print_json(document)
        return
    for flight in document["flights"]:
        baseline = flight["baseline_survived"]
        say(
            f"motors {flight['motors']!s:9} seed {flight['seed']}: {'flies' if flight['survived'] else 'CRASH'}"
            f" (without: {'-' if baseline is None else 'flies' if baseline else 'CRASH'}),"
            f" named {flight['named']}, delay {flight['delay_s']} s, tilt {flight['max_tilt_deg']:.1f} deg,"
            f" off by {flight['max_position_error_m']:.2f} m"
        )
    for key, value in document["summary"].items():
        say(f"{key}: {value}")


def _wrong_files(count: int, airframe: str, seed: int, workers: int | None, *, personality: str, json: bool) -> None:
    from sitl.trials import wrong_file

    document = wrong_file.run(airframe, count, seed, workers, personality)
    if json:
        print_json(document)
        return
    for flight in document["exceptions"]:
        say(f"{flight['case']}, seed {flight['seed']}: {flight['why']}; says: {flight['says']}; {flight['text']}")
    for kind, counts in document["summary"].items():
        say(f"{kind:10} " + ", ".join(f"{name} {number}" for name, number in counts.items()))


def _first_seconds(count: int, airframe: str, seed: int, *, json: bool) -> None:
    from sitl.trials import first_seconds

    document = first_seconds.run(airframe, count, seed)
    if json:
        print_json(document)
        return
    for name, lines in document["summary"].items():
        for line in lines:
            say(f"{name}: " + ", ".join(f"{key} {value}" for key, value in line.items() if value is not None))


def replay(
    logs: Annotated[list[Path], typer.Argument(help="ULog (.ulg), ArduPilot (.bin) or MAVLink (.tlog) logs.")],
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")],
    json: Json = False,
) -> None:
    """Find failed motors in flight logs. Exit code 0: no fault, 1: a fault, 2: a log could not be judged."""
    from nff_companion.core import vehicle as vehicle_model
    from nff_companion.replay.document import line
    from nff_companion.replay.run import replay_all

    vehicle = vehicle_model.load(airframe)
    flights: list[dict[str, Any]] = []
    unreadable = False
    for path in logs:
        try:
            found = replay_all(path, vehicle)
        except LogError as error:
            unreadable = True
            say_error(str(error))
            continue
        flights += found
        for flight in found:
            for note in flight["notes"]:
                say(f"{path}: {note}")
            if not json or flight["verdict"] == "not_judged":
                say(line(flight))
    if json:
        print_json({"flights": flights})
    if unreadable or any(flight["verdict"] == "not_judged" for flight in flights):
        raise typer.Exit(2)
    raise typer.Exit(int(any(flight["verdict"] == "fault" for flight in flights)))
