"""A campaign on one page of HTML: self-contained, read offline."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from nff_companion.errors import MissingExtra
from sitl.trials.campaign.scenario import Scenario
from sitl.trials.campaign.summary import Row, by, exception

_COLUMNS = {
    "flights": "flights",
    "right": "right",
    "wrong": "wrong motor",
    "wrong_at_most": "at most",
    "missed": "missed",
    "missed_at_most": "at most",
    "delay_median_s": "median, s",
    "delay_p99_s": "99 %, s",
    "delay_worst_s": "worst, s",
    "partly": "partly lost",
    "partly_wrong": "of those working",
    "changes_most": "most changes",
    "flaps": "flaps",
    "survived": "flies on",
    "alone_survived": "alone",
    "tilt_median_deg": "tilt, deg",
    "alone_tilt_median_deg": "alone",
    "hours": "hours",
    "wrong_per_hour_at_most": "false an hour, at most",
}
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; margin: .5rem 0 1.5rem; display: block; overflow-x: auto }
th, td { padding: .2rem .6rem; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap }
th:first-child, td:first-child { text-align: left }
"""


def write(path: Path, scenario: Scenario, document: dict[str, Any], rows: list[Row]) -> None:
    """``document`` of ``rows``. Raises MissingExtra."""
    parts = [f"<h1>{html.escape(scenario.name)}</h1>", _said(scenario, rows), _table("all", {"": document["whole"]})]
    parts += [_table(key, table) for key, table in document["tables"].items()]
    parts.append(_delays(rows))
    parts.append("<h2>Exceptions</h2>")
    parts += [f"<p>{html.escape(line(row))}</p>" for row in document["exceptions"]] or ["<p>none</p>"]
    text = (
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{html.escape(scenario.name)}</title>"
        f"<meta name='viewport' content='width=device-width'><style>{_STYLE}</style></head>"
        f"<body>{''.join(parts)}</body></html>"
    )
    path.write_text(text, encoding="utf-8")


def line(row: Row) -> str:
    """One flight in one line."""
    failed = f"{row['fault']} {row['motors']}" if row["motors"] else "no fault"
    return (
        f"flight {row['flight']}: {row['airframe']}, {row['manoeuvre']}, {failed}, event {row['event']}:"
        f" {exception(row)}; named {row['named']}, delay {row['delay_s']} s, tilt {row['tilt_deg']}"
        f" ({row['alone_tilt_deg']} alone) deg; said: {row['says']}"
    )


def _said(scenario: Scenario, rows: list[Row]) -> str:
    return (
        f"<p>{len(rows)} of {scenario.flights} flights, seed {scenario.seed}; airframe files {scenario.level}, mass,"
        f" inertia and thrust off by up to {100.0 * scenario.model_error:.0f} %; wind {scenario.wind_m_s[0]:g} to"
        f" {scenario.wind_m_s[1]:g} m/s; {scenario.rate_hz:g} Hz, {1e3 * scenario.link_delay_s:g} ms each way."
        " At most: what the share does not exceed, by 95 %.</p>"
    )


def _table(title: str, table: dict[str, dict[str, Any]]) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in _COLUMNS.values())
    body = ""
    for name, counts in table.items():
        cells = "".join(f"<td>{'' if counts[key] is None else counts[key]}</td>" for key in _COLUMNS)
        body += f"<tr><td>{html.escape(str(name))}</td>{cells}</tr>"
    return f"<h2>{html.escape(title)}</h2><table><tr><th></th>{head}</tr>{body}</table>"


def _delays(rows: list[Row]) -> str:
    """Share of failures named within a time, by manoeuvre."""
    failing = [row for row in rows if row["motors"]]
    if not failing:
        return ""
    try:
        from plotly import graph_objects
    except ImportError as error:
        raise MissingExtra("the page needs plotly: pip install nff-companion[sim]") from error
    figure = graph_objects.Figure()
    for name, group in by(failing, "fault", "manoeuvre").items():
        delays = sorted(row["delay_s"] for row in group if row["delay_s"] is not None)
        share = [(k + 1) / len(group) for k in range(len(delays))]
        figure.add_scatter(x=delays, y=share, name=name, mode="lines", line_shape="hv")
    figure.update_layout(
        template="plotly_white",
        title="named within",
        xaxis={"type": "log", "title": "s after the failure"},
        yaxis={"title": "share of the flights", "range": [0, 1.02]},
    )
    return str(figure.to_html(full_html=False, include_plotlyjs=True))
