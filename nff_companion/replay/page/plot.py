"""Curves over time as inline SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

_WIDTH, _HEIGHT = 760.0, 190.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 64.0, 12.0, 26.0, 28.0
_POINTS_MAX = 1500
_TICKS_X, _TICKS_Y = 8, 4


@dataclass(frozen=True)
class Curve:
    """``values`` (K,) over the time of the plot; NaN: nothing is drawn."""

    name: str
    values: NDArray[np.float64]
    colour: str
    width: float = 1.5
    dashed: bool = False


def plot(
    title: str,
    time_s: NDArray[np.float64],
    curves: list[Curve],
    marks: list[tuple[float, str]],
    limits: tuple[float, float] | None = None,
) -> str:
    """Over ``time_s`` (K,); ``marks``: (time, text) of upright lines; ``limits`` of the values, None: theirs."""
    finite = np.concatenate([c.values[np.isfinite(c.values)] for c in curves] or [np.zeros(0)])
    if len(time_s) < 2 or len(finite) == 0:
        return f"<p>{escape(title)}: nothing was judged.</p>"
    low, high = limits or _span(finite)
    begin, end = float(time_s[0]), float(time_s[-1])
    end = end if end > begin else begin + 1.0

    def x(at: NDArray[np.float64] | float) -> NDArray[np.float64]:
        return np.asarray(_LEFT + (np.asarray(at) - begin) / (end - begin) * (_WIDTH - _LEFT - _RIGHT))

    def y(value: NDArray[np.float64] | float) -> NDArray[np.float64]:
        share = (np.clip(value, low, high) - low) / (high - low)
        return np.asarray(_HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM))

    parts = [
        f'<svg class="plot" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" font-family="sans-serif" font-size="11">',
        f"<title>{escape(title)}</title>",
        f'<text x="{_LEFT:g}" y="14" font-weight="bold">{escape(title)}</text>',
    ]
    for value in _ticks(low, high, _TICKS_Y):
        at = float(y(value))
        parts.append(f'<path d="M {_LEFT:g} {at:.1f} H {_WIDTH - _RIGHT:g}" stroke="#ddd"/>')
        parts.append(f'<text x="{_LEFT - 6:g}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in _ticks(begin, end, _TICKS_X):
        at = float(x(value))
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - 10:g}" text-anchor="middle">{value:g} s</text>')
    for moment, text in marks:
        if begin <= moment <= end:
            at = float(x(moment))
            line = f'<path d="M {at:.1f} {_TOP:g} V {_HEIGHT - _BOTTOM:g}" stroke="#d50000" stroke-dasharray="4 3">'
            parts.append(f"{line}<title>{escape(text)}</title></path>")
    for curve in curves:
        parts.append(_path(curve, x(time_s), y(curve.values)))
    return "\n".join([*parts, "</svg>", _legend(curves)])


def _path(curve: Curve, x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    stride = max(1, math.ceil(len(x) / _POINTS_MAX))
    commands, pen = [], "M"
    for at, value in zip(x[::stride].tolist(), y[::stride].tolist(), strict=True):
        if math.isfinite(value):
            commands.append(f"{pen}{at:.1f} {value:.1f}")
            pen = "L"
        else:
            pen = "M"
    dash = ' stroke-dasharray="6 3"' if curve.dashed else ""
    return (
        f'<path d="{" ".join(commands)}" fill="none" stroke="{curve.colour}" stroke-width="{curve.width:g}"{dash}>'
        f"<title>{escape(curve.name)}</title></path>"
    )


def _legend(curves: list[Curve]) -> str:
    entries = [f'<span><i style="background:{c.colour}"></i>{escape(c.name)}</span>' for c in curves]
    return f'<p class="legend">{"".join(entries)}</p>'


def _span(values: NDArray[np.float64]) -> tuple[float, float]:
    """Of all but the outermost, which would squeeze the rest."""
    low, high = (float(value) for value in np.percentile(values, (0.5, 99.5)))
    low, high = min(low, 0.0), max(high, 0.0)
    room = 0.08 * (high - low) or 1.0
    return low - room, high + room


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers within."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= rough)
    return [round(k * step, 10) + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
