"""One file of the state folder, its owner's alone. Every change of it is atomic and on the disk when the call returns.

Neither the file nor those beside it are written or read through a symbolic link.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from nff_companion.errors import StateFileError

_PROBE_BYTES = 8192  # more than a journal has
_SIZE_MAX = 1 << 20
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # a FIFO in its place must not hold us up


class StateFile:
    """All methods raise ``error``, whose message calls the file ``what`` and names its path."""

    def __init__(self, path: Path, what: str, error: type[StateFileError] = StateFileError) -> None:
        self.path = path
        self._what, self._error = what, error
        self._temporary = path.with_suffix(".new")
        self._trial = path.with_suffix(".probe")

    def read(self) -> bytes | None:
        """What is in it, of which a megabyte is taken at most; None: there is no file."""
        with self._named("cannot be read"):
            if not self._look(self.path):
                return None
            descriptor = os.open(self.path, _READ)  # what took its place since is not followed
            with os.fdopen(descriptor, "rb") as file:
                if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                    raise self._refusal(self.path, "is not a regular file")
                return file.read(_SIZE_MAX)

    def write(self, data: bytes) -> None:
        """Put ``data`` in place of what is there. When this raises, that stays."""
        with self._named("cannot be written"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._look(self.path)
            self._put(self._temporary, data)
            os.replace(self._temporary, self.path)
            self._sync_folder()

    def probe(self) -> None:
        """Whether it could be written: another file is, beside it, and removed."""
        with self._named("cannot be written"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._look(self.path)
            self._look(self._temporary)
            self._put(self._trial, bytes(_PROBE_BYTES))
            os.unlink(self._trial)

    def clear(self) -> None:
        """Remove it, where it is there."""
        with self._named("cannot be removed"):
            if not self._look(self.path):
                return
            os.unlink(self.path)
            self._sync_folder()

    def _put(self, path: Path, data: bytes) -> None:
        """Write a new file and sync it; what a crash left in its place is removed, when it is ours."""
        if self._look(path):
            owner = os.stat(path, follow_symlinks=False).st_uid
            if owner != os.geteuid():
                raise self._refusal(path, f"belongs to user {owner}")
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

    def _look(self, path: Path) -> bool:
        """Whether a regular file is there. Raises where something else is, and OSError when it cannot be seen."""
        try:
            mode = os.stat(path, follow_symlinks=False).st_mode
        except (FileNotFoundError, NotADirectoryError):
            return False
        if stat.S_ISLNK(mode):
            raise self._refusal(path, "is a symbolic link")
        if not stat.S_ISREG(mode):
            raise self._refusal(path, "is not a regular file")
        return True

    def _refusal(self, path: Path, why: str) -> StateFileError:
        return self._error(f"{path} {why}: the {self._what} is a file of the companion alone; remove it")

    def _named(self, failing: str) -> _Named:
        return _Named(f"{self._what} {self.path} {failing}", self._error)


class _Named:
    """Errors of the system inside become ``error``, which says ``what`` failed."""

    def __init__(self, what: str, error: type[StateFileError]) -> None:
        self._what, self._error = what, error

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError) and not isinstance(error, StateFileError):
            raise self._error(f"{self._what}: {error.strerror}") from error
