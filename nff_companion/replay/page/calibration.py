"""The page of a calibration: accelerations as measured and as the new file foretells them."""

from __future__ import annotations

from html import escape

import numpy as np

from nff_companion.core.vehicle import AXES
from nff_companion.replay.calibrate import Calibration
from nff_companion.replay.page.page import UNITS, whole_page
from nff_companion.replay.page.plot import Curve, plot

_SHOWN_S = 20.0


def page(found: Calibration, name: str) -> str:
    """HTML."""
    rows = []
    for n in found.numbers:
        value = ", ".join(f"{v:.3g}" for v in n.value) if isinstance(n.value, list) else f"{n.value:.4g}"
        rows.append(f"<tr><td>{n.key}</td><td>{value}</td><td>±{n.deviation:.2g} {n.unit}</td></tr>")
    said = []
    for v in found.verdicts:
        text = "enough" if v.enough else f"wanted {v.most:g}: {v.advice}"
        said.append(f"<tr><td>{v.name}</td><td>{v.deviation:.2g} {v.unit}</td><td>{escape(text)}</td></tr>")
    body = [
        f"<h1>{escape(name)}: {found.flown_s:.0f} s of flight</h1>",
        f"<h2>In the file</h2><table>{''.join(rows)}</table>",
        f"<h2>How well it is known</h2><table>{''.join(said)}</table>",
        "<h2>Measured and foretold</h2>",
        *_curves(found),
    ]
    return whole_page(f"Calibration of {name}", body)


def _curves(found: Calibration) -> list[str]:
    """Each axis where it moves most."""
    course, out = found.course, []
    length = max(round(_SHOWN_S / max(float(course.time_s[1] - course.time_s[0]), 1e-6)), 2)
    for axis, name in enumerate(AXES):
        power = np.cumsum(np.square(course.measured[:, axis] - course.measured[:, axis].mean()))
        first = int(np.argmax(power[length:] - power[:-length])) if len(power) > length else 0
        part = slice(first, first + length)
        curves = [
            Curve("measured", course.measured[part, axis], "#9e9e9e", 2.0),
            Curve("foretold", course.foretold[part, axis], "#1565c0"),
        ]
        out.append(plot(f"{name}, {UNITS[name]}", course.time_s[part], curves, []))
    return out
