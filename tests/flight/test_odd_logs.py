"""Logs as others have them: clocks that are set in flight, files that are none, frames told by output functions alone.
Each is judged rightly, or it is said why not; nothing of it ends in a trace."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import log_files
import pytest
from log_files import Outputs
from typer.testing import CliRunner

from nff_companion.cli.main import app
from nff_companion.mavlink.codec import Codec

OCTA = "arducopter-octa-x"
EPOCH_US = 1_710_773_350_000_000


class Asked:
    """What ``nff replay`` or ``nff why`` says; nothing but its document on standard output."""

    def __init__(self, command: str, *logs: Path | str, frame: str = "") -> None:
        options = ["--airframe", OCTA] if command == "replay" else ["--jobs", "1", "--frame", frame]
        result = CliRunner().invoke(app, [command, *map(str, logs), *options, "--json"])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        self.code, self.errors = result.exit_code, result.stderr
        self.flights: list[dict[str, Any]] = json.loads(result.stdout)["flights"]

    def motors(self) -> list[list[int]]:
        return [[fault["motor"] for fault in flight["faults"]] for flight in self.flights]


both = pytest.mark.parametrize("command", ["replay", "why"])


def with_clock_set(path: Path, at_s: float) -> Path:
    """Time since boot, and from ``at_s`` on since 1970: a receiver of satellites has set the clock."""
    codec, rows, out = Codec(1, 1), log_files.records(), []
    for stamp, _, message in rows:
        changed = copy.copy(message)
        if stamp - rows[0][0] > at_s:
            if hasattr(changed, "time_usec"):
                bits = 32 if changed.get_type() == "SERVO_OUTPUT_RAW" else 64
                changed.time_usec = (changed.time_usec + EPOCH_US) % 2**bits
            if hasattr(changed, "time_boot_ms"):
                changed.time_boot_ms = (changed.time_boot_ms + EPOCH_US // 1000) % 2**32
        out.append((stamp, codec.pack(changed)))
    return log_files.write_tlog(path, out)


@both
@pytest.mark.parametrize("at_s", [3.0, 6.5])
def test_a_clock_that_is_set_in_flight_is_a_gap(tmp_path: Path, command: str, at_s: float) -> None:
    asked = Asked(command, with_clock_set(tmp_path / "set.tlog", at_s), frame="octo-x")
    assert (asked.code, asked.motors()) == (1, [[7]])
    assert asked.flights[0]["faults"][0]["time_s"] == pytest.approx(6.04, abs=0.03)


@both
@pytest.mark.parametrize("suffix", [".tlog", ".bin", ".ulg"])
def test_a_file_that_cannot_be_looked_at_is_one_line(tmp_path: Path, command: str, suffix: str) -> None:
    loop = tmp_path / f"loop{suffix}"
    loop.symlink_to(loop.name)
    long = tmp_path / ("x" * 300 + suffix)
    good = log_files.tlog(tmp_path / "good.tlog")
    asked = Asked(command, loop, long, good)
    assert (asked.code, asked.motors()) == (2, [[7]]), "the others are judged"
    lines = asked.errors.splitlines()
    assert [line for line in lines if line.endswith(f"loop{suffix} is not a file")]
    assert [line for line in lines if line.endswith("x" + suffix + " cannot be read: File name too long")]


@both
@pytest.mark.parametrize("text", [b"", b"no log [/x] at all\n" * 50, b"\xff" * 5000, bytes(5000)])
@pytest.mark.parametrize("suffix", [".tlog", ".bin", ".ulg"])
def test_a_file_without_records_is_said_to_be_no_log(tmp_path: Path, command: str, suffix: str, text: bytes) -> None:
    path = tmp_path / f"none{suffix}"
    path.write_bytes(text)
    asked = Asked(command, path)
    assert (asked.code, asked.flights) == (2, [])
    assert str(path) in asked.errors
    assert "mmap" not in asked.errors, "it is not said in the words of a library, nor that it is empty"
    assert len(asked.errors.splitlines()) == 1


def test_a_folder_without_logs_does_not_hide_the_others(tmp_path: Path) -> None:
    (tmp_path / "empty.ulg").mkdir()
    asked = Asked("why", tmp_path / "empty.ulg", log_files.tlog(tmp_path / "good.tlog"))
    assert (asked.code, asked.motors()) == (2, [[7]])
    assert "empty.ulg: no log" in asked.errors


def test_output_functions_say_how_many_motors_a_ulog_has(tmp_path: Path) -> None:
    functions = {f"PWM_MAIN_FUNC{k + 8}": 100 + k for k in range(1, 9)} | {"SIM_GZ_EC_FUNC1": 101}
    asked = Asked("why", log_files.ulog(tmp_path / "high.ulg", Outputs(first=8), parameters=functions))
    assert (asked.code, asked.motors()) == (1, [[7]])
    assert asked.flights[0]["frame"] == "8 motors by output functions"


def test_a_start_number_that_names_no_frame_hides_no_driven_outputs(tmp_path: Path) -> None:
    asked = Asked("why", log_files.ulog(tmp_path / "own.ulg", parameters={"SYS_AUTOSTART": 22999}))
    assert (asked.code, asked.motors()) == (1, [[7]])
    assert asked.flights[0]["frame"] == "SYS_AUTOSTART 22999"
