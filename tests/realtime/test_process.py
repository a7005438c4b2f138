"""Children of a trial: they die with it, and the daemon among them is scheduled as its service is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from flying import wait_for

from sitl.trials import launch
from sitl.trials.process import DaemonProcess, config_text, free_port, start

DIE_WITH_PARENT = pytest.mark.skipif(
    sys.platform != "linux", reason="children outlive a killed parent where there is no prctl"
)
PARENT = """
import sys, time
from pathlib import Path
from sitl.trials import launch
from sitl.trials.process import DaemonProcess, start
with DaemonProcess(Path(sys.argv[1]), Path(sys.argv[2])) as daemon:
    simulator = start(["sleep", "1000"])
    print(daemon.pid, simulator.pid, flush=True)
    time.sleep(1000)
"""


def config(folder: Path, port: int) -> Path:
    path = folder / "companion.toml"
    path.write_text(
        config_text(
            endpoint=f"udpin:127.0.0.1:{port}",
            airframe="octo-x",
            mode="observe",
            rate_hz=200.0,
            socket=folder / "s",
            state_folder=folder,
        ),
        encoding="utf-8",
    )
    return path


def alive(pid: int) -> bool:
    """Whether the process runs; one that ended and was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def taken(port: int) -> bool:
    """Whether somebody has the UDP port; to try it by taking it oneself would keep it from who is about to."""
    lines = Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]
    return any(int(line.split()[1].rsplit(":", 1)[1], 16) == port for line in lines)


SHARED = """
import os, time
from sitl.trials.pool import pool_of
def work(_):
    print(os.getpid(), flush=True)
    time.sleep(1000.0)
if __name__ == "__main__":
    with pool_of(2) as pool:
        pool.map(work, [1, 2], chunksize=1)
"""


@DIE_WITH_PARENT
def test_who_shares_the_work_out_takes_the_workers_along(tmp_path: Path) -> None:
    """A survey that was killed went on flying."""
    script = tmp_path / "shared.py"
    script.write_text(SHARED, encoding="utf-8")
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    children: list[int] = []
    try:
        children += [int(parent.stdout.readline()) for _ in range(2)]
        assert all(alive(pid) for pid in children)
        parent.kill()
        parent.wait()
        wait_for(lambda: not any(alive(pid) for pid in children), "the workers to die", 5.0)
    finally:
        parent.kill()
        for pid in (p for p in children if alive(p)):
            os.kill(pid, signal.SIGKILL)


@DIE_WITH_PARENT
def test_the_daemon_and_the_simulator_die_with_a_killed_parent_and_the_port_is_free(tmp_path: Path) -> None:
    port = free_port()
    arguments = [str(config(tmp_path, port)), str(tmp_path / "log")]
    parent = subprocess.Popen([sys.executable, "-c", PARENT, *arguments], stdout=subprocess.PIPE, text=True)
    children: list[int] = []
    try:
        assert parent.stdout is not None
        children = [int(word) for word in parent.stdout.readline().split()]
        assert len(children) == 2
        wait_for(lambda: taken(port), "the daemon to listen")
        assert all(alive(pid) for pid in children)
        parent.kill()
        parent.wait()
        wait_for(lambda: not any(alive(pid) for pid in children), "the children to die", 5.0)
        # The first thread may be gone before the last one, with which the socket closes.
        wait_for(lambda: not taken(port), "the port to be free", 5.0)
    finally:
        for pid in (p for p in children if alive(p)):
            os.kill(pid, signal.SIGKILL)
        parent.kill()
        parent.wait()


def test_a_child_is_the_command_itself_and_has_its_exit_code(tmp_path: Path) -> None:
    child = start([sys.executable, "-c", "import os, sys; print(os.getpid()); sys.exit(7)"], stdout=subprocess.PIPE)
    out, _ = child.communicate(timeout=20.0)
    assert int(out) == child.pid
    assert child.returncode == 7
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_command_that_is_not_there_ends_its_child_with_a_word(tmp_path: Path) -> None:
    child = start([str(tmp_path / "nothing")], stderr=subprocess.PIPE)
    _, said = child.communicate(timeout=20.0)
    assert child.returncode == 127
    assert b"nothing" in said
    assert b"Traceback" not in said


def test_the_daemon_is_scheduled_as_its_service_where_it_may_and_says_which_it_got(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with DaemonProcess(config(tmp_path, free_port()), log) as daemon:
        wait_for(lambda: "scheduling:" in log.read_text(encoding="utf-8"), "its scheduling to be said")
        policy = os.sched_getscheduler(daemon.pid)
    text = log.read_text(encoding="utf-8")
    print(text)
    if policy == os.SCHED_FIFO:
        assert "scheduling: FIFO 20" in text
    else:
        assert policy == os.SCHED_OTHER
        assert "scheduling: normal" in text


def test_where_it_may_not_the_daemon_stays_normal_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert launch.schedule(20) == "scheduling: normal (FIFO 20: Operation not permitted)"
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
