"""docs/tuning.md, made of the declarations: ``python -m nff_companion.daemon.document > docs/tuning.md``."""

from __future__ import annotations

import inspect
from typing import Any, get_type_hints

import msgspec

from nff_companion.core.toml_file import allowed
from nff_companion.core.tuning import Tuning
from nff_companion.core.tuning.parameters import SERVED
from nff_companion.core.tuning.relations import RELATIONS, RISING, Relation, key_of
from nff_companion.core.tuning.span import field_of, unwrapped
from nff_companion.daemon.configuration import Config

_HEAD = """# Configuration and tuning

Made by `python -m nff_companion.daemon.document > docs/tuning.md`; do not edit. Every option of a configuration file
with its default, what is allowed, and why it is as it is. A file that says anything else is refused when it is loaded,
with file, key, value and range. Vectors are thrust, roll, pitch, yaw unless said otherwise.

The numbers under `[tuning.*]` are one set for all airframes: losses and noises are scaled by the airframe. Change one
only with flights, or their logs, that show what it does.
"""


def text() -> str:
    """The whole document."""
    parts = [_HEAD]
    hints = get_type_hints(Config, include_extras=True)
    parts += [_section(name, hints[name]) for name in ("link", "vehicle", "companion")]
    hints = get_type_hints(Tuning, include_extras=True)
    parts += [_section(f"tuning.{field.name}", hints[field.name]) for field in msgspec.structs.fields(Tuning)]
    parts.append(
        "## What must hold between two numbers\n\n| | | why |\n|---|---|---|\n" + "\n".join(map(_held, RELATIONS))
    )
    rising = ", ".join(f"`{key}`" for key in RISING)
    parts.append(f"The elements of {rising} rise. `decision.lift_effectiveness` > 1 - `decision.loss_gradual`.\n")
    rows = "\n".join(f"| {s.name} | `{s.key}` | {s.field.low:g} to {s.field.high:g} |" for s in SERVED)
    parts.append(
        "## By MAVLink's parameter protocol\n\nA ground station sets them on the ground, for the next flight."
        f" NFF_FAILED_MAX is at most half of the motors.\n\n| parameter | key | range |\n|---|---|---|\n{rows}\n"
    )
    return "\n".join(parts)


def _held(relation: Relation) -> str:
    return f"| `{key_of(relation.lower)}` | {relation.sign} `{key_of(relation.upper)}` | {relation.why} |"


def _section(table: str, struct: type[msgspec.Struct]) -> str:
    hints = get_type_hints(struct, include_extras=True)
    rows = [_row(field, hints[field.name]) for field in msgspec.structs.fields(struct)]
    about = " ".join((inspect.getdoc(struct) or "").split())
    about = "" if about.startswith("``[") else f"{about}\n\n"
    return (
        f"## [{table}]\n\n{about}| key | default | unit | allowed | why |\n|---|---|---|---|---|\n"
        + "\n".join(rows)
        + "\n"
    )


def _row(field: Any, hint: Any) -> str:
    number = field_of(hint)
    _, metas = unwrapped(hint)
    why = next((meta.description for meta in metas if meta.description), "")
    if number is None:
        unit, range_ = "", allowed(hint)
    else:
        unit = number.unit
        range_ = f"{number.low:g} to {number.high:g}" + (", whole" if number.kind is int else "")
        range_ += "" if number.length is None else f", each of {number.length}"
    return f"| `{field.encode_name}` | {_default(field)} | {unit} | {range_} | {why} |"


def _default(field: Any) -> str:
    if field.default is msgspec.NODEFAULT and field.default_factory is msgspec.NODEFAULT:
        return "to be given"
    value = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
    if isinstance(value, tuple):
        return ", ".join(f"{element:g}" for element in value)
    if isinstance(value, float):
        return f"{value:g}"
    return "none" if value is None else f'`"{value}"`' if isinstance(value, str) else str(value)


if __name__ == "__main__":
    print(text(), end="")
