"""A child that dies with its parent: binds itself to it, takes its scheduling, and becomes the command.

Run by its path, before the command, as ``launch.py PARENT PRIORITY COMMAND ...``: what must happen between fork and
exec would not be safe in a parent with threads. Imports nothing but the standard library.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1
_NOT_FOUND = 127  # as a shell has it


def bind_to(parent: int) -> None:
    """Be killed when the thread that started us ends. Only Linux can; elsewhere the child outlives a killed parent."""
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        sys.stderr.write(f"this process may outlive its parent: {os.strerror(ctypes.get_errno())}\n")
    if os.getppid() != parent:
        sys.exit(f"the parent {parent} is gone already")


def schedule(priority: int) -> str:
    """Ask for SCHED_FIFO, as the service unit does; what came of it."""
    if not hasattr(os, "sched_setscheduler"):
        return "scheduling: normal (this system has no other)"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f"scheduling: normal (FIFO {priority}: {error.strerror})"
    return f"scheduling: FIFO {priority}"


def main() -> None:
    """Never returns."""
    parent, priority, command = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    bind_to(parent)
    if priority:
        sys.stderr.write(schedule(priority) + "\n")
    sys.stderr.flush()
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.stderr.write(f"{command[0]} cannot be started: {error.strerror}\n")
        sys.exit(_NOT_FOUND)


if __name__ == "__main__":
    main()
