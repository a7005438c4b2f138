"""How long from a declaration to a changed motor output on a real ArduCopter, and what the link carries meanwhile."""

from __future__ import annotations

import select
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nff_companion.autopilots.ardupilot import tunnel
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.ardupilot.tunnel import Kind, TunnelMessage
from nff_companion.core import vehicle as vehicle_model
from nff_companion.errors import TunnelError
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, Message
from nff_companion.mavlink.endpoint import Endpoint, open_endpoint
from nff_companion.mavlink.services.streams import interval
from sitl.trials.fly.arducopter import FlyOptions, Simulator, companion_port, take_off
from sitl.trials.fly.pilot import FlightError, Pilot

_TARGET = (1, 1)
_INSTANCE = 1  # the only companion
_LISTEN_S = 3.0
_ANSWER_S = 2.0
_SETTLE_S = 0.4
_STOPPED_US = 1000
_BITS = 10  # of a byte on a serial line


@dataclass(slots=True)
class _Line:
    """Our end of the companion's link: parses, counts bytes, remembers the newest outputs and answers."""

    endpoint: Endpoint
    codec: Codec = field(default_factory=lambda: Codec(_TARGET[0], COMPANION_COMPONENT))
    received: int = 0
    sent: int = 0
    outputs: list[int] = field(default_factory=list)
    outputs_ms: int = 0
    acknowledged: int = -1
    sequence: int = 0

    def send(self, message: Message) -> None:
        """Send and count."""
        data = self.codec.pack(message)
        self.sent += len(data)
        self.endpoint.send(data)

    def listen(self, seconds: float) -> None:
        """Wait for input at most so long, and take it."""
        if not select.select([self.endpoint.fileno()], [], [], max(seconds, 0.0))[0]:
            return
        for data, _ in self.endpoint.receive():
            self.received += len(data)
            for message in self.codec.parse(data):
                self._take(message)

    def _take(self, message: Message) -> None:
        kind = message.get_type()
        if kind == "SERVO_OUTPUT_RAW" and message.port == 0:
            self.outputs = [getattr(message, f"servo{i}_raw") for i in range(1, 13)]
            self.outputs_ms = message.time_usec // 1000
        elif kind == "TUNNEL":
            try:
                inner = tunnel.unwrap(message)
            except TunnelError as error:
                raise FlightError(f"the applet answers with something else: {error}") from error
            if inner is not None and inner.kind == Kind.APPLIED:
                self.acknowledged = inner.values["declaration_sequence"]

    def declare(self, mask: int) -> int:
        """Send a declaration; its sequence number."""
        self.sequence = tunnel.following(self.sequence)
        values = {"sequence": self.sequence, "instance": _INSTANCE, "sample_ms": self.outputs_ms, "failed": mask}
        self.send(tunnel.wrap(TunnelMessage(Kind.DECLARATION, values).pack(), _TARGET))
        return self.sequence

    def heartbeat(self) -> None:
        """The applet's, and MAVLink's."""
        self.sequence = tunnel.following(self.sequence)
        values = {"sequence": self.sequence, "instance": _INSTANCE}
        self.send(tunnel.wrap(TunnelMessage(Kind.HEARTBEAT, values).pack(), _TARGET))


def measure(binary: Path, rates_hz: list[float], count: int) -> dict[str, Any]:
    """Declare ``count`` times at each telemetry rate, in hover. Raises FlightError, ConfigError."""
    options = FlyOptions(binary=binary, wind_m_s=0.0)
    vehicle = vehicle_model.load(options.airframe)
    pilot = Pilot("tcp:127.0.0.1:5760")
    rows = []
    with (
        tempfile.TemporaryDirectory(prefix="nff-fly-") as folder,
        Simulator(options, vehicle, Path(folder), with_applet=True),
    ):
        try:
            pilot.connect(30.0)
            take_off(pilot, options)
            pilot.set_parameter("SIM_SPEEDUP", 1.0)
            line = _Line(open_endpoint(f"tcp:127.0.0.1:{companion_port(options)}"))
            try:
                for rate in rates_hz:
                    streams = ArduPilotAdapter(vehicle, _TARGET, {}, _INSTANCE).streams(rate)
                    for stream in streams:
                        line.send(interval(stream, _TARGET))
                    rows.append(_at_rate(line, pilot, vehicle.motors, rate, count))
            finally:
                line.endpoint.close()
        finally:
            pilot.close()
    return {"options": {"rates_hz": rates_hz, "count": count}, "rates": rows}


def _at_rate(line: _Line, pilot: Pilot, motors: int, rate_hz: float, count: int) -> dict[str, Any]:
    began, received, sent = time.perf_counter(), line.received, line.sent
    while time.perf_counter() - began < _LISTEN_S:
        line.heartbeat()
        line.listen(0.1)
        pilot.pump(0.0)
    elapsed = time.perf_counter() - began
    down, up = (line.received - received) / elapsed, (line.sent - sent) / elapsed
    changed: list[float] = []
    echoed: list[float] = []
    lost = 0
    for k in range(count):
        motor = k % motors
        sequence = line.declare(1 << motor)
        began = time.perf_counter()
        first = echo = None
        while (first is None or echo is None) and time.perf_counter() - began < _ANSWER_S:
            line.listen(began + _ANSWER_S - time.perf_counter())
            now = time.perf_counter() - began
            if first is None and line.outputs and line.outputs[motor] <= _STOPPED_US:
                first = now
            if echo is None and line.acknowledged == sequence:
                echo = now
        if first is None or echo is None:
            lost += 1
        else:
            changed.append(first)
            echoed.append(echo)
        line.declare(0)
        began = time.perf_counter()
        while line.outputs[motor] <= _STOPPED_US and time.perf_counter() - began < _ANSWER_S:
            line.listen(_ANSWER_S)
        settled = time.perf_counter() + _SETTLE_S
        while time.perf_counter() < settled:
            line.heartbeat()
            line.listen(0.1)
            pilot.pump(0.0)

    def percentile(values: list[float], share: float) -> float | None:
        return round(1e3 * float(np.percentile(values, share)), 2) if values else None

    return {
        "rate_hz": rate_hz,
        "output_changed_p50_ms": percentile(changed, 50),
        "output_changed_p99_ms": percentile(changed, 99),
        "acknowledged_p50_ms": percentile(echoed, 50),
        "acknowledged_p99_ms": percentile(echoed, 99),
        "declarations": count,
        "lost": lost,
        "down_bytes_per_s": round(down),
        "up_bytes_per_s": round(up),
        "share_of_921600_baud": round(_BITS * down / 921600, 3),
    }
