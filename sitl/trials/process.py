"""Start and end processes of a trial: a daemon, a simulator. None outlives the trial."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

from nff_companion.core import vehicle as vehicle_model

_END_S = 5.0
_LAUNCHER = Path(__file__).with_name("launch.py")
DAEMON_PRIORITY = 20  # CPUSchedulingPriority of systemd/nff-companion.service


def start(command: list[str], *, priority: int = 0, **options: Any) -> subprocess.Popen[Any]:
    """Start ``command``, which dies with the thread that calls this (on Linux), even when that is killed.

    ``priority`` above 0: under SCHED_FIFO where that is permitted; which it got is said on its standard error.
    ``options`` are those of Popen. The process id is the command's own.
    """
    launcher = [sys.executable, "-I", "-S", str(_LAUNCHER), str(os.getpid()), str(priority)]
    return subprocess.Popen([*launcher, *command], **options)


def free_port() -> int:
    """A UDP port of loopback that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def keep_files(folder: Path, keep: Path) -> None:
    """Copy a trial's folder to ``keep``; links stay links, and sockets and pipes stay behind."""

    def special(parent: str, names: list[str]) -> list[str]:
        modes = {name: os.lstat(os.path.join(parent, name)).st_mode for name in names}
        return [n for n, mode in modes.items() if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or stat.S_ISLNK(mode))]

    shutil.copytree(folder, keep, symlinks=True, dirs_exist_ok=True, ignore=special)


def config_text(
    *,
    endpoint: str,
    airframe: str,
    mode: str,
    rate_hz: float,
    socket: Path,
    thrust_to_weight: float | None = None,
    state_folder: Path | None = None,
) -> str:
    """A configuration file."""
    ratio = "" if thrust_to_weight is None else f"thrust_to_weight = {thrust_to_weight}\n"
    # By its name: also for a relative of the airframe that it was trained on.
    network = vehicle_model.load(airframe).network or "airframe"
    # Without a folder of the trial's own nothing may be left in the owner's.
    folder = "propose = false\n" if state_folder is None else f'state_folder = "{state_folder}"\n'
    return (
        f'[link]\nendpoint = "{endpoint}"\nrate_hz = {rate_hz}\n\n'
        f'[vehicle]\nairframe = "{airframe}"\nnetwork = "{network}"\n{ratio}\n'
        f'[companion]\nmode = "{mode}"\nconfirmed = true\nstatus_socket = "{socket}"\n'
        f"{folder}"
    )


class DaemonProcess:
    """``nff run`` as a child, scheduled as its service unit has it where that is permitted; a context manager."""

    def __init__(self, config: Path, log: Path | None = None, environment: dict[str, str] | None = None) -> None:
        self._log = None if log is None else log.open("ab")
        self.process = start(
            [sys.executable, "-m", "nff_companion.cli.main", "run", "--config", str(config)],
            priority=DAEMON_PRIORITY,
            stdout=subprocess.DEVNULL,
            stderr=self._log if self._log is not None else None,
            env={**os.environ, **(environment or {})},
        )

    @property
    def pid(self) -> int:
        """Process id."""
        return self.process.pid

    def kill(self) -> None:
        """SIGKILL: as a crash."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """SIGTERM, then SIGKILL when it does not end."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self.kill()
        if self._log is not None:
            self._log.close()
            self._log = None

    def __enter__(self) -> DaemonProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
