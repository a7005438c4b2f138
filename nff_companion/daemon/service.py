"""``nff run``: one thread, one loop. All thinking is in the session; here are signals, the watchdog and the monitor."""

from __future__ import annotations

import gc
import logging
import select
import signal
import time
from collections.abc import Callable
from typing import Any

from nff_companion.companion_state import Orders
from nff_companion.condition import Mode
from nff_companion.core.decision import Event
from nff_companion.daemon.configuration import MODES, Config, default_status_socket
from nff_companion.daemon.loop import IDLE_S, Loop
from nff_companion.daemon.notify import Notifier
from nff_companion.daemon.proposal import Proposer, Source
from nff_companion.daemon.startup import endpoints, prepare, state_folder
from nff_companion.daemon.status_server import StatusServer
from nff_companion.errors import NffError
from nff_companion.mavlink.services import host_status

log = logging.getLogger("nff")

_FAREWELL_S = 2.0  # longest time that the end of a run waits for the autopilot's confirmation


class Daemon:
    """Owns the sockets and the clock."""

    def __init__(self, config: Config, notifier: Notifier, clock: Callable[[], float] = time.monotonic) -> None:
        """Raises NffError when the configuration, an endpoint or the status socket cannot be used."""
        self._config, self._notifier = config, notifier
        self.loop = Loop(endpoints(config), config.link.component, clock)
        self.session = prepare(config, clock(), host_status=host_status.status_message)
        self._status = StatusServer(config.companion.status_socket or default_status_socket(), self._request)
        self._proposer: Proposer | None = None
        if self.session.recorder is not None:
            source = Source(config.vehicle.airframe, config.vehicle.thrust_to_weight, state_folder(config))
            self._proposer = Proposer(source, self.session.recorder, config.tuning.proposal.patience_s)
        self.loop.poll.register(self._status.fileno(), select.POLLIN)
        self._stopping = False
        self._next_watchdog_s = -float("inf")
        self._logged: tuple[object, ...] = ()

    def run(self) -> None:
        """Until SIGTERM or SIGINT. Raises nothing that the link or its data may cause."""
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._stop)
        # What exists now stays: the collector need not walk it in flight.
        gc.collect()
        gc.freeze()
        self._notifier.ready()
        name, config = self.session.companion.vehicle.name, self._config
        log.info("running: %s on %s, mode %s", name, config.link.endpoint, config.companion.mode)
        try:
            while not self._stopping:
                self.turn(IDLE_S)
        finally:
            self.close()

    def _stop(self, *_: object) -> None:
        self._stopping = True

    def turn(self, wait_s: float) -> None:
        """Once round the loop: wait for input, handle it, then what is due."""
        if not self.loop.turn(self.session, wait_s, self._monitor):
            return
        now = self.loop.clock()
        if now >= self._next_watchdog_s:
            self._next_watchdog_s = now + (self._notifier.watchdog_interval_s or 1.0)
            self._notifier.watchdog()
            self._notifier.status(self.session.reporter.line(self.session.moment()))
        if self._proposer is not None:
            note = self._proposer.turn(self.session, now)
            if note is not None:
                self.loop.send(self.session.tell(note, now))
        self._log_changes()

    def _log_changes(self) -> None:
        """What the next reader of the log wants to know, when it changes."""
        session = self.session
        adapter, said = session.adapter, session.moment().verdict
        state = (None if adapter is None else (adapter.name, adapter.target[0]), said.reason)
        for _, event in session.news():
            _log_event(event)
        if state != self._logged:
            self._logged = state
            who = "no autopilot" if adapter is None else f"system {adapter.target[0]}, adapter {adapter.name}"
            log.info("%s; %s: %s", who, session.output.mode.name.lower(), said.text)

    # -- monitor and operator -----------------------------------------------------------------------------------

    def _monitor(self, descriptor: int) -> None:
        if descriptor == self._status.fileno():
            self._status.serve()

    def _request(self, request: dict[str, Any]) -> dict[str, Any]:
        command = request.get("command", "status")
        try:
            if command == "lift":
                motor, motors = int(request["motor"]), self.session.companion.vehicle.motors
                if not 1 <= motor <= motors:
                    return {"error": f"motor {motor} does not exist: choose 1 to {motors}"}
                self._order(Orders(lift=(motor,)))
            elif command == "mode":
                name = str(request["mode"])
                if name not in MODES:
                    return {"error": f"mode {name!r} is unknown: choose one of {', '.join(MODES)}"}
                self._order(Orders(mode=MODES[name]))
            elif command != "status":
                return {"error": f"command {command!r} is unknown: status, lift or mode"}
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            return {"error": f"bad request: {error}"}
        document = self.session.document(self.loop.clock())
        document["proposal"] = {"state": "off"} if self._proposer is None else self._proposer.document()
        return document

    def _order(self, orders: Orders) -> None:
        log.warning("operator: %s", orders)
        self.loop.send(self.session.order(orders, self.loop.clock()))

    def close(self) -> None:
        """Give the vehicle back (confirmed declarations stay), wait for what must be confirmed, and close."""
        self._notifier.stopping()
        if self._proposer is not None:
            self._proposer.close()
        now = self.loop.clock()
        self.loop.send(self.session.leave(now))
        deadline = now + _FAREWELL_S
        while self.session.unfinished(self.loop.clock()) and self.loop.clock() < deadline:
            self.loop.turn(self.session, 0.02)
        self._status.close()
        self.loop.close()


def _log_event(event: Event) -> None:
    what = "failed" if event.declared else "works again"
    log.warning(
        "motor %d %s: effectiveness %.2f, confidence %.3f", event.motor, what, event.effectiveness, event.confidence
    )


def run(config: Config) -> int:
    """Run the daemon to its end; exit code."""
    try:
        daemon = Daemon(config, Notifier())
    except NffError as error:
        log.error("%s", error)
        return 1
    daemon.run()
    return 0


__all__ = ["Daemon", "Mode", "run"]
