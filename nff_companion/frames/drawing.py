"""Frames as pictures, seen from above with the nose up: of characters, and as SVG."""

from __future__ import annotations

from xml.sax.saxutils import escape

from nff_companion.frames.catalogue import SPIN_NAMES, Frame

_ROWS, _COLUMNS = 8, 20  # from the centre to the farthest motor: a character is higher than it is wide
_SIZE, _RADIUS, _MARGIN = 480.0, 30.0, 60.0  # of the picture, in its units
_COLOURS = {1: "#1565c0", -1: "#c62828", 0: "#616161"}  # by spin


def label(frame: Frame, motor: int) -> str:
    """Number and spin of a motor, from index 0: ``3cw``."""
    spin = SPIN_NAMES[int(frame.spin[motor])]
    return f"{motor + 1}{'' if spin == '-' else spin}"


def characters(frame: Frame) -> str:
    """Lines of text. Motors at one place stand side by side, between slashes."""
    height, width = 2 * _ROWS + 3, 2 * _COLUMNS + 32
    middle = (height // 2, width // 2)
    canvas = [[" "] * width for _ in range(height)]
    cells = [
        (middle[0] - round(forward * _ROWS), middle[1] + round(right * _COLUMNS))
        for forward, right in (frame.place[site[0]].tolist() for site in frame.sites())
    ]
    for row, column in cells:
        steps = max(abs(row - middle[0]), 1)
        for step in range(1, steps):
            share = step / steps
            canvas[round(middle[0] + share * (row - middle[0]))][round(middle[1] + share * (column - middle[1]))] = "."
        if row == middle[0]:
            left, right = sorted((column, middle[1]))
            for between in range(left + 2, right, 2):
                canvas[row][between] = "."
    canvas[middle[0]][middle[1]] = "+"
    written: list[list[bool]] = [[False] * width for _ in range(height)]
    for (row, column), site in zip(cells, frame.sites(), strict=True):
        text = "/".join(label(frame, motor) for motor in site)
        begin = min(max(column - len(text) // 2, 1), width - len(text) - 1)
        free = _free_row(written, row, begin, len(text))
        for at, character in enumerate(text, start=begin):
            canvas[free][at], written[free][at] = character, True
        for at in (begin - 1, begin + len(text)):
            canvas[free][at] = " " if canvas[free][at] == "." else canvas[free][at]
    lines = ["".join(line).rstrip() for line in canvas]
    while not lines[0]:
        lines.pop(0)
    while not lines[-1]:
        lines.pop()
    cut = min(len(line) - len(line.lstrip()) for line in lines if line)
    nose = " " * (middle[1] - cut)
    return "\n".join([f"{nose[:-1]}nose", f"{nose}^", *(line[cut:] for line in lines)])


def _free_row(written: list[list[bool]], row: int, begin: int, length: int) -> int:
    """``row``, or the nearest one where a label has room, with a space on either side."""
    for off in range(len(written)):
        for candidate in (row + off, row - off):
            if 0 <= candidate < len(written) and not any(written[candidate][begin - 1 : begin + length + 1]):
                return candidate
    return row


def svg(frame: Frame, title: str, failed: tuple[int, ...] = ()) -> str:
    """A picture of the frame with ``title`` above, the motors ``failed`` (from 1) crossed out. Coaxial motors touch
    each other, side by side."""
    middle = _SIZE / 2.0
    reach = middle - _RADIUS - _MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_SIZE:g} {_SIZE + 40:g}" font-family="sans-serif"'
        ' text-anchor="middle">',
        f"<title>{escape(title)}</title>",
        f'<rect width="{_SIZE:g}" height="{_SIZE + 40:g}" fill="white"/>',
        f'<text x="{middle:g}" y="24" font-size="18">{escape(title)}</text>',
        '<g transform="translate(0 40)">',
        f'<path d="M {middle:g} 6 l 9 18 h -18 z" fill="#212121"><title>nose</title></path>',
    ]
    places = [(middle + reach * y, middle - reach * x) for x, y in frame.place.tolist()]
    sites = frame.sites()
    for site in sites:
        x, y = places[site[0]]
        parts.append(f'<path d="M {middle:g} {middle:g} L {x:.1f} {y:.1f}" stroke="#9e9e9e" stroke-width="5"/>')
    parts.append(f'<circle cx="{middle:g}" cy="{middle:g}" r="16" fill="#9e9e9e"/>')
    for site in sites:
        for k, motor in enumerate(site):
            x, y = places[motor]
            at = x + (2 * k - len(site) + 1) * _RADIUS
            parts += _rotor(frame, motor, at, y, crossed=motor + 1 in failed)
    return "\n".join([*parts, "</g>", "</svg>"]) + "\n"


def _rotor(frame: Frame, motor: int, x: float, y: float, *, crossed: bool) -> list[str]:
    spin = int(frame.spin[motor])
    colour, r = _COLOURS[spin], _RADIUS
    out = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{r:g}" fill="white" stroke="{colour}" stroke-width="3"/>']
    if spin:
        # An arrow head on top of the circle: to the right is clockwise.
        out.append(f'<path d="M {x - 7 * spin:.1f} {y - r:.1f} l {13 * spin} -8 v 16 z" fill="{colour}"/>')
    name = SPIN_NAMES[spin] if spin else ""
    if crossed:
        out.append(_crossed(motor, x, y))
    # The number is read over the cross.
    over = ' stroke="white" stroke-width="9" paint-order="stroke"' if crossed else ""
    out.append(f'<text x="{x:.1f}" y="{y + 6:.1f}" font-size="18" fill="{colour}"{over}>{motor + 1}</text>')
    out.append(f'<text x="{x:.1f}" y="{y + 20:.1f}" font-size="10" fill="{colour}">{name}</text>')
    return out


def _crossed(motor: int, x: float, y: float) -> str:
    r = 1.15 * _RADIUS
    lines = f"M {x - r:.1f} {y - r:.1f} L {x + r:.1f} {y + r:.1f} M {x - r:.1f} {y + r:.1f} L {x + r:.1f} {y - r:.1f}"
    title = f"<title>motor {motor + 1} failed</title>"
    return f'<path class="failed" d="{lines}" stroke="#d50000" stroke-width="6">{title}</path>'
