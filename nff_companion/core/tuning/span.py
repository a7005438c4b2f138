"""Numbers with a unit, a range and a reason: how a tuning struct declares them and how they are walked and checked."""

from __future__ import annotations

import functools
import math
import types
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec

from nff_companion.errors import ConfigError

Share = Annotated[float, msgspec.Meta(ge=0.01, le=5.0)]  # never 0: it becomes a divisor
PerAxis = tuple[Share, Share, Share, Share]  # thrust, roll, pitch, yaw


def span(low: float, high: float, unit: str, why: str) -> msgspec.Meta:
    """Metadata of a number within ``low``..``high``, both allowed; ``unit`` empty: a plain number or a share."""
    return msgspec.Meta(ge=low, le=high, description=why, extra={"unit": unit})


def about(unit: str, why: str) -> msgspec.Meta:
    """Metadata of a vector whose elements carry their own range."""
    return msgspec.Meta(description=why, extra={"unit": unit})


def shown(value: Any, longest: int = 80) -> str:
    """``value`` as a message may quote it: short, whatever it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits, or lists without end
        text = f"a {type(value).__name__} beyond printing"
    return text if len(text) <= longest else f"{text[:longest]}..."


@dataclass(frozen=True, slots=True)
class Field:
    """One number, or one vector of numbers, of a struct: where it is and what is allowed."""

    path: tuple[str, ...]
    kind: type  # float or int
    length: int | None  # None: a single number
    low: float
    high: float
    unit: str
    why: str
    default: Any

    @property
    def key(self) -> str:
        """Dotted, as in TOML."""
        return ".".join(self.path)

    @property
    def allowed(self) -> str:
        """What may stand there, for people."""
        number = "whole number" if self.kind is int else "number"
        within = f"from {self.low:g} to {self.high:g}{' ' if self.unit else ''}{self.unit}"
        return f"a {number} {within}" if self.length is None else f"a list of {self.length} {number}s {within}"

    def of(self, root: Any) -> Any:
        """Value in ``root``, a struct of the type that was walked."""
        return functools.reduce(getattr, self.path, root)

    def admits(self, value: Any) -> bool:
        """Is ``value`` of the right type, finite and in range?"""
        if self.length is not None:
            return isinstance(value, (tuple, list)) and len(value) == self.length and all(map(self._admits, value))
        return self._admits(value)

    def _admits(self, value: Any) -> bool:
        if isinstance(value, bool) or not isinstance(value, int if self.kind is int else (int, float)):
            return False
        return self.low <= value <= self.high and math.isfinite(value)  # in this order: a huge int is no float


@functools.cache
def fields(struct: type[msgspec.Struct]) -> tuple[Field, ...]:
    """All numbers with a range of ``struct`` and the structs in it, in the order of their declaration."""
    return tuple(_fields(struct, ()))


def _fields(struct: type[msgspec.Struct], above: tuple[str, ...]) -> Iterator[Field]:
    hints = get_type_hints(struct, include_extras=True)
    for entry in msgspec.structs.fields(struct):
        hint, path = hints[entry.name], (*above, entry.encode_name)
        if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
            yield from _fields(hint, path)
        else:
            default = None if entry.default is msgspec.NODEFAULT else entry.default
            field = field_of(hint, path, default)
            if field is not None:
                yield field


def field_of(hint: Any, path: tuple[str, ...] = (), default: Any = None) -> Field | None:
    """The number or vector of numbers that a type ``hint`` stands for; None when it is none, or has no range."""
    base, metas = unwrapped(hint)
    length = None
    if get_origin(base) is tuple:
        elements = get_args(base)
        length = len(elements)
        base, more = unwrapped(elements[0])
        metas += more
    low = next((m.ge for m in metas if m.ge is not None), None)
    high = next((m.le for m in metas if m.le is not None), None)
    if base not in (float, int) or low is None or high is None:
        return None
    unit = next((m.extra["unit"] for m in metas if m.extra and "unit" in m.extra), "")
    why = next((m.description for m in metas if m.description), "")
    return Field(path, base, length, low, high, unit, why, default)


def unwrapped(hint: Any) -> tuple[Any, list[msgspec.Meta]]:
    """Type ``hint`` without ``Annotated`` and ``| None``, and the metadata found on the way, outermost first."""
    if get_origin(hint) is Annotated:
        base, *metas = get_args(hint)
        inner, more = unwrapped(base)
        return inner, [m for m in metas if isinstance(m, msgspec.Meta)] + more
    if get_origin(hint) in (Union, types.UnionType):
        some = [part for part in get_args(hint) if part is not type(None)]
        if len(some) == 1:
            return unwrapped(some[0])
    return hint, []


def check_fields(root: msgspec.Struct, name: str) -> None:
    """Raises ConfigError at the first number of ``root`` that is out of range; ``name`` stands before its key."""
    for field in fields(type(root)):
        value = field.of(root)
        if not field.admits(value):
            raise ConfigError(f"{name}.{field.key} = {shown(value)} is not allowed: give {field.allowed}")
