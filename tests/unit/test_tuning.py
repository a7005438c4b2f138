"""The table of numbers: complete, each with unit, range and reason; what is out of range never reaches a flight."""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from nff_companion.core.tuning import DEFAULT, Tuning, check
from nff_companion.core.tuning.parameters import SERVED
from nff_companion.core.tuning.relations import RELATIONS, RISING, Relation, value_at
from nff_companion.core.tuning.span import Field, check_fields, fields
from nff_companion.daemon import configuration, document
from nff_companion.errors import ConfigError

ROOT = Path(__file__).parents[2]
FIELDS = fields(Tuning)
HEAD = '[link]\nendpoint = "udpin:127.0.0.1:14561"\n[vehicle]\nairframe = "octo-x"\n'
OF_FILES = {"airframe_file", "rotors", "network_file", "toml_file", "vehicle", "features", "sample_rate"}
# Files whose numbers are those of the table. Guards of rounding and of solvers may stay.
WITHOUT_CONSTANTS = [
    *sorted((ROOT / "nff_companion" / "allocation").glob("*.py")),
    *sorted((ROOT / "nff_companion" / "control").glob("*.py")),
    *(
        path
        for path in sorted((ROOT / "nff_companion" / "core").glob("*.py"))
        if path.stem
        not in {"airframe_file", "rotors", "network_file", "toml_file", "vehicle", "features", "sample_rate"}
    ),
]
GUARDS = {
    "_ITERATIONS",
    "_INFINITE",
    "_TINY",
    "_SPEED_MAX_M_S",
    "_SUM_MAX",
    "NOUGHT",
    "HALF",
    "_NULL",
    "_ROUNDS",
    "_PATTERN",
}


def load(tmp_path: Path, *lines: str) -> configuration.Config:
    path = tmp_path / "companion.toml"
    path.write_text(HEAD + "\n".join(lines) + "\n", encoding="utf-8")
    return configuration.load(path)


def leaves(struct: type[msgspec.Struct]) -> int:
    types = [field.type for field in msgspec.structs.fields(struct)]
    return sum(leaves(t) if isinstance(t, type) and issubclass(t, msgspec.Struct) else 1 for t in types)


def written(field: Field, bad: str) -> str:
    """``bad`` as a value of ``field``; in a vector as its last element, the others as they are."""
    if field.length is None:
        return bad
    return "[" + ", ".join([*map(repr, field.default[:-1]), bad]) + "]"


def wrong(field: Field) -> dict[str, str]:
    low = repr(field.low - max(abs(field.low), 1.0))
    high = repr(field.high + max(abs(field.high), 1.0))
    if field.kind is int:
        low, high = str(int(field.low) - 1), str(int(field.high) + 1)
    values = {
        "below": low,
        "above": high,
        "text": '"fast"',
        "truth": "true",
        "list": "[[]]",
        "table": "{}",
        "nan": "nan",
        "inf": "inf",
        "minus inf": "-inf",
        "huge": "1" + "0" * 400,
        "beyond printing": "0x" + "f" * 8000,
        "date": "1979-05-27",
    }
    if field.kind is int:
        values["not whole"] = repr(field.default + 0.5)
    return values


def test_every_number_has_a_range_a_reason_and_a_default_within() -> None:
    assert len(FIELDS) == leaves(Tuning) > 100
    for field in FIELDS:
        assert field.low < field.high, field.key
        assert math.isfinite(field.low)
        assert math.isfinite(field.high)
        assert field.admits(field.default), field.key
        assert len(field.why) > 10, field.key
        assert field.unit or not field.key.endswith(("_s", "_m", "_hz", "_deg")), field.key
    check(Tuning())


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.key)
def test_a_number_below_above_or_of_another_type_is_refused_by_file_key_value_and_range(
    tmp_path: Path, field: Field
) -> None:
    table, name = ".".join(("tuning", *field.path[:-1])), field.path[-1]
    for kind, bad in wrong(field).items():
        with pytest.raises(ConfigError) as refused:
            load(tmp_path, f"[{table}]", f"{name} = {written(field, bad)}")
        message = str(refused.value)
        for part in (str(tmp_path / "companion.toml"), f"{table}.{name} = ", field.allowed):
            assert part in message, (kind, message)
        if kind in ("below", "above", "nan", "inf", "text"):
            assert bad.strip('"') in message, (kind, message)
        assert len(message) < 500, kind


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.key)
def test_a_number_made_in_code_is_refused_by_the_check(field: Field) -> None:
    bads: tuple[Any, ...] = (
        field.low - 1.0,
        field.high * 2.0 + 1.0,
        math.nan,
        math.inf,
        -math.inf,
        True,
        "1",
        None,
        [],
        10**400,
    )
    for bad in bads:
        value = bad if field.length is None else (*field.default[:-1], bad)
        with pytest.raises(ConfigError, match=field.key):
            check(Tuning().having(field.path[0], **{field.path[1]: value}))


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.key)
def test_the_default_written_out_and_both_ends_of_the_range_are_understood(tmp_path: Path, field: Field) -> None:
    table, name = ".".join(("tuning", *field.path[:-1])), field.path[-1]
    value = field.default if field.length is None else list(field.default)
    assert load(tmp_path, f"[{table}]", f"{name} = {value!r}").tuning == DEFAULT
    for end in (field.low, field.high):
        assert field.admits(field.kind(end) if field.length is None else [end] * field.length)


@pytest.mark.parametrize("relation", RELATIONS, ids=lambda relation: relation.lower)
def test_two_numbers_at_odds_are_refused_although_each_is_in_range(relation: Relation) -> None:
    assert relation.holds(DEFAULT)
    tuning = DEFAULT
    for key, end in ((relation.lower, "high"), (relation.upper, "low")):
        subject, name, *place = key.split(".")
        field = next(field for field in FIELDS if field.key == f"{subject}.{name}")
        value = getattr(field, end)
        if field.length is not None:
            whole = field.of(tuning)
            at = int(place[0]) if place else 0
            value = (*whole[:at], value, *whole[at + 1 :])
        tuning = tuning.having(subject, **{name: value})
    assert not relation.holds(tuning)
    check_fields(tuning, "tuning")
    with pytest.raises(ConfigError, match="must be"):
        check(tuning)


@pytest.mark.parametrize("key", RISING)
def test_a_vector_that_must_rise_is_refused_when_it_does_not(key: str) -> None:
    subject, name = key.split(".")
    with pytest.raises(ConfigError, match=name):
        check(DEFAULT.having(subject, **{name: value_at(DEFAULT, key)[::-1]}))


def test_what_would_lift_a_motor_that_is_then_declared_again_is_refused() -> None:
    with pytest.raises(ConfigError, match="lift_effectiveness"):
        check(DEFAULT.having("decision", loss_gradual=0.4, lift_effectiveness=0.55))


def test_what_a_ground_station_may_set_is_in_the_table() -> None:
    assert len({served.name for served in SERVED}) == len(SERVED)
    for served in SERVED:
        assert served.field.key == served.key
        assert len(served.name) <= 16


def test_the_document_is_what_the_table_says() -> None:
    text = document.text()
    assert (ROOT / "docs" / "tuning.md").read_text(encoding="utf-8") == text, (
        "write it anew: python -m nff_companion.daemon.document > docs/tuning.md"
    )
    assert all(f"| `{field.path[-1]}` |" in text for field in FIELDS)


def constants(path: Path) -> set[str]:
    """Module-level names that are given numbers, alone or in tuples, arrays and calls."""
    found: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        numbers = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if numbers:
            found |= {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    return found


@pytest.mark.parametrize("path", WITHOUT_CONSTANTS, ids=lambda path: str(path.relative_to(ROOT / "nff_companion")))
def test_no_number_that_decides_stands_outside_the_table(path: Path) -> None:
    assert constants(path) - GUARDS == set()


def test_every_number_is_read_somewhere() -> None:
    """A key that can be set and has no effect would be a lie."""
    sources = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "nff_companion").rglob("*.py")
        if not {"tuning", "dialect"} & set(path.parent.relative_to(ROOT).parts)
    )
    unread = [field.key for field in FIELDS if not re.search(rf"\.{field.path[-1]}\b", sources)]
    assert unread == []
