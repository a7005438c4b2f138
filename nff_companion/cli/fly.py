"""``nff fly`` and ``nff ardupilot``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nff_companion.cli.output import console, print_json
from nff_companion.daemon.configuration import MODES
from nff_companion.errors import ConfigError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")]
fly_app = typer.Typer(no_args_is_help=True, help="Fly real firmware in SITL, without and with the companion.")
ardupilot_app = typer.Typer(no_args_is_help=True, help="The applet on an ArduPilot vehicle.")


def _line(flight: dict[str, Any]) -> None:
    failures = flight["options"]["failures"]
    if "error" in flight:
        console.print(f"motors {failures!s:9}: NOT FLOWN: {flight['error']}", highlight=False, soft_wrap=True)
        if "machine" in flight:
            _machine(flight)
        return
    parts = []
    slow = flight["machine"]["too_slow"]
    for name in ("baseline", "companion"):
        if name in flight:
            f = flight[name]
            end = "CRASH" if f["crashed"] else "flies"
            if slow and name == "companion":
                end = "NOT JUDGED"
            parts.append(
                f"{name} {end}, tilt {f['max_tilt_deg']:.1f} deg, off {f['max_position_error_m']:.2f} m,"
                f" height lost {f['height_lost_m']} m"
            )
    if "not_restored" in flight["companion"]:
        f = flight["companion"]
        parts.append(f"{f['changed_parameters']} parameters changed, not restored after kill -9: {f['not_restored']}")
    delays = [fault["delay_s"] for fault in flight["companion"]["faults"]]
    console.print(f"motors {failures!s:9}: {'; '.join(parts)}; delays {delays}", highlight=False, soft_wrap=True)
    _machine(flight)


def _machine(flight: dict[str, Any]) -> None:
    from sitl.trials.machine import line

    console.print(f"  {line(flight['machine'])}", highlight=False, soft_wrap=True)


def _code(document: dict[str, Any]) -> int:
    """Exit code of one flight or a campaign."""
    from sitl.trials.machine import TOO_SLOW, exit_code

    if "flights" in document:
        return TOO_SLOW if document["summary"]["too_slow"] else 0
    return exit_code(document)


@fly_app.command("ardupilot")
def ardupilot(
    arducopter: Annotated[Path | None, typer.Option(help="arducopter SITL binary; or NFF_ARDUCOPTER.")] = None,
    fail: Annotated[list[int] | None, typer.Option("--fail", help="Motor; several fail together.")] = None,
    campaign: Annotated[str, typer.Option(help="singles, adjacent, pairs or healthy: every such set.")] = "",
    wind: Annotated[float, typer.Option(help="Wind in m/s.")] = 5.0,
    turbulence: Annotated[float, typer.Option(help="SIM_WIND_TURB.")] = 0.0,
    speed: Annotated[float, typer.Option(help="0: hover; else a square at this speed in m/s.")] = 0.0,
    rate: Annotated[float, typer.Option(help="Telemetry rate in Hz.")] = 200.0,
    mode: Annotated[str, typer.Option(help="observe, allocate or override.")] = "allocate",
    seconds: Annotated[float, typer.Option(help="Flown on after the failure.")] = 15.0,
    baseline: Annotated[bool, typer.Option(help="Fly without the companion too.")] = True,
    keep: Annotated[Path | None, typer.Option(help="Folder for the logs of a single flight.")] = None,
    jobs: Annotated[int, typer.Option(help="Flights at a time.")] = 1,
    json: Json = False,
) -> None:
    """Take off, hover or fly a square, fail motors, and compare.

    Exit code 0: the flight with the companion ended in the air; 1: it crashed; 3: the machine was too slow, so that
    the flight says neither. Of a campaign 0, or 3 when the machine was too slow for any of its flights.
    """
    from nff_companion.core import vehicle
    from sitl.trials.fly import arducopter as flights
    from sitl.trials.fly import campaign as campaigns

    if mode not in MODES:
        raise ConfigError(f"mode {mode!r} is unknown: choose one of {', '.join(MODES)}")
    if campaign not in ("", "singles", "adjacent", "pairs", "healthy"):
        raise ConfigError(f"campaign {campaign!r} is unknown: choose singles, adjacent, pairs or healthy")
    options = flights.FlyOptions(
        binary=flights.binary_from(arducopter),
        failures=list(fail or ([] if campaign else [1])),
        wind_m_s=wind,
        turbulence=turbulence,
        speed_m_s=speed,
        rate_hz=rate,
        mode=mode,
        fly_on_s=seconds,
    )
    if campaign:
        sets = campaigns.sets_of(campaign, vehicle.load(options.airframe))
        document = campaigns.run(options, sets, baseline=baseline, jobs=jobs, say=_line)
        for key, value in document["summary"].items():
            console.print(f"{key}: {value}", highlight=False)
    else:
        document = flights.run(options, baseline=baseline, keep=keep)
        _line(document)
    if json:
        print_json(document)
    raise typer.Exit(_code(document))


@fly_app.command("px4")
def px4(
    px4: Annotated[Path | None, typer.Option(help="px4 SITL binary (bin/px4 of a build); or NFF_PX4.")] = None,
    fail: Annotated[list[int] | None, typer.Option("--fail", help="Motor; several fail together.")] = None,
    campaign: Annotated[str, typer.Option(help="singles, pairs or healthy: every such set.")] = "",
    thrust_to_weight: Annotated[float, typer.Option(help="Of the vehicle.")] = 1.55,
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "px4-octo-x",
    wind: Annotated[float, typer.Option(help="Mean wind in m/s; turbulence is a quarter of it.")] = 0.0,
    rate: Annotated[float, typer.Option(help="Telemetry rate in Hz.")] = 250.0,
    mode: Annotated[str, typer.Option(help="observe or allocate.")] = "allocate",
    seconds: Annotated[float, typer.Option(help="Flown on after the failure.")] = 15.0,
    seed: Annotated[int, typer.Option(help="Seed of the plant's wind and noise.")] = 1,
    journal: Annotated[
        bool, typer.Option("--journal", help="Then kill -9, land, and see the next start restore every parameter.")
    ] = False,
    baseline: Annotated[bool, typer.Option(help="Fly without the companion too.")] = True,
    keep: Annotated[Path | None, typer.Option(help="Folder for the logs of a single flight.")] = None,
    json: Json = False,
) -> None:
    """Hold at 30 m on our plant, fail motors, and compare.

    Exit code 0: the flight with the companion ended in the air; 1: it crashed; 3: the machine was too slow, so that
    the flight says neither. Of a campaign 0, or 3 when the machine was too slow for any of its flights.
    """
    from nff_companion.core import vehicle
    from sitl.trials.fly import campaign as campaigns
    from sitl.trials.fly import px4 as flights

    if campaign not in ("", "singles", "adjacent", "pairs", "healthy"):
        raise ConfigError(f"campaign {campaign!r} is unknown: choose singles, adjacent, pairs or healthy")
    options = flights.FlyOptions(
        binary=flights.binary_from(px4),
        airframe=airframe,
        thrust_to_weight=thrust_to_weight,
        failures=list(fail or ([] if campaign else [3])),
        wind_m_s=wind,
        rate_hz=rate,
        mode=mode,
        fly_on_s=seconds,
        seed=seed,
        kill_and_land=journal,
    )
    if campaign:
        sets = campaigns.sets_of(campaign, vehicle.load(airframe))
        document = campaigns.run_px4(options, sets, baseline=baseline, say=_line)
        for key, value in document["summary"].items():
            console.print(f"{key}: {value}", highlight=False)
    else:
        document = flights.run(options, baseline=baseline, keep=keep)
        _line(document)
    if json:
        print_json(document)
    raise typer.Exit(_code(document))


@ardupilot_app.command("install")
def install(
    to: Annotated[Path, typer.Option("--to", help="The card's scripts directory (APM/scripts).")],
    airframe: Annotated[str, typer.Option(help="Airframe by name or TOML file.")] = "octo-x",
    outputs_only: Annotated[
        bool, typer.Option("--outputs-only", help="Leave FRAME_CLASS as it is: only override mode can act.")
    ] = False,
    parameters: Annotated[
        Path | None, typer.Option("--parameters", help="All parameters of the autopilot as it is now: .param, .parm.")
    ] = None,
    live: Annotated[str, typer.Option("--from", help="Ask the live autopilot: udpin:0.0.0.0:14550 and others.")] = "",
    timeout: Annotated[float, typer.Option(help="For --from, in s.", min=1.0)] = 60.0,
    frame: Annotated[
        str,
        typer.Option(help="What was flown before, where FRAME_CLASS is a script's and the card has not kept it."),
    ] = "",
    json: Json = False,
) -> None:
    """Write scripts, the airframe's allocation tables and a parameter file.

    What the autopilot flew until now is kept beside them. An airframe that is not the frame it flew is refused.
    """
    from nff_companion.autopilots.ardupilot import before
    from nff_companion.autopilots.ardupilot.install import install as write
    from nff_companion.cli.parameters import given
    from nff_companion.core import vehicle
    from nff_companion.frames import catalogue

    known = given(parameters, live, timeout)
    if known is None:
        raise ConfigError(
            "give --parameters FILE (all parameters of the autopilot as it is now) or --from URL: the airframe file is"
            " compared with the frame that it flies before that is replaced"
        )
    loaded = vehicle.load(airframe)
    flown = before.of_parameters(known, catalogue.by_name(frame) if frame else None, to, loaded)
    files = write(loaded, to, flown, scripted=not outputs_only)
    for path in files:
        console.print(str(path), highlight=False, soft_wrap=True)
    if json:
        print_json({"files": [str(path) for path in files]})
