"""``nff run``: one thread, one loop. Datagram in, pipeline step, commands out; everything else between samples."""

from __future__ import annotations

import contextlib
import gc
import logging
import select
import signal
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from nff_companion.autopilots.base import Adapter, Stream
from nff_companion.daemon.configuration import MODES, Config, default_status_socket
from nff_companion.daemon.notify import Notifier
from nff_companion.daemon.parameters import parameters
from nff_companion.daemon.startup import endpoints, prepare
from nff_companion.daemon.status_server import StatusServer
from nff_companion.errors import NffError
from nff_companion.mavlink.codec import Message, dialect, has_fast_crc
from nff_companion.mavlink.hub import Hub
from nff_companion.mavlink.services import host_status as host
from nff_companion.mavlink.services.parameter_server import ParameterServer
from nff_companion.mavlink.services.pilot_text import PilotText
from nff_companion.mavlink.services.streams import StreamMonitor, interval
from nff_companion.mavlink.services.timesync import TimeSync
from nff_companion.pipeline import Mode, Output, Pipeline
from nff_companion.reporting import Reporter

log = logging.getLogger("nff")

_IDLE_S = 0.05  # longest wait for a datagram: the watchdog and the heartbeat come from this loop
_HEARTBEAT_S = 1.0
_HOST_S = 2.0
_LOOK_S = 1.0


class Daemon:
    """Owns the sockets and the clock; all thinking is in the pipeline."""

    def __init__(self, config: Config, notifier: Notifier, clock: Callable[[], float] = time.monotonic) -> None:
        self._config, self._notifier, self._clock = config, notifier, clock
        self.vehicle, self._meeting = prepare(config)
        self.pipeline = Pipeline(self.vehicle, config.link.rate_hz, config.pipeline_options())
        self._poll = select.poll()
        self._hub = Hub(endpoints(config), 1, config.link.component, self._poll, clock())
        self._adapter: Adapter | None = None
        self._port: int | None = None  # of the hub, where the autopilot is heard
        self._heartbeat: Message = None  # the autopilot's last one
        self._status = StatusServer(config.companion.status_socket or default_status_socket(), self._request)
        self._poll.register(self._status.fileno(), select.POLLIN)
        self._stopping = False
        self._last_sample = -np.inf
        self._lost = True
        self._adopted = False
        self._output: Output | None = None
        self._streams = StreamMonitor()
        self._sync = TimeSync()
        self._text = PilotText()
        self._parameters = ParameterServer(parameters(self.pipeline, self._set_mode, self._lift), config.link.component)
        self.reporter = Reporter(self.vehicle, self.pipeline)
        self._next_heartbeat = self._next_watchdog = self._next_host = self._next_look = -np.inf
        if not has_fast_crc():
            log.warning("fastcrc is not installed: parsing takes four times as long; pip install fastcrc")

    # -- loop ---------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Until SIGTERM or SIGINT. Raises nothing that the link or its data may cause."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        # What exists now stays: the collector need not walk it in flight.
        gc.collect()
        gc.freeze()
        self._notifier.ready()
        log.info(
            "running: %s on %s, mode %s", self.vehicle.name, self._config.link.endpoint, self._config.companion.mode
        )
        try:
            while not self._stopping:
                self.turn(_IDLE_S)
        finally:
            self.close()

    def _stop(self, *_: object) -> None:
        self._stopping = True

    def turn(self, wait_s: float) -> None:
        """Once round the loop: wait for input, handle it, then what is due."""
        for descriptor, _ in self._poll.poll(1e3 * wait_s):
            if self._hub.owns(descriptor):
                for message, port in self._hub.read(descriptor, self._clock()):
                    self._take(message, port)
            elif descriptor == self._status.fileno():
                self._status.accept()
                for connection in self._status.connections():
                    self._poll.register(connection.fileno(), select.POLLIN)
            else:
                with contextlib.suppress(KeyError):  # an endpoint that was dropped a moment ago
                    self._poll.unregister(descriptor)  # a request, or a connection that is gone
                for connection in list(self._status.connections()):
                    if connection.fileno() == descriptor:
                        self._status.serve(connection)
        self._periodic(self._clock())

    def _take(self, message: Message, port: int) -> None:
        kind = message.get_type()
        if kind == "TIMESYNC" or kind.startswith("PARAM_"):
            answers = (
                self._sync.observe(message, time.monotonic_ns())
                if kind == "TIMESYNC"
                else self._parameters.answer(message)
            )
            self._send_all(answers, port)
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return
        if self._adapter is None and (kind != "HEARTBEAT" or not self._meet(message, port)):
            return
        adapter = self._adapter
        assert adapter is not None
        if message.get_srcSystem() != adapter.target[0]:
            if kind == "HEARTBEAT":
                self._say(f"NFF: system {message.get_srcSystem()} is heard too", dialect.MAV_SEVERITY_WARNING)
            return
        self._port = port
        if kind == "HEARTBEAT":
            self._heartbeat = message
        other = self._meeting.better(adapter, message.get_msgId())
        if other is not None:
            adapter = self._adapter = other
            adapter.observe(self._heartbeat)  # whether the vehicle is armed, a second before it is said again
            log.info("autopilot speaks our dialect")
        self._streams.heard(message.get_msgId(), self._clock())
        sample = adapter.observe(message)
        if sample is None:
            return
        began = time.perf_counter()
        if not self._adopted and adapter.applied.failed is not None:
            # After a restart in flight the autopilot knows better than we do what has been declared; what an earlier
            # flight has left behind on the ground is not taken over.
            self._adopted = True
            if self._heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED:
                self.pipeline.adopt(adapter.applied.failed)
        self.pipeline.hands_off = adapter.hands_off()
        self.pipeline.blocked = adapter.blocked(sample.time_s, self.pipeline.mode)
        override = self.pipeline.respond(sample)
        if override is not None:
            for command in adapter.drive(override, sample.time_s):
                self._send(command)
                self.reporter.commands_sent += 1
        output = self.pipeline.step(sample, override)
        for command in adapter.act(output):
            self._send(command)
            self.reporter.commands_sent += 1
        self._output, self._last_sample = output, self._clock()
        self._lost = False
        self.reporter.step_done(output, time.perf_counter() - began, self._last_sample)
        for event in output.events:
            log.warning(
                "motor %d %s: effectiveness %.2f, confidence %.3f",
                event.motor,
                "failed" if event.declared else "works again",
                event.effectiveness,
                event.confidence,
            )
            self._send(self.reporter.event_message(event), everywhere=True)
            self._say(*self.reporter.text_of(event, adapter.verdict(output)))

    def _meet(self, heartbeat: Message, port: int) -> bool:
        """The first autopilot heard is ours, unless the configuration names another: adopt its system id."""
        system = heartbeat.get_srcSystem()
        if self._config.link.system not in (0, system):
            return False
        target = (system, dialect.MAV_COMP_ID_AUTOPILOT1)
        adapter = self._meeting.first(target, heartbeat.autopilot)
        if adapter is None:
            self._say(f"NFF: autopilot {heartbeat.autopilot} is not supported", dialect.MAV_SEVERITY_ERROR)
            return False
        self._adapter, self._port, self._heartbeat = adapter, port, heartbeat
        self._hub.set_system(system)
        self._parameters.adopt(system)
        log.info("autopilot found: system %d, adapter %s", system, adapter.name)
        # An autopilot that knows our dialect obeys this, every other refuses it.
        self._send(interval(Stream(dialect.MAVLINK_MSG_ID_NFF_APPLIED, 20.0), target))
        return True

    def _send(self, message: Message, *, everywhere: bool = False) -> None:
        self._hub.send(message, None if everywhere else self._port, self._clock())

    def _send_all(self, messages: Iterable[Message], port: int | None) -> None:
        for message in messages:
            self._hub.send(message, port, self._clock())

    def _say(self, text: str, severity: int, subject: str = "") -> None:
        self._send_all(self._text.say(text, severity, self._clock(), subject), None)

    # -- between samples ----------------------------------------------------------------------------------------

    def _periodic(self, now: float) -> None:
        adapter = self._adapter
        if not self._lost and now - self._last_sample > self._config.link.stream_timeout_s:
            self._lost = True
            self._output = self.pipeline.stream_lost(f"telemetry stopped for {now - self._last_sample:.2f} s")
            self.reporter.silent(self._output)
            log.error("telemetry stopped: observing")
            self._say("NFF: telemetry stopped, observing", dialect.MAV_SEVERITY_ERROR)
        if now >= self._next_heartbeat and not self.pipeline.fault:
            # A companion whose estimator fails falls silent: whoever relies on it must see that.
            self._next_heartbeat = now + _HEARTBEAT_S
            self._send(self.reporter.heartbeat(), everywhere=True)
        self._send_all(self.reporter.due(now, self._hub.bad_frames, adapter), None)
        if now >= self._next_host:
            self._next_host = now + _HOST_S
            self._send(host.status_message(), everywhere=True)
        if adapter is not None:
            self._send_all(adapter.tick(now), self._port)
            self._send_all(self._sync.tick(time.monotonic_ns()), self._port)
            self._look(adapter, now)
        if now >= self._next_watchdog:
            self._next_watchdog = now + (self._notifier.watchdog_interval_s or 1.0)
            self._notifier.watchdog()
            self._notifier.status(self.reporter.line())
        self._hub.maintain(now)

    def _look(self, adapter: Adapter, now: float) -> None:
        """Once a second: ask for streams that do not come, and what the pilot should know of link and adapter."""
        if now < self._next_look:
            return
        self._next_look = now + _LOOK_S
        streams = adapter.streams(self._config.link.rate_hz)
        self._send_all(self._streams.requests(streams, adapter.target, now), self._port)
        self.reporter.slow_streams = {} if self._lost else self._streams.slow(streams, now)
        for name, (rate, asked) in self.reporter.slow_streams.items():
            self._say(f"NFF: {name} {rate:.0f} Hz, {asked:.0f} needed"[:50], dialect.MAV_SEVERITY_WARNING, name)
        for motor in self.pipeline.speed_faults:
            self._say(f"NFF: motor {motor} pulls but reads no speed", dialect.MAV_SEVERITY_WARNING)
        for text in adapter.complaints():
            self._say(f"NFF: {text}"[:50], dialect.MAV_SEVERITY_WARNING)
        if adapter.telemetry is not None:
            self.pipeline.describe_telemetry(adapter.telemetry)

    # -- operator -----------------------------------------------------------------------------------------------

    def _set_mode(self, mode: Mode) -> None:
        if self._adapter is not None and mode == Mode.OBSERVE and self._output is not None:
            self._send_all(self._adapter.release(self._output.time_s), self._port)
        self.pipeline.set_mode(mode)
        log.warning("operator set mode %s", mode.name.lower())

    def _lift(self, motor: int) -> None:
        self.pipeline.lift(motor)
        log.warning("operator lifted the declaration of motor %d", motor)
        if self._adapter is not None and self._output is not None:
            self._send_all(self._adapter.declare(self.pipeline.failed, self._output.time_s), self._port)

    def _request(self, request: dict[str, Any]) -> dict[str, Any]:
        command = request.get("command", "status")
        try:
            if command == "lift":
                motor = int(request["motor"])
                if not 1 <= motor <= self.vehicle.motors:
                    return {"error": f"motor {motor} does not exist: choose 1 to {self.vehicle.motors}"}
                self._lift(motor)
            elif command == "mode":
                name = str(request["mode"])
                if name not in MODES:
                    return {"error": f"mode {name!r} is unknown: choose one of {', '.join(MODES)}"}
                self._set_mode(MODES[name])
            elif command != "status":
                return {"error": f"command {command!r} is unknown: status, lift or mode"}
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            return {"error": f"bad request: {error}"}
        age = self._clock() - self._last_sample
        self.reporter.unsendable = self._hub.unsendable
        document = self.reporter.document(self._hub.bad_frames, self._adapter, None if np.isinf(age) else age)
        trip = self._sync.round_trip_s
        document["round_trip_ms"] = None if trip is None else round(1e3 * trip, 2)
        return document

    def close(self) -> None:
        """Give the vehicle back (confirmed declarations stay) and close."""
        self._notifier.stopping()
        if self._adapter is not None:
            self._leave(self._adapter)
        self._status.close()
        self._hub.close()

    def _leave(self, adapter: Adapter) -> None:
        """Commands of the end; an adapter that must see them confirmed gets a moment for it."""
        time_s = 0.0 if self._output is None else self._output.time_s
        self._send_all(adapter.release(time_s), self._port)
        deadline = self._clock() + adapter.farewell_s
        while adapter.unfinished and self._clock() < deadline:
            for descriptor, _ in self._poll.poll(20.0):
                if self._hub.owns(descriptor):
                    for message, _port in self._hub.read(descriptor, self._clock()):
                        adapter.observe(message)
            self._send_all(adapter.tick(self._clock()), self._port)


def run(config: Config) -> int:
    """Run the daemon to its end; exit code."""
    try:
        daemon = Daemon(config, Notifier())
    except NffError as error:
        log.error("%s", error)
        return 1
    daemon.run()
    return 0
