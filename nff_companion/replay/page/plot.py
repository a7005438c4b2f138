"""Curves over time as inline SVG."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

_WIDTH, _HEIGHT = 760.0, 190.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 64.0, 26.0, 26.0, 30.0
_MARK_HEIGHT, _CHARACTER = 20.0, 9.0  # of the texts beside marks, as large as they become on a narrow screen
_TOGETHER = 6.0  # marks as near to each other as this are one
_POINTS_MAX = 1500
_TICKS_X, _TICKS_Y, _TICKS_MIN = 8, 4, 3
_BEYOND = 3.0  # times what nearly all values span: so much more is shown for the rest of them


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
    """Over ``time_s`` (K,); ``marks``: (time, text) of upright lines; ``limits`` of the values, None: theirs. Which
    curve is which ``legend`` says."""
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
        f'<svg class="plot" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" font-family="sans-serif">',
        f"<title>{escape(title)}</title>",
        f'<text x="{_LEFT:g}" y="16" font-weight="bold">{escape(title)}</text>',
    ]
    for value in _ticks(low, high, _TICKS_Y):
        at = float(y(value))
        parts.append(f'<path d="M {_LEFT:g} {at:.1f} H {_WIDTH - _RIGHT:g}" stroke="#ddd"/>')
        parts.append(f'<text x="{_LEFT - 6:g}" y="{at + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in _ticks(begin, end, _TICKS_X):
        at = float(x(value))
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - 10:g}" text-anchor="middle">{value:g} s</text>')
    for curve in curves:
        parts.append(_path(curve, x(time_s), y(curve.values)))
    parts += _marks([(float(x(moment)), text) for moment, text in marks if begin <= moment <= end])
    return "\n".join([*parts, "</svg>"])


def _marks(marks: list[tuple[float, str]]) -> list[str]:
    """Lines at (x, text), their texts beside them: of lines at nearly one place in one, and below each other where they
    would meet."""
    together: list[tuple[float, list[str]]] = []
    for at, text in sorted(marks):
        if together and at - together[-1][0] < _TOGETHER:
            together[-1][1].append(text)
        else:
            together.append((at, [text]))
    out, rows = [], list[float]()  # where the last text of each row ends
    for at, texts in together:
        text = escape(", ".join(texts))
        length = _CHARACTER * len(text)
        left = at + 5.0 + length > _WIDTH
        begin = at - 5.0 - length if left else at + 5.0
        row = next((k for k, end in enumerate(rows) if end < begin), len(rows))
        rows[row : row + 1] = [begin + length]
        out.append(
            f'<path d="M {at:.1f} {_TOP:g} V {_HEIGHT - _BOTTOM:g}" stroke="#d50000" stroke-dasharray="4 3">'
            f"<title>{text}</title></path>"
        )
        out.append(
            f'<text class="mark" x="{at - 5.0 if left else at + 5.0:.1f}" y="{_TOP + 12.0 + row * _MARK_HEIGHT:.1f}"'
            f' fill="#b71c1c" text-anchor="{"end" if left else "start"}">{text}</text>'
        )
    return out


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


def legend(curves: list[Curve]) -> str:
    """Which curve is which."""
    entries = [
        f'<span><i style="border-top: {max(c.width, 2.0):g}px {"dashed" if c.dashed else "solid"} {c.colour}"></i>'
        f"{escape(c.name)}</span>"
        for c in curves
    ]
    return f'<p class="legend">{"".join(entries)}</p>'


def _span(values: NDArray[np.float64]) -> tuple[float, float]:
    """Of all but the outermost where those would squeeze the rest."""
    low, high = (float(value) for value in np.percentile(values, (0.5, 99.5)))
    low, high = min(low, 0.0), max(high, 0.0)
    least, most = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    if most - least <= _BEYOND * (high - low):
        low, high = least, most
    room = 0.08 * (high - low) or 1.0
    return low - room, high + room


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers within."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    steps = [power * m for m in (10.0, 5.0, 2.0, 1.0, 0.5)]
    first = next(k for k in range(len(steps), 0, -1) if steps[k - 1] >= rough) - 1
    for step in steps[first:]:
        ticks = [round(k * step, 10) + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
        if len(ticks) >= _TICKS_MIN:
            break
    return ticks
