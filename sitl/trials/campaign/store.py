"""Rows of a campaign in a folder: a Parquet file a batch, so that nothing flown is lost when the process is killed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from nff_companion.errors import ConfigError, MissingExtra
from sitl.trials.campaign.scenario import Scenario

_SCENARIO, _PARTS, _ROWS = "campaign.json", "parts", "flights.parquet"
# Types as they stand in the file: what is None in all rows of a batch has none by itself.
_TYPES = {
    "flight": "int64",
    "airframe": "string",
    "manoeuvre": "string",
    "fault": "string",
    "motors": "list<int64>",
    "left": "double",
    "duration_s": "double",
    "slower": "double",
    "event": "string",
    "at_s": "double",
    "until_s": "double",
    "wind_m_s": "double",
    "seed": "int64",
    "act_after_s": "double",
    "level": "string",
    "named": "list<int64>",
    "either": "list<int64>",
    "more": "list<int64>",
    "unresponsive": "list<int64>",
    "weak": "list<int64>",
    "weak_left": "double",
    "worn": "list<int64>",
    "worn_sure": "list<int64>",
    "worn_left": "double",
    "said_wrong": "list<int64>",
    "among": "list<list<int64>>",
    "among_s": "double",
    "delay_s": "double",
    "wrong": "list<int64>",
    "wrong_s": "double",
    "changes": "int64",
    "flaps": "int64",
    "partly": "list<int64>",
    "partly_s": "double",
    "says": "string",
    "survived": "bool",
    "tilt_deg": "double",
    "off_m": "double",
    "low_m": "double",
    "alone_survived": "bool",
    "alone_tilt_deg": "double",
    "alone_off_m": "double",
    "alone_low_m": "double",
}


def _arrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtra("campaigns need pyarrow: pip install nff-companion[sim]") from error
    return pyarrow


class Store:
    """The folder of one campaign."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        """Makes it, or takes it up. Raises ConfigError where another campaign is in it, or it cannot be written."""
        self.folder, self._arrow = folder, _arrow()
        described = msgspec.json.format(msgspec.json.encode(scenario), indent=1)
        kept = folder / _SCENARIO
        try:
            (folder / _PARTS).mkdir(parents=True, exist_ok=True)
            if kept.exists() and kept.read_bytes() != described:
                raise ConfigError(f"{kept} is of another campaign: choose another folder, or remove this one")
            _replaced(kept, described)
        except OSError as error:
            raise ConfigError(f"folder {folder} cannot be used: {error.strerror or error}") from error

    def missing(self, batches: Iterable[tuple[int, ...]]) -> list[tuple[int, ...]]:
        """Those of ``batches`` that were not flown yet."""
        return [batch for batch in batches if not self._part(batch).exists()]

    def put(self, batch: tuple[int, ...], rows: list[dict[str, Any]]) -> None:
        """Keep the rows of ``batch``, in whole or not at all."""
        self._write(self._part(batch), self._table(rows))

    def rows(self, batches: Iterable[tuple[int, ...]]) -> list[dict[str, Any]]:
        """All that is kept of ``batches``, by flight; one file ``flights.parquet`` has them too."""
        read = self._arrow.parquet.read_table
        tables = [read(self._part(batch)) for batch in batches if self._part(batch).exists()]
        # Parts that an earlier version kept may lack a column.
        whole = self._arrow.concat_tables([*tables, self._table([])], promote_options="default").sort_by("flight")
        self._write(self.folder / _ROWS, whole)
        return list(whole.to_pylist())

    def _table(self, rows: list[dict[str, Any]]) -> Any:
        pa = self._arrow
        return pa.Table.from_pylist(rows, pa.schema([(name, self._type(kind)) for name, kind in _TYPES.items()]))

    def _type(self, kind: str) -> Any:
        """Of a name of ``_TYPES``."""
        pa = self._arrow
        inner = kind.removeprefix("list<").removesuffix(">")
        return pa.type_for_alias(kind) if inner == kind else pa.list_(self._type(inner))

    def _part(self, batch: tuple[int, ...]) -> Path:
        named = hashlib.sha256(json.dumps(batch).encode()).hexdigest()[:8]
        return self.folder / _PARTS / f"{batch[0]:08d}-{named}.parquet"

    def _write(self, path: Path, table: Any) -> None:
        beside = path.with_suffix(f".{os.getpid()}.tmp")
        self._arrow.parquet.write_table(table, beside)
        os.replace(beside, path)


def _replaced(path: Path, data: bytes) -> None:
    beside = path.with_suffix(f".{os.getpid()}.tmp")
    beside.write_bytes(data)
    os.replace(beside, path)
