"""The daemon as a process: its handshake with the service manager, its flights, its death and its return."""

from __future__ import annotations

import json
import math
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flying import Flying, wait_for

from nff_companion.daemon.configuration import load
from nff_companion.daemon.status_server import ask
from nff_companion.errors import ConfigError, EndpointError
from nff_companion.mavlink.codec import Codec, dialect
from nff_companion.mavlink.urls import parse
from sitl import rotation
from sitl.faults import Fault
from sitl.fleet import Fleet
from sitl.trials.demo import DemoOptions, Recorder, make_fleet
from sitl.trials.process import DaemonProcess, config_text, free_port

ROOT = Path(__file__).parents[2]


def write_config(folder: Path, port: int, mode: str = "allocate", airframe: str = "octo-x") -> Path:
    path = folder / "companion.toml"
    path.write_text(
        config_text(
            endpoint=f"udpin:127.0.0.1:{port}", airframe=airframe, mode=mode, rate_hz=200.0, socket=folder / "s"
        ),
        encoding="utf-8",
    )
    return path


def state(folder: Path) -> dict[str, Any]:
    try:
        return ask(str(folder / "s"), {"command": "status"})
    except EndpointError:
        return {}


def test_ready_and_watchdog_reach_the_service_manager(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(20.0)
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
        with DaemonProcess(write_config(tmp_path, free_port()), environment=environment) as daemon:
            assert manager.recv(4096) == b"READY=1"
            heard = [manager.recv(4096) for _ in range(8)]
            assert heard.count(b"WATCHDOG=1") >= 3
            assert any(m.startswith(b"STATUS=observe: waiting for telemetry") for m in heard)
            daemon.process.terminate()
            assert daemon.process.wait(10.0) == 0
            rest = []
            manager.settimeout(0.2)
            try:
                while True:
                    rest.append(manager.recv(4096))
            except TimeoutError:
                assert b"STOPPING=1" in rest


def test_the_unit_is_what_systemd_accepts(tmp_path: Path) -> None:
    unit = (ROOT / "systemd" / "nff-companion.service").read_text(encoding="utf-8")
    assert "Type=notify" in unit
    assert "WatchdogSec=" in unit
    assert re.search(r"^Restart=always$", unit, re.MULTILINE)
    if shutil.which("systemd-analyze") is None:
        print("systemd-analyze is not on this machine: the unit was checked by its text alone")
        return
    # The installed path is the user's; here any executable stands for it.
    local = re.sub(r"^ExecStart=\S+", f"ExecStart={sys.executable}", unit, flags=re.MULTILINE)
    (tmp_path / "nff-companion.service").write_text(local, encoding="utf-8")
    result = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / "nff-companion.service")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr


def test_the_sample_configuration_is_valid() -> None:
    config = load(ROOT / "systemd" / "companion.toml.sample")
    assert config.companion.mode == "observe", "first flights observe"


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ('mode = "fly"', "companion.mode"),
        ("mode = 3", "companion.mode"),
        ('mood = "observe"', "mood"),
    ],
)
def test_configuration_errors_name_the_key(tmp_path: Path, line: str, word: str) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'[link]\nendpoint = "udpin:127.0.0.1:1"\n[vehicle]\nairframe = "octo-x"\n[companion]\n{line}\n')
    with pytest.raises(ConfigError, match=word):
        load(path)


def test_endpoints_of_both_families_mean_the_same() -> None:
    for one, other in (
        ("udpin:0.0.0.0:14550", "udpin://0.0.0.0:14550"),
        ("udpout:10.0.0.1:14550", "udpout://10.0.0.1:14550"),
        ("tcp:localhost:5760", "tcpout://localhost:5760"),
        ("/dev/ttyAMA0:921600", "serial:///dev/ttyAMA0:921600"),
    ):
        assert parse(one) == parse(other)
    for bad in ("udpin:14550", "carrier:pigeon:1", "udpin:host:99999", ""):
        with pytest.raises(ConfigError):
            parse(bad)


def test_garbage_on_the_wire_is_counted_and_ends_nothing(rng: np.random.Generator) -> None:
    codec = Codec(1, 191)
    good = Codec(1, 1).pack(dialect.MAVLink_heartbeat_message(14, 3, 128, 4, 4, 3))
    heard = 0
    for _ in range(3000):
        frame = bytearray(good)
        for _ in range(int(rng.integers(0, 4))):
            frame[int(rng.integers(len(frame)))] = int(rng.integers(256))
        heard += len(codec.parse(bytes(frame)))
        heard += len(codec.parse(rng.bytes(int(rng.integers(1, 60)))))
    assert 0 < heard < 3000
    assert codec.bad_frames > 0
    # Whatever was left in the parser, whole frames get through again.
    assert any(codec.parse(good) for _ in range(20))


class Watched:
    """A flight whose tilt and allocation are recorded each cycle."""

    def __init__(self, options: DemoOptions, port: int) -> None:
        self.fleet = make_fleet(options)
        self.recorder = Recorder(8)
        self.rows: list[tuple[float, float, int]] = []
        self.flying = Flying(
            self.fleet, [f"udpout:127.0.0.1:{port}"], on_cycle=self.cycle, on_message=self.recorder.message
        )

    def cycle(self, fleet: Fleet) -> None:
        tilt = math.degrees(float(rotation.tilt_of(fleet.state.quaternion)[0]))
        self.rows.append((fleet.time_s, tilt, int(fleet.autopilot.allocation[0])))

    def worst_tilt(self, start: float, end: float) -> float:
        return max(tilt for t, tilt, _ in self.rows if start <= t < end)


@pytest.mark.realtime
def test_killed_in_flight_it_leaves_a_flying_vehicle_and_returns_to_it(tmp_path: Path) -> None:
    port = free_port()
    watched = Watched(DemoOptions(failures=[], wind_m_s=2.0), port)
    fleet = watched.fleet
    config = write_config(tmp_path, port)
    with DaemonProcess(config) as daemon, watched.flying:
        wait_for(lambda: state(tmp_path).get("mode") == "allocate", "allocate mode")
        fleet.faults.add(Fault(vehicle=0, motor=1, start_s=fleet.time_s))
        wait_for(lambda: fleet.autopilot.allocation[0] == 2, "the matrix in force")
        failed = fleet.time_s
        assert state(tmp_path)["failed"] == [1]
        assert state(tmp_path)["mode"] == "allocate"
        wait_for(lambda: fleet.time_s > failed + 2.0, "quiet flight")
        daemon.kill()
        killed = fleet.time_s
        assert state(tmp_path) == {}
        wait_for(lambda: fleet.autopilot.allocation[0] == 1, "the dead-man to hold the confirmed declaration")
        assert fleet.time_s - killed < 1.0
        wait_for(lambda: fleet.time_s > killed + 2.0, "flight without a companion")
        assert not fleet.state.crashed[0]
        assert fleet.autopilot.output[0, 0] == 0.0, "the dead motor stays stopped"
        before = watched.worst_tilt(killed + 0.5, fleet.time_s)
        with DaemonProcess(config):
            wait_for(lambda: fleet.autopilot.allocation[0] == 2, "the restarted companion to take up again")
            again = fleet.time_s
            wait_for(lambda: bool(state(tmp_path).get("failed")), "the status of the restarted companion")
            assert state(tmp_path)["failed"] == [1]
            wait_for(lambda: state(tmp_path)["autopilot"]["allocation"] == "matrix", "the autopilot's word on it")
            wait_for(lambda: fleet.time_s > again + 2.0, "two seconds more")
            after = watched.worst_tilt(again, again + 2.0)
            print(f"peak tilt {before:.2f} deg without the companion, {after:.2f} deg in the 2 s after its return")
            assert after <= before + 2.0
    assert not fleet.state.crashed[0]
    assert [e[1] for e in watched.recorder.trace.events if e[2]] == [1], "declared once, taken over after the restart"


@pytest.mark.realtime
def test_a_real_process_flies_in_override_and_the_autopilot_takes_over_when_it_dies(tmp_path: Path) -> None:
    port = free_port()
    watched = Watched(DemoOptions(failures=[], wind_m_s=2.0), port)
    fleet = watched.fleet
    with DaemonProcess(write_config(tmp_path, port, "override")) as daemon, watched.flying:
        wait_for(lambda: fleet.autopilot.allocation[0] == 3, "outputs of the companion in force")
        start = fleet.time_s
        wait_for(lambda: fleet.time_s > start + 2.5, "seconds of override")
        share = np.mean([a == 3 for t, _, a in watched.rows if t > start + 0.5])
        assert share > 0.98
        answer = ask(str(tmp_path / "s"), {"command": "mode", "mode": "nonsense"})
        assert "choose one of" in answer["error"]
        daemon.kill()
        killed = fleet.time_s
        wait_for(lambda: fleet.autopilot.allocation[0] == 0, "stock mixing")
        assert fleet.time_s - killed < 0.4
        wait_for(lambda: fleet.time_s > killed + 1.5, "flight on stock mixing")
    assert not fleet.state.crashed[0]
    assert not any(fleet.autopilot.ports[0].refused.values())


@pytest.mark.realtime
def test_telemetry_that_stops_is_observed_and_said(tmp_path: Path) -> None:
    port = free_port()
    watched = Watched(DemoOptions(failures=[]), port)
    with DaemonProcess(write_config(tmp_path, port)):
        with watched.flying:
            wait_for(lambda: state(tmp_path).get("mode") == "allocate", "allocate mode")
        wait_for(lambda: "telemetry stopped" in state(tmp_path).get("reason", ""), "the reason")
        assert state(tmp_path)["mode"] == "observe"
        assert state(tmp_path)["rate_hz"] == 0.0


def test_status_and_lift_commands_print_one_json_document(tmp_path: Path) -> None:
    nff = [sys.executable, "-m", "nff_companion.cli.main"]
    with DaemonProcess(write_config(tmp_path, free_port())):
        wait_for(lambda: bool(state(tmp_path)), "the daemon")
        for arguments, code in ((["status", "--json"], 0), (["lift", "3", "--json"], 0), (["lift", "9", "--json"], 1)):
            result = subprocess.run(
                [*nff, *arguments, "--socket", str(tmp_path / "s")], capture_output=True, text=True, check=False
            )
            assert result.returncode == code, result.stderr
            document = json.loads(result.stdout)
            assert ("error" in document) == bool(code)
    gone = subprocess.run(
        [*nff, "status", "--once", "--socket", str(tmp_path / "s")], capture_output=True, text=True, check=False
    )
    assert gone.returncode == 2
    assert "no daemon answers" in gone.stderr


def test_an_unknown_airframe_ends_the_start_with_a_message(tmp_path: Path) -> None:
    text = config_text(
        endpoint="udpin:127.0.0.1:1", airframe="octo-x", mode="observe", rate_hz=200, socket=tmp_path / "s"
    )
    (tmp_path / "c.toml").write_text(text.replace('airframe = "octo-x"', 'airframe = "no-such"'))
    with DaemonProcess(tmp_path / "c.toml") as daemon:
        assert daemon.process.wait(20.0) == 1, "an unknown airframe ends the start with a message, not a trace"
