"""``nff compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nff_companion.cli.output import console, print_json
from nff_companion.errors import ConfigError


def compare(
    scenario: Annotated[str, typer.Option(help="paper: 7.5 m/s rectangle, a motor lost, six controllers.")] = "paper",
    seeds: Annotated[int, typer.Option(min=1, help="Seeds; each an inner and an outer failure for all.")] = 20,
    controllers: Annotated[str, typer.Option(help="Only these, separated by commas.")] = "",
    network: Annotated[str, typer.Option(help="Basis: airframe, none, a shipped name or an .npz file.")] = "airframe",
    variant: Annotated[
        str,
        typer.Option(
            help="Ablation: full, no-phi, lateral-for-all, lateral-for-none, published, published-no-sparsity,"
            " published-no-shaping."
        ),
    ] = "full",
    level: Annotated[
        str, typer.Option(help="How far off the file is: exact, calibrated, geometry or estimated.")
    ] = "calibrated",
    wind: Annotated[float, typer.Option(help="Mean wind in m/s; turbulence is a quarter of it.")] = 2.0,
    draw: Annotated[Path | None, typer.Option(help="Folder for figures 5, 6 and 7.")] = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0: one a core.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")] = False,
) -> None:
    """Fly the published experiment with every controller and print its table beside the published one."""
    from sitl.trials.paper.figures import document
    from sitl.trials.paper.run import run
    from sitl.trials.paper.scenario import CONTROLLERS, PaperOptions, variants
    from sitl.uncertainty import LEVELS

    if scenario != "paper":
        raise ConfigError(f"scenario {scenario!r} is unknown: choose paper")
    chosen = tuple(name for name in controllers.split(",") if name) or CONTROLLERS
    unknown = set(chosen) - set(CONTROLLERS)
    if unknown:
        raise ConfigError(f"controller {min(unknown)!r} is unknown: choose among {', '.join(CONTROLLERS)}")
    if level not in LEVELS:
        raise ConfigError(f"level {level!r} is unknown: choose one of {', '.join(LEVELS)}")
    if variant not in variants():
        raise ConfigError(f"variant {variant!r} is unknown: choose one of {', '.join(variants())}")
    if variant == "no-phi" and network not in ("airframe", "none"):
        raise ConfigError(f"--variant no-phi flies without a network: leave --network {network} out")
    options = PaperOptions(
        seeds=seeds, wind_m_s=wind, network=network, level=level, variant=variant, controllers=chosen
    )
    traces = run(options, workers or None)
    result = document(traces)
    if draw is not None:
        from sitl.trials.paper.drawing import draw as draw_figures

        for path in draw_figures(traces, draw):
            console.print(f"drawn: {path}", highlight=False)
    if json:
        print_json(result)
        return
    _print(result)


def _print(result: dict[str, Any]) -> None:
    from sitl.trials.paper import published
    from sitl.trials.paper.figures import AXES

    def line(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    for group in ("outer", "inner"):
        line(f"peak attitude error after an {group} failure, deg: roll / pitch / yaw [95 % interval] (published)")
        for name, row in result["controllers"].items():
            found = row["peak_attitude_error_deg"][group]
            spread = result["intervals"][name]["peak_attitude_error_deg"][group]
            theirs = published.PEAK_ATTITUDE_ERROR_DEG[group].get(name)
            ours = " / ".join(_value(found[a], spread[a], 1) for a in AXES)
            mean_curve = result["intervals"][name]["peak_of_mean_attitude_error_deg"][group]
            ours += f"   of the mean curve {' / '.join(f'{mean_curve[a]:.1f}' for a in AXES)}"
            line(f"  {name:10} {ours}" + (f"   ({' / '.join(map(str, theirs))})" if theirs else ""))
    line("mean position error, m [95 % interval]: after any failure; against baseline; in the second before it")
    for name, row in result["controllers"].items():
        more = result["intervals"][name]
        text = f"  {name:10} {_value(row['mean_position_error_m'], more['mean_position_error_m'], 3)}"
        against = result["against_baseline"].get(name)
        text += f"   {_percent(against)}" if against else ""
        line(f"{text}   before {more['position_error_before_m'][0]:.3f}")
    line("the same after an outer failure; against baseline (published)")
    for name in result["controllers"]:
        value, *spread = result["intervals"][name]["mean_position_error_m_by_group"]["outer"]
        text = f"  {name:10} {_value(value, spread, 3)}"
        against = result["against_baseline"].get(name)
        text += f"   {_percent(against['outer'])}" if against else ""
        reported = published.MEAN_POSITION_ERROR_M.get(name)
        line(text + (f"   ({reported})" if reported else ""))
    for name, row in result["controllers"].items():
        more = result["intervals"][name]
        line(
            f"  {name:10} crashes {row['crashes']} of {more['flights']}, named right {more['named_right']},"
            f" wrong {more['named_wrong']}, false loss {more['false_loss'][0]:.2f},"
            f" isolation median {more['isolation_median_s']}, worst {more['isolation_worst_s']} s"
        )
    for group, shares in result["gap_closed"].items():
        spread = result["gap_closed_intervals"][group]
        text = " / ".join(_value(shares[a], spread[a], 2) for a in AXES)
        line(f"share of the gap between baseline and omniscient that nff closes, {group}: {text}")
        other = result["gap_closed_of_mean_curve"][group]
        text = " / ".join(_value(other["share"][a], other["interval"][a], 2) for a in AXES)
        line(f"  the same of the peak of the mean curve: {text}")


def _value(value: float, interval: list[float], digits: int) -> str:
    return f"{value:.{digits}f} [{interval[0]:.{digits}f}, {interval[1]:.{digits}f}]"


def _percent(against: dict[str, Any]) -> str:
    low, high = against["interval"]
    return f"{100 * against['position_error_change']:+.0f} % [{100 * low:+.0f}, {100 * high:+.0f}]"
