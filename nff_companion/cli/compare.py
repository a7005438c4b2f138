"""``nff compare``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nff_companion.cli.output import console, print_json
from nff_companion.errors import ConfigError


def compare(
    scenario: Annotated[str, typer.Option(help="paper: 7.5 m/s rectangle, a motor lost, six controllers.")] = "paper",
    seeds: Annotated[int, typer.Option(help="Seeds; each an inner and an outer failure for every controller.")] = 20,
    controllers: Annotated[str, typer.Option(help="Only these, separated by commas.")] = "",
    network: Annotated[str, typer.Option(help="Basis: airframe, none, a shipped name or an .npz file.")] = "airframe",
    variant: Annotated[
        str,
        typer.Option(help="Ablation: full, no-phi, published, published-no-sparsity, published-no-shaping."),
    ] = "full",
    wind: Annotated[float, typer.Option(help="Mean wind in m/s; turbulence is a quarter of it.")] = 2.0,
    draw: Annotated[Path | None, typer.Option(help="Folder for figures 5, 6 and 7.")] = None,
    workers: Annotated[int, typer.Option(help="Processes; 0: one a core.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output.")] = False,
) -> None:
    """Fly the published experiment with every controller and print its table beside the published one."""
    from nff_companion.trials.paper.figures import document
    from nff_companion.trials.paper.run import run
    from nff_companion.trials.paper.scenario import CONTROLLERS, PaperOptions, variants

    if scenario != "paper":
        raise ConfigError(f"scenario {scenario!r} is unknown: choose paper")
    chosen = tuple(name for name in controllers.split(",") if name) or CONTROLLERS
    unknown = set(chosen) - set(CONTROLLERS)
    if unknown:
        raise ConfigError(f"controller {min(unknown)!r} is unknown: choose among {', '.join(CONTROLLERS)}")
    if variant not in variants():
        raise ConfigError(f"variant {variant!r} is unknown: choose one of {', '.join(variants())}")
    options = PaperOptions(seeds=seeds, wind_m_s=wind, network=network, variant=variant, controllers=chosen)
    traces = run(options, workers or None)
    result = document(traces)
    if draw is not None:
        from nff_companion.trials.paper.drawing import draw as draw_figures

        for path in draw_figures(traces, draw):
            console.print(f"drawn: {path}", highlight=False)
    if json:
        print_json(result)
        return
    _print(result)


def _print(result: dict[str, Any]) -> None:
    from nff_companion.trials.paper import published
    from nff_companion.trials.paper.figures import AXES

    def line(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    for group in ("outer", "inner"):
        line(f"peak attitude error after an {group} failure, deg: roll / pitch / yaw [95 % interval] (published)")
        for name, row in result["controllers"].items():
            found = row["peak_attitude_error_deg"][group]
            spread = result["intervals"][name]["peak_attitude_error_deg"][group]
            theirs = published.PEAK_ATTITUDE_ERROR_DEG[group].get(name)
            ours = " / ".join(f"{found[a]:.1f} [{spread[a][0]:.1f}, {spread[a][1]:.1f}]" for a in AXES)
            line(f"  {name:10} {ours}" + (f"   ({' / '.join(map(str, theirs))})" if theirs else ""))
    line("mean position error after the failure, m [95 % interval]; against baseline (published)")
    for name, row in result["controllers"].items():
        low, high = result["intervals"][name]["mean_position_error_m"]
        text = f"  {name:10} {row['mean_position_error_m']:.3f} [{low:.3f}, {high:.3f}]"
        against = result["against_baseline"].get(name)
        if against:
            low, high = against["interval"]
            text += f"   {100 * against['position_error_change']:+.0f} % [{100 * low:+.0f}, {100 * high:+.0f}]"
        reported = published.MEAN_POSITION_ERROR_M.get(name)
        line(text + (f"   ({reported})" if reported else ""))
    for name, row in result["controllers"].items():
        more = result["intervals"][name]
        line(
            f"  {name:10} crashes {row['crashes']} of {more['flights']}, named right {more['named_right']},"
            f" wrong {more['named_wrong']}, isolation median {more['isolation_median_s']},"
            f" worst {more['isolation_worst_s']} s"
        )
    for group, shares in result["gap_closed"].items():
        spread = result["gap_closed_intervals"][group]
        text = " / ".join(f"{shares[a]:.2f} [{spread[a][0]:.2f}, {spread[a][1]:.2f}]" for a in AXES)
        line(f"share of the gap between baseline and omniscient that nff closes, {group}: {text}")
