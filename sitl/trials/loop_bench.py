"""``nff bench loop``: the daemon in its own process, fed over loopback, beside a bare pymavlink echo."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import select
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.errors import NffError
from nff_companion.mavlink.codec import Codec, Message, dialect
from sitl.fleet import AUTOPILOT_RATE_HZ
from sitl.telemetry import Telemetry
from sitl.trials.demo import DemoOptions, make_fleet
from sitl.trials.process import DAEMON_PRIORITY, DaemonProcess, config_text, free_port

_WARM_UP_S = 4.0
_TIMEOUT_S = 0.5
_ANSWER_S = 0.02
_SAMPLE = (
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU,
)


def echo(port: int, ready: Any) -> None:
    """The peer: parse one message, pack one, until told to stop (COMMAND_LONG)."""
    with contextlib.suppress(OSError):  # scheduled as the daemon is, where that is permitted
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(DAEMON_PRIORITY))
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))
        sock.setblocking(False)
        poll = select.poll()
        poll.register(sock.fileno(), select.POLLIN)
        ready.set()
        outputs = [0.5] * 16
        while True:
            poll.poll(1000)
            try:
                data, sender = sock.recvfrom(65535)
            except BlockingIOError:
                continue
            for message in mav.parse_buffer(data) or []:
                if message.get_type() == "COMMAND_LONG":
                    return
                answer = dialect.MAVLink_nff_actuator_override_message(message.time_usec, 1, 100, 1, 1, 8, outputs)
                sock.sendto(answer.pack(mav), sender)


class _Feeder:
    """Sends the frames of one sample and waits for the override that carries its time."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._peer = ("127.0.0.1", port)
        self._poll = select.poll()
        self._poll.register(self._socket.fileno(), select.POLLIN)
        self._codec = Codec(1, 1)
        self._replies = Codec(1, 1)
        self.sequence = -1

    def send(self, message: Message) -> float:
        """Time when it was handed over, taken before: a daemon of higher priority runs before sendto returns."""
        data = self._codec.pack(message)
        sent = time.perf_counter()
        self._socket.sendto(data, self._peer)
        return sent

    def answer(self, sample_usec: int, until: float) -> float | None:
        """Time of the override for ``sample_usec``; None when it does not come."""
        while True:
            left = until - time.perf_counter()
            if left <= 0.0:
                return None
            if not self._poll.poll(1e3 * left):
                continue
            try:
                data = self._socket.recv(65535)
            except (BlockingIOError, ConnectionRefusedError):
                continue
            arrived = time.perf_counter()
            for message in self._replies.parse(data):
                if message.get_type() != "NFF_ACTUATOR_OVERRIDE" or message.sample_usec != sample_usec:
                    continue
                if message.sequence <= self.sequence and self.sequence > 1:
                    raise NffError(f"override sequence went from {self.sequence} to {message.sequence}")
                self.sequence = message.sequence
                return arrived

    def close(self) -> None:
        self._socket.close()


def _recorded(rate_hz: float, seconds: float, airframe: str) -> list[list[Message]]:
    """Messages of each sample of a hover in wind, made beforehand: the plant must not share the clock."""
    fleet = make_fleet(DemoOptions(airframe=airframe, failures=[], wind_m_s=4.0))
    telemetry = Telemetry(fleet)
    every = max(round(AUTOPILOT_RATE_HZ / rate_hz), 1)
    samples = []
    for _ in range(int(seconds * AUTOPILOT_RATE_HZ)):
        fleet.step()
        if fleet.cycle % every == 0:
            samples.append([telemetry.makers[message_id]() for message_id in _SAMPLE])
    return samples


def _percentiles(values: list[float]) -> list[float]:
    return [round(1e6 * float(np.percentile(values, p)), 1) for p in (50.0, 99.0, 99.9)]


def measure(*, rate_hz: float, seconds: float, airframe: str) -> dict[str, Any]:
    """The document of ``nff bench loop``. Raises NffError when the daemon does not answer."""
    samples = _recorded(rate_hz, _WARM_UP_S + seconds, airframe)
    period = 1.0 / rate_hz
    echo_port, port = free_port(), free_port()
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    peer = context.Process(target=echo, args=(echo_port, ready), daemon=True)
    peer.start()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "companion.toml"
        config.write_text(
            config_text(
                endpoint=f"udpin:127.0.0.1:{port}",
                airframe=airframe,
                mode="override",
                rate_hz=rate_hz,
                socket=folder / "status.sock",
            ),
            encoding="utf-8",
        )
        with DaemonProcess(config, folder / "companion.log") as daemon:
            feeder, echoer = _Feeder(port), _Feeder(echo_port)
            try:
                ready.wait(10.0)
                return _measure(feeder, echoer, daemon, samples, period)
            finally:
                echoer.send(dialect.MAVLink_command_long_message(1, 1, 0, 0, *[0.0] * 7))
                feeder.close()
                echoer.close()
                peer.join(2.0)


def _measure(
    feeder: _Feeder, echoer: _Feeder, daemon: DaemonProcess, samples: list[list[Message]], period: float
) -> dict[str, Any]:
    heartbeat = dialect.MAVLink_heartbeat_message(14, 3, 128, 4, 4, 3)
    _wait_until_up(feeder, daemon, heartbeat)
    loop_s: list[float] = []
    echo_s: list[float] = []
    missed = 0
    warm = int(_WARM_UP_S / period)
    cpu_began, wall_began = 0.0, 0.0
    due = time.perf_counter()
    for k, sample in enumerate(samples):
        if k == warm:
            cpu_began, wall_began = _cpu_s(daemon.pid), time.perf_counter()
        if k % max(round(0.5 / period), 1) == 0:
            feeder.send(heartbeat)
            feeder.send(dialect.MAVLink_nff_applied_message(sample[-1].time_usec, *[0] * 12))
        for message in sample:
            sent = feeder.send(message)
        answered = feeder.answer(sample[-1].time_usec, sent + (_ANSWER_S if k >= warm else 0.5 * period))
        if k >= warm:
            if answered is None:
                missed += 1
            else:
                loop_s.append(answered - sent)
            sent = echoer.send(sample[-1])
            echoed = echoer.answer(sample[-1].time_usec, sent + _ANSWER_S)
            echoer.sequence = -1
            if echoed is not None:
                echo_s.append(echoed - sent)
        due += period
        left = due - time.perf_counter()
        if left > 0.0:
            time.sleep(left)
        else:
            due = time.perf_counter()
    if not loop_s or not echo_s:
        raise NffError("the daemon sent no override: see its log")
    wall = time.perf_counter() - wall_began
    p50, p99, p999 = _percentiles(loop_s)
    echo_p50 = _percentiles(echo_s)[0]
    return {
        "p50_us": p50,
        "p99_us": p99,
        "p999_us": p999,
        "echo_p50_us": echo_p50,
        "ratio_p50": round(p50 / echo_p50, 2),
        "cpu_percent": round(100.0 * (_cpu_s(daemon.pid) - cpu_began) / wall, 1),
        "rss_mb": round(_rss_mb(daemon.pid), 1),
        "samples": len(loop_s),
        "missed": missed,
    }


def _wait_until_up(feeder: _Feeder, daemon: DaemonProcess, heartbeat: Message) -> None:
    deadline = time.perf_counter() + 30.0
    while True:
        feeder.send(heartbeat)
        if feeder._poll.poll(50):
            return
        if daemon.process.poll() is not None or time.perf_counter() > deadline:
            raise NffError("the daemon did not come up")


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rss_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024.0
    raise NffError(f"process {pid} has no VmRSS")
