"""``nff doctor``: is everything in place before arming? Asks and listens; changes nothing but message rates."""

from __future__ import annotations

import time

from nff_companion.autopilots.base import Finding
from nff_companion.daemon.configuration import Config
from nff_companion.daemon.loop import IDLE_S, Loop
from nff_companion.daemon.startup import endpoints, prepare

_RATES_S = 5.0  # of listening after the streams were asked for


class Doctor:
    """The session that the daemon would run, but one that may not act."""

    def __init__(self, config: Config) -> None:
        """Raises NffError when the configuration or its endpoints cannot be used."""
        self._loop = Loop(endpoints(config), config.link.component)
        self._session = prepare(config, time.monotonic(), act=False)

    def examine(self, timeout_s: float) -> list[Finding]:
        """Findings after everything was answered, or ``timeout_s``."""
        began = time.monotonic()
        settled: float | None = None
        session = self._session
        try:
            while time.monotonic() - began < timeout_s:
                self._loop.turn(session, IDLE_S)
                adapter = session.adapter
                if adapter is None:
                    continue
                done = all(finding.ok is not False for finding in adapter.findings())
                settled = settled or (time.monotonic() if done else None)
                if settled is not None and time.monotonic() - settled > _RATES_S:
                    break
            return session.findings(time.monotonic())
        finally:
            self._loop.close()
