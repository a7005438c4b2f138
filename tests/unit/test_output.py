"""The log: lines with their time on standard error, which may hold up nobody."""

from __future__ import annotations

import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from nff_companion.cli import output
from nff_companion.cli.operate import _table
from sitl.trials.process import config_text, free_port

_LOGS = """
import logging, sys
from nff_companion.cli.output import setup_logging
setup_logging()
log = logging.getLogger("nff")
{body}
"""


def full_pipe() -> tuple[int, int]:
    """A pipe that takes not one byte more."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    try:
        while True:
            os.write(writing, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(writing, True)
    return reading, writing


def script(body: str, **options: Any) -> subprocess.Popen[Any]:
    return subprocess.Popen([sys.executable, "-c", _LOGS.format(body=body)], **options)


def test_a_daemon_whose_standard_error_nobody_reads_feeds_its_watchdog_and_ends(tmp_path: Path) -> None:
    config = tmp_path / "c.toml"
    config.write_text(
        config_text(
            endpoint=f"udpin:127.0.0.1:{free_port()}",
            airframe="octo-x",
            mode="observe",
            rate_hz=200.0,
            socket=tmp_path / "s",
        )
    )
    reading, writing = full_pipe()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(10.0)
        process = subprocess.Popen(
            [sys.executable, "-m", "nff_companion.cli.main", "run", "--config", str(config)],
            stdout=subprocess.DEVNULL,
            stderr=writing,
            env={**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"},
        )
        try:
            assert manager.recv(4096) == b"READY=1"
            fed = 0
            while fed < 5:
                fed += manager.recv(4096) == b"WATCHDOG=1"
            process.send_signal(signal.SIGTERM)
            assert process.wait(5.0) == 0
        finally:
            process.kill()
            process.wait()
    os.close(reading)
    os.close(writing)


def test_lines_carry_their_local_time_to_the_millisecond() -> None:
    body = 'log.warning("motor %d failed", 3)'
    process = script(body, stderr=subprocess.PIPE, text=True, env={**os.environ, "TZ": "UTC-02:00"})
    _, text = process.communicate(timeout=20)
    line = text.strip()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}\+02:00 WARNING nff: motor 3 failed", line), line


def test_what_found_no_room_is_counted_once_there_is_some() -> None:
    """In one line; in another one what was dropped before the pipe was quite full."""
    reading, writing = full_pipe()
    body = 'for k in range(20000): log.warning("line %d", k)\nprint("done", flush=True)\nsys.stdin.read()'
    with script(body, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=writing, text=True) as process:
        os.close(writing)
        assert process.stdin is not None
        assert process.stdout is not None
        if not select.select([process.stdout], [], [], 10.0)[0]:
            process.kill()
        assert process.stdout.readline() == "done\n", "the writer of the lines waited"
        process.stdin.close()
        os.set_blocking(reading, False)
        text = b""
        deadline = time.monotonic() + 10.0
        while time.monotonic() < deadline:
            if select.select([reading], [], [], 0.1)[0]:
                part = os.read(reading, 65536)
                if not part:
                    break
                text += part
    os.close(reading)
    lines = text.decode().lstrip("x").splitlines()
    reports = [re.search(r"(\d+) log lines", line) for line in lines if "dropped" in line]
    assert 1 <= len(reports) <= 2
    dropped = sum(int(found.group(1)) for found in reports if found is not None)
    assert dropped > 10000
    assert len([line for line in lines if "nff: line" in line]) == 20000 - dropped


def test_warnings_and_traces_go_the_same_way() -> None:
    body = (
        'import warnings\nwarnings.warn("strange")\ntry: 1 / 0\nexcept ZeroDivisionError: log.exception("no")\n'
        'setup_logging()\nlog.info("once")'
    )
    _, text = script(body, stderr=subprocess.PIPE, text=True).communicate(timeout=20)
    assert re.search(r"^\S+ WARNING py.warnings: .*strange", text, re.MULTILINE)
    assert "ZeroDivisionError: division by zero" in text
    assert text.count("once") == 1


@pytest.mark.parametrize(
    "text", ["none[/x].tlog is not a file", "a [[rotor]] needs", "set [log] in the file", "[red]x"]
)
def test_texts_of_others_are_no_markup(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    output.say(text)
    output.say_error(text)
    output.console.print(text)
    output.console.print(f"answer: {text}", highlight=False)
    said = capsys.readouterr().err.splitlines()
    assert said == [text, f"nff: {text}", text, f"answer: {text}"]


def test_a_status_with_brackets_in_it_is_shown_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    state: dict[str, Any] = {
        "airframe": "[lab]",
        "mode": "observe",
        "reason": "[/x] contradicts",
        "sample_age_s": None,
        "rate_hz": 1.0,
    }
    state |= {"motors": [{"motor": 1, "effectiveness": 1.0, "deviation": None, "decision": "healthy"}], "step_us": 1.0}
    state |= {"autopilot": {"allocation": "[own]"}, "unallocated": 0}
    state |= {"counters": {"bad_samples": 0, "bad_frames": 0, "dropped": 7}}
    state |= {"slow_streams": {}, "speed_sensor_faults": []}
    output.console.print(_table(state))
    said = " ".join(capsys.readouterr().err.split())
    assert "[lab]" in said
    assert "[/x] contradicts" in said
    assert "[own]" in said
    assert "dropped frames 7" in said
    assert "healthy" in said
