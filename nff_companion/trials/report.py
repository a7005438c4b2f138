"""The picture of a demo: one HTML file by plotly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nff_companion.errors import MissingExtra
from nff_companion.trials.demo import DemoResult, Trace


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


def write_report(path: Path, result: DemoResult) -> None:
    """Write the HTML file. Raises MissingExtra, OSError."""
    _figure(result).write_html(str(path), include_plotlyjs=True)
