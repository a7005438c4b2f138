"""``nff run``: one thread, one loop. Datagram in, pipeline step, commands out; everything else between samples."""

from __future__ import annotations

import gc
import logging
import select
import signal
import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from nff_companion import vehicle as vehicle_model
from nff_companion.autopilots.nff_dialect import NffDialectAdapter
from nff_companion.config import MODES, Config, default_status_socket
from nff_companion.errors import EndpointError, NffError
from nff_companion.link.codec import Codec, Message, dialect, has_fast_crc
from nff_companion.link.endpoint import Endpoint, open_endpoint
from nff_companion.notify import Notifier
from nff_companion.pipeline import Mode, Output, Pipeline
from nff_companion.reporting import Reporter
from nff_companion.status_server import StatusServer

log = logging.getLogger("nff")

_IDLE_S = 0.05  # longest wait for a datagram: the watchdog and the heartbeat come from this loop
_RECONNECT_S = 1.0
_STREAM_REQUEST_S = 1.0


class Daemon:
    """Owns the sockets and the clock; all thinking is in the pipeline."""

    def __init__(self, config: Config, notifier: Notifier, clock: Callable[[], float] = time.monotonic) -> None:
        self._config, self._notifier, self._clock = config, notifier, clock
        self.vehicle = vehicle_model.load(config.vehicle.airframe, thrust_to_weight=config.vehicle.thrust_to_weight)
        self.pipeline = Pipeline(self.vehicle, config.link.rate_hz, config.pipeline_options())
        self._codec = Codec(1, config.link.component)
        self._endpoint: Endpoint | None = open_endpoint(config.link.endpoint)
        self._adapter: NffDialectAdapter | None = None
        self._status = StatusServer(config.companion.status_socket or default_status_socket(), self._request)
        self._poll = select.poll()
        self._poll.register(self._status.fileno(), select.POLLIN)
        self._poll.register(self._endpoint.fileno(), select.POLLIN)
        self._stopping = False
        self._last_sample = -np.inf
        self._lost = True
        self._adopted = False
        self._heard: dict[int, float] = {}  # message id to its last arrival
        self._output: Output | None = None
        self.reporter = Reporter(self.vehicle, self.pipeline)
        self._next_heartbeat = self._next_watchdog = self._next_request = self._next_reconnect = -np.inf
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
            if self._endpoint is not None and descriptor == self._endpoint.fileno():
                self._read()
            elif descriptor == self._status.fileno():
                self._status.accept()
                for connection in self._status.connections():
                    self._poll.register(connection.fileno(), select.POLLIN)
            else:
                self._poll.unregister(descriptor)  # a request, or a connection that is gone
                for connection in list(self._status.connections()):
                    if connection.fileno() == descriptor:
                        self._status.serve(connection)
        self._periodic(self._clock())

    def _read(self) -> None:
        assert self._endpoint is not None
        try:
            for data in self._endpoint.receive():
                for message in self._codec.parse(data):
                    self._take(message)
        except EndpointError as error:
            self._drop_endpoint(error)

    def _take(self, message: Message) -> None:
        if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
            return
        if self._adapter is None:
            if message.get_type() != "HEARTBEAT":
                return
            self._meet(message.get_srcSystem())
        adapter = self._adapter
        assert adapter is not None
        if message.get_srcSystem() != adapter.target[0]:
            return
        self._heard[message.get_msgId()] = self._clock()
        sample = adapter.observe(message)
        if sample is None:
            return
        began = time.perf_counter()
        if not self._adopted and adapter.applied.failed is not None:
            # After a restart in flight the autopilot knows better than we do what has been declared.
            self._adopted = True
            self.pipeline.adopt(adapter.applied.failed)
        self.pipeline.blocked = adapter.blocked(sample.time_s)
        override = self.pipeline.respond(sample)
        if override is not None:
            self._send(adapter.drive(override, sample.time_s))
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
            self._send(self.reporter.event_message(event))
            self._send(self.reporter.text_message(event))

    def _meet(self, system: int) -> None:
        """The first autopilot heard is ours: adopt its system id."""
        self._codec.system = system
        self._adapter = NffDialectAdapter(self.vehicle, (system, dialect.MAV_COMP_ID_AUTOPILOT1))
        log.info("autopilot found: system %d", system)

    def _send(self, message: Message) -> None:
        if self._endpoint is None:
            return
        try:
            self._endpoint.send(self._codec.pack(message))
        except EndpointError as error:
            self._drop_endpoint(error)
        except struct.error as error:
            # A value that its field cannot hold: said, counted, not sent.
            self.reporter.unsendable += 1
            log.error("%s cannot be packed: %s", message.get_type(), error)

    def _drop_endpoint(self, error: EndpointError) -> None:
        log.error("%s; trying again every %.0f s", error, _RECONNECT_S)
        if self._endpoint is not None:
            self._poll.unregister(self._endpoint.fileno())
            self._endpoint.close()
        self._endpoint = None
        self._next_reconnect = self._clock() + _RECONNECT_S

    # -- between samples ----------------------------------------------------------------------------------------

    def _periodic(self, now: float) -> None:
        if not self._lost and now - self._last_sample > self._config.link.stream_timeout_s:
            self._lost = True
            self._output = self.pipeline.stream_lost(f"telemetry stopped for {now - self._last_sample:.2f} s")
            self.reporter.silent(self._output)
            log.error("telemetry stopped: observing")
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + 1.0
            self._send(self.reporter.heartbeat())
        for message in self.reporter.due(now, self._codec.bad_frames, self._adapter):
            self._send(message)
        if self._adapter is not None and now >= self._next_request:
            self._next_request = now + _STREAM_REQUEST_S
            self._request_streams(self._adapter)
        if now >= self._next_watchdog:
            self._next_watchdog = now + (self._notifier.watchdog_interval_s or 1.0)
            self._notifier.watchdog()
            self._notifier.status(self.reporter.line())
        if self._endpoint is None and now >= self._next_reconnect:
            self._next_reconnect = now + _RECONNECT_S
            try:
                self._endpoint = open_endpoint(self._config.link.endpoint)
                self._poll.register(self._endpoint.fileno(), select.POLLIN)
            except EndpointError as error:
                log.error("%s", error)

    def _request_streams(self, adapter: NffDialectAdapter) -> None:
        """Ask for what is needed as long as it does not come, or not fast enough."""
        slow = self.reporter.rate_hz < 0.8 * self._config.link.rate_hz
        now = self._clock()
        for stream in adapter.streams(self._config.link.rate_hz):
            silent = now - self._heard.get(stream.message_id, -np.inf) > _STREAM_REQUEST_S
            if not (slow or silent):
                continue
            self._send(
                dialect.MAVLink_command_long_message(
                    *adapter.target,
                    dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    float(stream.message_id),
                    1e6 / stream.rate_hz,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                    0.0,
                )
            )

    # -- operator -----------------------------------------------------------------------------------------------

    def _request(self, request: dict[str, Any]) -> dict[str, Any]:
        command = request.get("command", "status")
        try:
            if command == "lift":
                motor = int(request["motor"])
                if not 1 <= motor <= self.vehicle.motors:
                    return {"error": f"motor {motor} does not exist: choose 1 to {self.vehicle.motors}"}
                self.pipeline.lift(motor)
                log.warning("operator lifted the declaration of motor %d", motor)
            elif command == "mode":
                name = str(request["mode"])
                if name not in MODES:
                    return {"error": f"mode {name!r} is unknown: choose one of {', '.join(MODES)}"}
                if self._adapter is not None and MODES[name] == Mode.OBSERVE and self._output is not None:
                    for message in self._adapter.release(self._output.time_s):
                        self._send(message)
                self.pipeline.set_mode(MODES[name])
                log.warning("operator set mode %s", name)
            elif command != "status":
                return {"error": f"command {command!r} is unknown: status, lift or mode"}
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            return {"error": f"bad request: {error}"}
        age = self._clock() - self._last_sample
        return self.reporter.document(self._codec.bad_frames, self._adapter, None if np.isinf(age) else age)

    def close(self) -> None:
        """Give the vehicle back (confirmed declarations stay) and close."""
        self._notifier.stopping()
        if self._adapter is not None and self._output is not None:
            for message in self._adapter.release(self._output.time_s):
                self._send(message)
        self._status.close()
        if self._endpoint is not None:
            self._endpoint.close()


def run(config: Config) -> int:
    """Run the daemon to its end; exit code."""
    try:
        daemon = Daemon(config, Notifier())
    except NffError as error:
        log.error("%s", error)
        return 1
    daemon.run()
    return 0
