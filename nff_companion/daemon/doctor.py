"""``nff doctor``: is everything in place before arming? Asks and listens; changes nothing but message rates."""

from __future__ import annotations

import select
import time

from nff_companion.autopilots.base import Adapter, Finding, Stream
from nff_companion.core import basis_network
from nff_companion.daemon.configuration import Config
from nff_companion.daemon.startup import endpoints, prepare
from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.hub import Hub
from nff_companion.mavlink.services.streams import StreamMonitor, interval

_TURN_S = 0.05
_RATES_S = 5.0  # of listening after the streams were asked for


class Doctor:
    """Listens to one autopilot with the configuration that the daemon would run with."""

    def __init__(self, config: Config) -> None:
        """Raises NffError when the configuration or its endpoints cannot be used."""
        self._config = config
        self.vehicle, self._meeting = prepare(config)
        self._network = basis_network.for_vehicle(self.vehicle, config.vehicle.network)
        self._poll = select.poll()
        self._hub = Hub(endpoints(config), 1, config.link.component, self._poll, time.monotonic())
        self._streams = StreamMonitor()
        self._adapter: Adapter | None = None
        self._port: int | None = None
        self._armed = False
        self._next_heartbeat_s = 0.0

    def examine(self, timeout_s: float) -> list[Finding]:
        """Findings after everything was answered, or ``timeout_s``."""
        began = time.monotonic()
        settled: float | None = None
        try:
            while time.monotonic() - began < timeout_s:
                self._turn()
                adapter = self._adapter
                if adapter is None:
                    continue
                done = all(finding.ok is not False for finding in adapter.findings())
                settled = settled or (time.monotonic() if done else None)
                if settled is not None and time.monotonic() - settled > _RATES_S:
                    break
            return self._findings()
        finally:
            self._hub.close()

    def _turn(self) -> None:
        for descriptor, _ in self._poll.poll(1e3 * _TURN_S):
            for message, port in self._hub.read(descriptor, time.monotonic()):
                if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
                    continue
                if message.get_type() == "HEARTBEAT":
                    self._armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
                    if self._adapter is None and self._config.link.system in (0, message.get_srcSystem()):
                        self._meet(message.get_srcSystem(), message.autopilot, port)
                if self._adapter is None or message.get_srcSystem() != self._adapter.target[0]:
                    continue
                self._adapter = self._meeting.better(self._adapter, message.get_msgId()) or self._adapter
                self._streams.heard(message.get_msgId(), time.monotonic())
                self._adapter.observe(message)
        now = time.monotonic()
        if now >= self._next_heartbeat_s:
            self._next_heartbeat_s = now + 1.0
            beat = dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_STANDBY, 3
            )
            self._hub.send(beat, None, now)
        if self._adapter is not None and not self._armed:
            asked = self._streams.requests(self._adapter.streams(self._config.link.rate_hz), self._adapter.target, now)
            for message in [*self._adapter.tick(now), *asked]:
                self._hub.send(message, self._port, now)
        self._hub.maintain(now)

    def _meet(self, system: int, autopilot: int, port: int) -> None:
        target = (system, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._adapter, self._port = self._meeting.first(target, autopilot), port
        self._hub.set_system(system)
        request = interval(Stream(dialect.MAVLINK_MSG_ID_NFF_APPLIED, 20.0), target)
        self._hub.send(request, port, time.monotonic())

    def _findings(self) -> list[Finding]:
        adapter = self._adapter
        if adapter is None:
            return [Finding("link", False, f"no autopilot heard on {self._config.link.endpoint}")]
        out = [Finding("link", True, f"autopilot of system {adapter.target[0]}, adapter {adapter.name}")]
        if self._armed:
            out.append(Finding("armed", False, "the vehicle is armed: nothing was asked of it; disarm and try again"))
        network = "none: a constant basis" if self._network is None else self._network.label
        out.append(Finding("network", True, network))
        out += adapter.findings()
        slow = self._streams.slow(adapter.streams(self._config.link.rate_hz), time.monotonic())
        text = ", ".join(f"{name} {rate:.0f} of {asked:.0f} Hz" for name, (rate, asked) in slow.items())
        out.append(Finding("rates", not slow, text or f"all streams at {self._config.link.rate_hz:.0f} Hz"))
        return out
