"""What the autopilot's parameters were before we changed them: on disk before the first change, gone after the last one
is undone. A crash in between leaves the file, and the next start restores from it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from nff_companion.errors import JournalError
from nff_companion.state_file import StateFile


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter as it was found; ``kind`` is its MAV_PARAM_TYPE."""

    name: str
    value: float
    kind: int


class _Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    autopilot: str  # its unique id: another vehicle must never get these values
    parameters: list[Entry]


class Journal:
    """One file of the state folder (state_file.py). All methods raise JournalError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = StateFile(path, "journal", JournalError)

    def read(self, autopilot: str) -> list[Entry]:
        """Entries of this autopilot, none when there is no journal.

        Raises JournalError also when the file cannot be understood or belongs to another autopilot.
        """
        data = self._file.read()
        if data is None:
            return []
        try:
            document = msgspec.json.decode(data, type=_Document)
        except (msgspec.ValidationError, msgspec.DecodeError) as error:
            raise JournalError(
                f"journal {self.path} cannot be understood ({error}): compare CA_ROTORn, then remove it"
            ) from error
        if document.autopilot != autopilot:
            raise JournalError(
                f"journal {self.path} is of autopilot {document.autopilot}, this is {autopilot}: "
                "connect that one first, or remove the file"
            )
        return list(document.parameters)

    def write(self, autopilot: str, entries: list[Entry]) -> None:
        """Put the entries on the disk. When this raises, nothing may be changed."""
        self._file.write(msgspec.json.format(msgspec.json.encode(_Document(autopilot, entries)), indent=1))

    def probe(self) -> None:
        """Whether it could be written: another file is, beside it, and removed."""
        self._file.probe()

    def clear(self) -> None:
        """Remove the file: everything is as it was found."""
        self._file.clear()
