"""What the autopilot's parameters were before we changed them: on disk before the first change, gone after the last one
is undone. A crash in between leaves the file, and the next start restores from it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import msgspec

from nff_companion.errors import JournalError

_PROBE_BYTES = 8192  # more than a journal has
_SIZE_MAX = 1 << 20
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a FIFO in its place must not hold us up


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter as it was found; ``kind`` is its MAV_PARAM_TYPE."""

    name: str
    value: float
    kind: int


class _Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    autopilot: str  # its unique id: another vehicle must never get these values
    parameters: list[Entry]


class Journal:
    """One file, its owner's alone. Every change of it is atomic and on the disk when the call returns.

    Neither the file nor those beside it are written or read through a symbolic link. All methods raise JournalError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._temporary = path.with_suffix(".new")
        self._trial = path.with_suffix(".probe")

    def read(self, autopilot: str) -> list[Entry]:
        """Entries of this autopilot, none when there is no journal.

        Raises JournalError also when the file cannot be understood or belongs to another autopilot.
        """
        with _Named(self.path, "cannot be read"):
            data = self._read()
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

    def _read(self) -> bytes | None:
        if not _look(self.path):
            return None
        descriptor = os.open(self.path, _READ)  # what took its place since is not followed
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise _refusal(self.path, "is not a regular file")
            return file.read(_SIZE_MAX)

    def write(self, autopilot: str, entries: list[Entry]) -> None:
        """Put the entries on the disk. When this raises, nothing may be changed."""
        data = msgspec.json.format(msgspec.json.encode(_Document(autopilot, entries)), indent=1)
        with _Named(self.path, "cannot be written"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _look(self.path)
            self._put(self._temporary, data)
            os.replace(self._temporary, self.path)
            self._sync_folder()

    def probe(self) -> None:
        """Whether it could be written: another file is, beside it, and removed."""
        with _Named(self.path, "cannot be written"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _look(self.path)
            _look(self._temporary)
            self._put(self._trial, bytes(_PROBE_BYTES))
            os.unlink(self._trial)

    def clear(self) -> None:
        """Remove the file: everything is as it was found."""
        with _Named(self.path, "cannot be removed"):
            if not _look(self.path):
                return
            os.unlink(self.path)
            self._sync_folder()

    def _put(self, path: Path, data: bytes) -> None:
        """Write a new file and sync it; what a crash left in its place is removed, when it is ours."""
        if _look(path):
            owner = os.stat(path, follow_symlinks=False).st_uid
            if owner != os.geteuid():
                raise _refusal(path, f"belongs to user {owner}")
            os.unlink(path)
        descriptor = os.open(path, _CREATE, 0o600)
        try:
            try:
                view = memoryview(data)
                while view:
                    view = view[os.write(descriptor, view) :]
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError:
            os.unlink(path)
            raise

    def _sync_folder(self) -> None:
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class _Named:
    """Errors of the system inside become a JournalError that names the journal."""

    def __init__(self, path: Path, what: str) -> None:
        self._path, self._what = path, what

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError) and not isinstance(error, JournalError):
            raise JournalError(f"journal {self._path} {self._what}: {error.strerror}") from error


def _refusal(path: Path, why: str) -> JournalError:
    return JournalError(f"{path} {why}: the journal is a file of the companion alone; remove it")


def _look(path: Path) -> bool:
    """Whether a regular file is there. Raises JournalError when something else is, OSError when it cannot be seen."""
    try:
        mode = os.stat(path, follow_symlinks=False).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return False
    if stat.S_ISLNK(mode):
        raise _refusal(path, "is a symbolic link")
    if not stat.S_ISREG(mode):
        raise _refusal(path, "is not a regular file")
    return True
