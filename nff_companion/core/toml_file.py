"""TOML files into frozen structs; what is wrong with one is said by file, dotted key, value, and what is allowed.

Lists count from 1 in messages, as motors do.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from nff_companion.core.tuning.span import field_of, shown, unwrapped
from nff_companion.errors import ConfigError

T = TypeVar("T")
Place = tuple[str | int, ...]  # keys and indices (from 0) from the root of a file to a value

_UNPRINTABLE = r"\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\ufeff"
_PRINTABLE = rf"\A[^{_UNPRINTABLE}]*\Z"
Text = Annotated[str, msgspec.Meta(pattern=_PRINTABLE, max_length=200)]  # may be empty
Name = Annotated[str, msgspec.Meta(pattern=_PRINTABLE, min_length=1, max_length=200)]


def parsed(path: Path, what: str) -> dict[str, Any]:
    """The tables of a file. Raises ConfigError: ``what`` it is, where, and why it cannot be read."""
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{what} {path} cannot be read: byte {error.start + 1} is not UTF-8 text") from error
    except OSError as error:
        raise ConfigError(f"{what} {path} cannot be read: {error.strerror or error}") from error
    except RecursionError as error:
        raise ConfigError(f"{what} {path} cannot be read: its lists or tables are nested without end") from error
    except ValueError as error:  # TOMLDecodeError, a number of thousands of digits, a path with a NUL byte
        raise ConfigError(f"{what} {str(path)!r} cannot be read: {shown(str(error), 200)}") from error


def converted(raw: dict[str, Any], struct: type[T], path: Path, what: str) -> T:
    """``raw`` as ``struct``. Raises ConfigError."""
    for place, value in _leaves(raw, ()):
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{what} {path}: {_not_allowed(struct, raw, place, 'a finite number')}")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ConfigError(f"{what} {path}: {_not_allowed(struct, raw, place, 'a number of 64 bits')}")
    try:
        return msgspec.convert(raw, struct)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{what} {path}: {explained(error, struct, raw)}") from error


def read(path: Path, struct: type[T], what: str) -> T:
    """A file as ``struct``. Raises ConfigError."""
    return converted(parsed(path, what), struct, path, what)


def allowed(hint: Any) -> str:
    """What may stand where a value of type ``hint`` is expected, for people; empty: not known."""
    field = field_of(hint)
    if field is not None:
        return field.allowed
    base, metas = unwrapped(hint)
    origin, arguments = get_origin(base), get_args(base)
    if origin is Literal:
        return "one of " + ", ".join(repr(choice) for choice in arguments)
    if base is str:
        least = any(meta.min_length for meta in metas)
        most = next((meta.max_length for meta in metas if meta.max_length), None)
        short = "" if most is None else f" of printable characters, {'1 to' if least else 'at most'} {most}"
        return f"a text{short}"
    if base is bool:
        return "true or false"
    if isinstance(base, type) and issubclass(base, msgspec.Struct):
        return f"a table of {', '.join(_keys(base))}"
    if origin is list:
        inner = allowed(arguments[0])
        return f"a list, each {inner}" if inner else "a list"
    return "a table" if origin is dict or base is dict else ""


def dotted(place: Place) -> str:
    """A place as a message names it."""
    return "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")


def _keys(struct: type[msgspec.Struct]) -> list[str]:
    return [field.encode_name for field in msgspec.structs.fields(struct)]


def _leaves(value: Any, place: Place) -> Iterator[tuple[Place, Any]]:
    """All values that are neither tables nor lists."""
    if isinstance(value, (dict, list)):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, (*place, part))
    else:
        yield place, value


def _hint_at(struct: Any, place: Place) -> Any:
    """Type declared at ``place``; None where the declaration says nothing."""
    hint = struct
    for part in place:
        base, _ = unwrapped(hint)
        if isinstance(part, int):
            arguments = get_args(base)
            hint = arguments[min(part, len(arguments) - 1)] if get_origin(base) in (list, tuple) and arguments else None
        elif isinstance(base, type) and issubclass(base, msgspec.Struct):
            hint = get_type_hints(base, include_extras=True).get(part)
        else:
            hint = None
        if hint is None:
            return None
    return hint


def _value_at(raw: Any, place: Place) -> Any:
    for part in place:
        raw = raw[part]
    return raw


def _not_allowed(struct: Any, raw: Any, place: Place, otherwise: str) -> str:
    if place and isinstance(place[-1], int) and field_of(_hint_at(struct, place[:-1])) is not None:
        place = place[:-1]  # an element of a vector: the vector is what one sets
    wanted = allowed(_hint_at(struct, place)) or otherwise
    return f"{dotted(place) or 'the file'} = {shown(_value_at(raw, place))} is not allowed: give {wanted}"


def explained(error: msgspec.ValidationError, struct: Any, raw: Any) -> str:
    """What msgspec says of ``raw``, ``... - at `$.a.b[2]` ``, in the file's own words."""
    message = str(error)
    match = re.fullmatch(r"(.*?)(?: - at `\$(.*)`)?", message, re.DOTALL)
    said, at = (message, None) if match is None else match.groups()
    place: Place = tuple(int(i) if i else key for key, i in re.findall(r"\.([^.\[\]]+)|\[(\d+)\]", at or ""))
    unknown, missing = (re.search(rf"{word} field `(.*)`", said) for word in ("unknown", "required"))
    named = unknown or missing
    if named is None:
        return _not_allowed(struct, raw, place, said)
    here, key = _hint_at(struct, place), dotted((*place, named.group(1)))
    if unknown:
        return f"{shown(key)[1:-1]} is not known: there may be {', '.join(_keys(unwrapped(here)[0]))}"
    return f"{key} is missing: give {allowed(_hint_at(here, (named.group(1),)))}"
