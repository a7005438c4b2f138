"""The paper's figures 5, 6 and 7, drawn from our flights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.errors import MissingExtra
from sitl.trials.paper.figures import AXES, mean_position_error_m
from sitl.trials.paper.scenario import GROUPS, WINDOW_S, Trace

_COLOURS = {
    "baseline": "#7f8c8d",
    "nf": "#d68910",
    "b": "#8e44ad",
    "eff": "#229954",
    "nff": "#2471a3",
    "omniscient": "#17202a",
}


def _canvas(width: float, height: float) -> Any:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("drawings need matplotlib: pip install nff-companion[sim]") from error
    return Figure(figsize=(width, height), layout="constrained")


def draw(traces: list[Trace], folder: Path) -> list[Path]:
    """Write the pictures into ``folder``; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for name, figure in (
        ("figure5.png", _effectiveness(traces)),
        ("figure6.png", _attitude(traces)),
        ("figure7.png", _position(traces)),
    ):
        if figure is not None:
            figure.savefig(folder / name, dpi=110)
            out.append(folder / name)
    return out


def _effectiveness(traces: list[Trace]) -> Any:
    """Estimated effectiveness of all motors after an outer failure, of the two laws that name motors."""
    outer = [t for t in traces if t.case.group == "outer"]
    first = {name: next((t for t in outer if t.case.controller == name), None) for name in ("eff", "nff")}
    chosen = {name: trace for name, trace in first.items() if trace is not None}
    if not chosen:
        return None
    figure = _canvas(9, 3.2 * len(chosen))
    panels = np.atleast_1d(figure.subplots(len(chosen), 1, sharex=True))
    for axes, (name, trace) in zip(panels, chosen.items(), strict=True):
        inside = (trace.time_s >= -0.5) & (trace.time_s <= 2.0)
        for motor in range(trace.effectiveness.shape[1]):
            axes.plot(trace.time_s[inside], trace.effectiveness[inside, motor], label=f"motor {motor + 1}")
        axes.axvline(0.0, linestyle=":", color="grey")
        axes.set_title(f"{name}: motor {trace.case.motor} fails, effectiveness estimated", fontsize=10, loc="left")
        axes.set_ylim(-0.1, 1.3)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=7, ncols=8, loc="lower left")
    panels[-1].set_xlabel("s after the failure")
    return figure


def _attitude(traces: list[Trace]) -> Any:
    """Mean attitude error over the seeds."""
    figure = _canvas(11, 6)
    grid = figure.subplots(len(GROUPS), 3, sharex=True)
    at = np.arange(0.0, WINDOW_S, 0.01)
    for row, group in zip(grid, GROUPS, strict=True):
        for k, (axes, axis) in enumerate(zip(row, AXES, strict=True)):
            for name, colour in _COLOURS.items():
                flown = [t for t in traces if t.case.controller == name and t.case.group == group]
                if flown:
                    curves = [np.interp(at, t.time_s, np.abs(t.attitude_error_deg[:, k])) for t in flown]
                    axes.plot(at, np.nanmean(curves, axis=0), label=name, color=colour, linewidth=1.2)
            axes.set_title(f"{group} motor, {axis} error, deg", fontsize=9, loc="left")
            axes.grid(alpha=0.3)
    grid[0, 0].legend(fontsize=7)
    for axes in grid[-1]:
        axes.set_xlabel("s after the failure")
    return figure


def _position(traces: list[Trace]) -> Any:
    """Mean position error of each flight, by controller."""
    figure = _canvas(9, 3.6)
    panels = figure.subplots(1, len(GROUPS), sharey=True)
    for axes, group in zip(panels, GROUPS, strict=True):
        names = [n for n in _COLOURS if any(t.case.controller == n for t in traces)]
        rows = [
            [mean_position_error_m(t) for t in traces if t.case.controller == n and t.case.group == group]
            for n in names
        ]
        axes.boxplot(rows, tick_labels=names, showmeans=True)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        axes.set_title(f"{group} motor: mean position error, m", fontsize=10, loc="left")
        axes.grid(alpha=0.3, axis="y")
    return figure
