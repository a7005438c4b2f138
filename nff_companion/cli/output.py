"""What all commands share: JSON alone on standard output, everything else on standard error."""

from __future__ import annotations

import atexit
import datetime
import json
import logging
import os
import queue
import select
import sys
from logging.handlers import QueueHandler, QueueListener
from typing import Any

from rich.console import Console
from rich.text import Text

console = Console(stderr=True, markup=False)  # texts of others are no markup: whoever wants colour prints a Text

_LINES_MAX = 1000  # that wait for standard error
_END_S = 0.5  # longest time for the lines that are left when the program ends


class _IsoFormatter(logging.Formatter):
    """Local time with its offset from UTC, to the millisecond."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        """ISO 8601."""
        return datetime.datetime.fromtimestamp(record.created).astimezone().isoformat(timespec="milliseconds")


class _DroppingHandler(QueueHandler):
    """Lines into a bounded queue, from which a thread writes them: a reader who does not read holds up nobody."""

    def __init__(self) -> None:
        self.lines: queue.Queue[Any] = queue.Queue(_LINES_MAX)
        super().__init__(self.lines)
        self.dropped = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Take the record, or count it."""
        try:
            self.lines.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def handleError(self, record: logging.LogRecord) -> None:
        """A line that cannot be formatted is written as it was given; the default would write it here and now."""
        text = f"{record.msg!r} % {record.args!r}"
        self.enqueue(logging.LogRecord(record.name, record.levelno, record.pathname, record.lineno, text, None, None))


class _Writer(QueueListener):
    """Writes to the descriptor itself: a lock that this thread held at the end would hold up the interpreter's."""

    _sentinel = None  # what ends the thread

    def __init__(self, source: _DroppingHandler) -> None:
        super().__init__(source.lines)
        self._source = source
        self._reported = 0
        self._format = _IsoFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def handle(self, record: logging.LogRecord) -> None:
        """Write one line; before it, how many found no room since the last one."""
        dropped = self._source.dropped
        if dropped > self._reported:
            text = f"{dropped - self._reported} log lines were dropped: standard error was not read"
            self._reported = dropped
            self._write(logging.LogRecord("nff", logging.WARNING, "", 0, text, None, None))
        self._write(record)

    def _write(self, record: logging.LogRecord) -> None:
        data = (self._format.format(record) + "\n").encode(errors="replace")
        descriptor = sys.__stderr__.fileno() if sys.__stderr__ is not None else 2
        while data:
            try:
                data = data[os.write(descriptor, data) :]
            except BlockingIOError:  # somebody who shares it has made it so
                select.select([], [descriptor], [])
            except OSError:
                return  # closed: there is nobody left to tell

    def stop(self) -> None:
        """Write what is left, within a time limit."""
        thread = self._thread
        if thread is None:
            return
        try:
            self._source.lines.put(self._sentinel, timeout=_END_S)
        except queue.Full:
            return  # nobody reads; the thread ends with the process
        thread.join(_END_S)
        self._thread = None


def setup_logging(level: int = logging.INFO) -> None:
    """Lines with their time on standard error, written by a thread; once, unless the root logger has handlers."""
    root = logging.getLogger()
    if root.handlers:
        return
    handler = _DroppingHandler()
    writer = _Writer(handler)
    root.addHandler(handler)
    root.setLevel(level)
    logging.captureWarnings(True)
    writer.start()
    atexit.register(writer.stop)


def say(text: str) -> None:
    """A line on standard error, as it stands: texts of others are no markup."""
    console.print(text, highlight=False, soft_wrap=True)


def say_error(text: str) -> None:
    """The same, with who says it in red."""
    console.print(Text.assemble(("nff:", "red"), " ", text), soft_wrap=True)


def print_json(document: dict[str, Any]) -> None:
    """One document on standard output."""
    sys.stdout.write(json.dumps(document, indent=1, allow_nan=False) + "\n")
    sys.stdout.flush()
