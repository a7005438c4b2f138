"""What the autopilot's parameters were before we changed them: on disk before the first change, gone after the last one
is undone. A crash in between leaves the file, and the next start restores from it."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from nff_companion.errors import JournalError


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter as it was found; ``kind`` is its MAV_PARAM_TYPE."""

    name: str
    value: float
    kind: int


class _Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    autopilot: str  # its unique id: another vehicle must never get these values
    parameters: list[Entry]


class Journal:
    """One file. Every change of it is atomic and on the disk when the call returns."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self, autopilot: str) -> list[Entry]:
        """Entries of this autopilot, none when there is no journal.

        Raises JournalError when the file cannot be understood or belongs to another autopilot.
        """
        try:
            document = msgspec.json.decode(self.path.read_bytes(), type=_Document)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise JournalError(f"journal {self.path} cannot be read: {error.strerror}") from error
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
        """Put the entries on the disk. Raises JournalError; then nothing may be changed."""
        data = msgspec.json.format(msgspec.json.encode(_Document(autopilot, entries)), indent=1)
        temporary = self.path.with_suffix(".new")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self.path)
            self._sync_folder()
        except OSError as error:
            raise JournalError(
                f"journal {self.path} cannot be written: {error.strerror}; nothing was changed"
            ) from error

    def clear(self) -> None:
        """Remove the file: everything is as it was found. Raises JournalError."""
        try:
            self.path.unlink(missing_ok=True)
            if self.path.parent.exists():
                self._sync_folder()
        except OSError as error:
            raise JournalError(f"journal {self.path} cannot be removed: {error.strerror}") from error

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
