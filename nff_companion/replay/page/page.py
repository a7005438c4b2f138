"""The page of one flight: what happened, what speaks for it, what could have been done."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.core.vehicle import AXES, YAW, Vehicle
from nff_companion.frames import drawing
from nff_companion.replay.airframe_of_log import frame_of
from nff_companion.replay.page.plot import Curve, legend, plot
from nff_companion.replay.trace import Course

_AROUND_S = (4.0, 4.0)  # of the first declaration
UNITS = {"thrust": "m/s²", "roll": "rad/s²", "pitch": "rad/s²", "yaw": "rad/s²"}
_COLOURS = ("#1565c0", "#2e7d32", "#6a1b9a", "#ef6c00", "#00838f", "#9e9d24", "#795548", "#000000") * 2
_FAILED = "#d50000"
_FAILED_ONES = (_FAILED, "#c51162", "#7f0000", "#ff4081")  # of several
_NAMESPACE = ' xmlns="http://www.w3.org/2000/svg"'  # a file needs it, a page does not: nothing in it names a network
_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 sans-serif; max-width: 800px; margin: 2em auto; padding: 0 1em; }
body { color: #212121; background: #fff; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
.fault { color: #b71c1c; } .no_fault { color: #1b5e20; } .not_judged { color: #6d4c00; }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .2em 1em .2em 0; border-bottom: 1px solid #ddd; }
.frame svg { display: block; width: 100%; max-width: 320px; margin-bottom: -1.5em; }
svg.plot { display: block; width: 100%; height: auto; margin-bottom: .6em; font-size: 11px; }
.mark { paint-order: stroke; stroke: #fff; stroke-width: 3px; }
.legend { margin: 0 0 1em; font-size: .85em; } .legend span { margin-right: 1.2em; display: inline-block; }
.legend i { display: inline-block; width: 2em; margin-right: .4em; vertical-align: middle; }
code { overflow-wrap: anywhere; font-size: .95em; }
@media (max-width: 600px) { svg.plot { font-size: 18px; } body { margin: 1em auto; } ul { padding-left: 1.2em; } }
"""


def page(said: dict[str, Any], vehicle: Vehicle | None, course: Course | None) -> str:
    """HTML of the document ``said`` of a flight; ``vehicle`` None: none could be made; ``course`` None: not flown."""
    title = _headline(said)
    body = [
        f'<h1 class="{said["verdict"]}">{escape(title)}</h1>',
        _facts(said),
        _faults(said),
        _frame(said, vehicle),
    ]
    if vehicle is not None and said["verdict"] == "fault":
        body.append(_done(said, vehicle))
    if vehicle is not None and course is not None and len(course.time_s) > 1:
        body += [_evidence(said, vehicle, course), _effectiveness(said, course)]
    body.append(_made(said))
    return whole_page(title, body)


def whole_page(title: str, body: list[str]) -> str:
    """HTML that needs nothing else."""
    head = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\n"
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
    )
    return head + "\n".join(part for part in body if part) + "\n</body>\n</html>\n"


def _motors(numbers: list[int]) -> str:
    return f"motor{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"


def _failed(said: dict[str, Any]) -> list[int]:
    """Motors declared, in their order, each once."""
    return list(dict.fromkeys(fault["motor"] for fault in said["faults"]))


def _headline(said: dict[str, Any]) -> str:
    if said["verdict"] == "fault":
        named = _motors(_failed(said))
        return f"{named[0].upper()}{named[1:]} failed, {said['faults'][0]['time_s']:.2f} s into the log"
    return "No motor failed" if said["verdict"] == "no_fault" else "It cannot be told whether a motor failed"


def _facts(said: dict[str, Any]) -> str:
    rows = [("log", said["file"])]
    rows += [] if said["system"] is None else [("MAVLink system", str(said["system"]))]
    rows += [
        ("frame, by the log", said["frame"] or "it does not say"),
        ("duration", f"{said['duration_s']:.1f} s, of which {said['judged_s']:.1f} s of flight were judged"),
    ]
    rows += [("why", said["reason"])] if said["reason"] else []
    cells = "".join(f"<tr><th>{escape(name)}</th><td><code>{escape(str(text))}</code></td></tr>" for name, text in rows)
    return f"<table>{cells}</table>"


def _faults(said: dict[str, Any]) -> str:
    if not said["faults"]:
        return ""
    rows = []
    for fault in said["faults"]:
        lifted = "" if fault["lifted_s"] is None else f"it worked again by {fault['lifted_s']:.2f} s"
        cells = (
            str(fault["motor"]),
            f"{fault['time_s']:.2f} s",
            f"{100.0 * max(fault['effectiveness'], 0.0):.0f} %",
            f"{fault['confidence']:.2f}",
            lifted or "-",
        )
        rows.append(f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    head = "<tr><th>motor</th><th>named at</th><th>thrust left</th><th>confidence</th><th>later</th></tr>"
    return f"<h2>What happened</h2><table>{head}{''.join(rows)}</table>"


def _frame(said: dict[str, Any], vehicle: Vehicle | None) -> str:
    if vehicle is None:
        return ""
    picture = drawing.svg(frame_of(vehicle), vehicle.name, tuple(_failed(said)))
    return f'<h2>The frame, seen from above</h2><div class="frame">{picture.replace(_NAMESPACE, "", 1)}</div>'


def _done(said: dict[str, Any], vehicle: Vehicle) -> str:
    """What the companion would have done, by the allocation that it computes."""
    failed = _failed(said)
    effectiveness = np.ones(vehicle.motors)
    effectiveness[[motor - 1 for motor in failed]] = 0.0
    plan = make_plan(allocator("trim"), vehicle.effectiveness, effectiveness, vehicle.hover, catching=len(failed) > 1)
    if isinstance(plan, Plan):
        how = ", giving up yaw to keep roll and pitch" if YAW in plan.released else " on all axes"
        text = (
            f"The motors left can carry it{how}: the companion would have declared {_motors(failed)} and reallocated."
        )
    elif plan.lift:
        text = (
            "The motors left carry the weight, but cannot hold its attitude"
            f" ({plan.reason}): the companion would have declared {_motors(failed)}, and nothing could be reallocated."
        )
    else:
        text = (
            f"The motors left cannot carry it: the companion would have declared {_motors(failed)} and asked the pilot"
            " to land at once."
        )
    hover = f"It hovered at {100.0 * vehicle.hover:.0f} % of full thrust."
    return f"<h2>What the companion would have done</h2><p>{escape(text)} {escape(hover)}</p>"


def _evidence(said: dict[str, Any], vehicle: Vehicle, course: Course) -> str:
    """Measured less expected accelerations, and what the named loss explains of them."""
    faults, inside = said["faults"], np.ones(len(course.time_s), bool)
    marks = [(fault["time_s"], f"motor {fault['motor']} named") for fault in faults]
    explained = None
    if faults:
        first_s = faults[0]["time_s"]
        inside = (course.time_s >= first_s - _AROUND_S[0]) & (course.time_s <= first_s + _AROUND_S[1])
        loss = np.zeros(vehicle.motors)
        for fault in faults:
            if fault["time_s"] <= first_s + _AROUND_S[1]:
                loss[fault["motor"] - 1] = 1.0 - min(max(fault["effectiveness"], 0.0), 1.0)
        explained = -(course.thrust * loss) @ vehicle.acceleration_effectiveness.T
    parts, curves = [], list[Curve]()
    for axis, name in enumerate(AXES):
        curves = [Curve("measured, less what whole motors would give", course.residual[inside, axis], "#455a64")]
        if explained is not None:
            curves.append(
                Curve(f"what that would be with {_motors(_failed(said))} lost", explained[inside, axis], _FAILED, 2)
            )
        parts.append(plot(f"{name}, {UNITS[name]}", course.time_s[inside], curves, marks))
    said_of = (
        "Where the red curve and the grey one lie apart before the failure, and together after it, the named loss is"
        " the explanation."
        if faults
        else "What was measured is compared with what whole motors would give: a lost motor leaves a lasting step."
    )
    return "\n".join([f"<h2>Evidence</h2><p>{said_of}</p>", legend(curves), *parts])


def _effectiveness(said: dict[str, Any], course: Course) -> str:
    failed = _failed(said)
    curves = [
        Curve(
            f"motor {motor}" + (", failed" if motor in failed else ""),
            course.effectiveness[:, motor - 1],
            _FAILED_ONES[failed.index(motor) % len(_FAILED_ONES)] if motor in failed else _COLOURS[motor - 1],
            2.5 if motor in failed else 1.2,
            dashed=motor not in failed,
        )
        for motor in range(1, course.effectiveness.shape[1] + 1)
    ]
    marks = [(fault["time_s"], f"motor {fault['motor']} named") for fault in said["faults"]]
    marks += [(f["lifted_s"], f"motor {f['motor']} works again") for f in said["faults"] if f["lifted_s"] is not None]
    drawn = plot("effectiveness, 1: whole, 0: lost", course.time_s, curves, marks, (-0.3, 1.5))
    return f"<h2>The motors over the flight</h2>{legend(curves)}{drawn}"


def _made(said: dict[str, Any]) -> str:
    """How the vehicle was made, how much it explains, and what of the file could not be read."""
    airframe = said["airframe"]
    how = ["no vehicle could be made of this log"] if airframe is None else airframe["how"]
    shares = [f"{name} {'-' if share is None else format(share, '.2f')}" for name, share in said["explained"].items()]
    items = [*how, f"share of the measured variance that the model explains before any fault: {', '.join(shares)}"]
    items += [f"of the file: {note}" for note in said["notes"]]
    return f"<h2>How this was judged</h2><ul>{''.join(f'<li>{escape(str(item))}</li>' for item in items)}</ul>"
