"""The picture of a demo: one HTML file by plotly, or a still picture (.png, .svg) by matplotlib."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nff_companion.errors import MissingExtra
from sitl.trials.demo import DemoResult, Trace


def _figure(result: DemoResult) -> Any:
    try:
        from plotly import graph_objects
        from plotly.subplots import make_subplots
    except ImportError as error:
        raise MissingExtra("the report needs plotly: pip install nff-companion[sim]") from error
    titles = ("tilt, deg", "distance from the path, m", "estimated effectiveness", "motor outputs with the companion")
    figure = make_subplots(rows=4, cols=1, shared_xaxes=True, subplot_titles=titles, vertical_spacing=0.06)

    def line(row: int, x: list[float], y: list[float], name: str, **style: Any) -> None:
        figure.add_trace(graph_objects.Scatter(x=x, y=y, name=name, mode="lines", **style), row=row, col=1)

    flights: tuple[tuple[Trace, str, str], ...] = (
        (result.baseline, "without", "#c0392b"),
        (result.companion, "with companion", "#2471a3"),
    )
    for trace, name, colour in flights:
        line(1, trace.time_s, trace.tilt_deg, name, line_color=colour, legendgroup=name)
        line(2, trace.time_s, trace.position_error_m, name, line_color=colour, legendgroup=name, showlegend=False)
    trace = result.companion
    for motor in range(len(trace.output[0]) if trace.output else 0):
        name = f"motor {motor + 1}"
        eta = [row[motor] for row in trace.effectiveness]
        outputs = [row[motor] for row in trace.output]
        colour = f"hsl({45 * motor}, 65%, 45%)"
        line(3, trace.effectiveness_time_s, eta, name, legendgroup=name, line_color=colour)
        line(4, trace.time_s, outputs, name, legendgroup=name, line_color=colour, showlegend=False)
    for motor, at in result.options.failures:
        figure.add_vline(x=at, line_dash="dot", line_color="grey")
        figure.add_annotation(x=at, y=1.0, yref="paper", text=f"motor {motor} fails", showarrow=False, yshift=12)
    figure.update_yaxes(range=[0, 100], row=1, col=1)
    figure.update_yaxes(range=[0, 5], row=2, col=1)
    figure.update_xaxes(title_text="s", row=4, col=1)
    o = result.options
    figure.update_layout(
        height=1000,
        template="plotly_white",
        title=f"{o.airframe}, {o.wind_m_s:g} m/s wind, {o.rate_hz:g} Hz, mode {o.mode}, seed {o.seed}",
        margin={"t": 90},
    )
    return figure


def _still(path: Path, result: DemoResult) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("a still picture needs matplotlib: pip install nff-companion[sim]") from error
    figure = Figure(figsize=(9, 9), layout="constrained")
    tilt, off, eta, outputs = figure.subplots(4, 1, sharex=True)
    for trace, name, colour in ((result.baseline, "without", "#c0392b"), (result.companion, "companion", "#2471a3")):
        tilt.plot(trace.time_s, trace.tilt_deg, label=name, color=colour)
        off.plot(trace.time_s, trace.position_error_m, color=colour)
    trace = result.companion
    for motor in range(len(trace.output[0]) if trace.output else 0):
        eta.plot(trace.effectiveness_time_s, [row[motor] for row in trace.effectiveness], label=f"motor {motor + 1}")
        outputs.plot(trace.time_s, [row[motor] for row in trace.output])
    for axes, title in (
        (tilt, "tilt, deg"),
        (off, "distance from the path, m"),
        (eta, "estimated effectiveness"),
        (outputs, "motor outputs with the companion"),
    ):
        axes.set_title(title, fontsize=10, loc="left")
        axes.grid(alpha=0.3)
        for _, at in result.options.failures:
            axes.axvline(at, linestyle=":", color="grey")
    tilt.legend(loc="upper right", fontsize=8)
    eta.legend(loc="lower left", fontsize=7, ncols=8)
    off.set_ylim(0, 5)
    outputs.set_xlabel("s")
    figure.savefig(path, dpi=90)


def write_report(path: Path, result: DemoResult) -> None:
    """Write the picture, by the suffix of ``path``. Raises MissingExtra, OSError."""
    if path.suffix in (".png", ".svg"):
        _still(path, result)
    else:
        _figure(result).write_html(str(path), include_plotlyjs=True)
