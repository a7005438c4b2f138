"""``nff check``: does the airframe file fit the vehicle that flies now? Listens; changes nothing but message rates."""

from __future__ import annotations

import time
from collections.abc import Callable

from nff_companion.condition import Reason
from nff_companion.core.fit import Fit
from nff_companion.daemon.configuration import Config
from nff_companion.daemon.loop import IDLE_S, Loop
from nff_companion.daemon.startup import endpoints, prepare
from nff_companion.reporting import Moment

_SILENT = (Reason.TELEMETRY_STOPPED, Reason.ANOTHER_SYSTEM)


class FitCheck:
    """The session that the daemon would run, but one that may not act."""

    def __init__(self, config: Config) -> None:
        """Raises NffError when the configuration or its endpoints cannot be used."""
        self._loop = Loop(endpoints(config), config.link.component)
        self._session = prepare(config, time.monotonic(), act=False)

    def watch(self, seconds: float, wait_s: float, said: Callable[[Moment], None]) -> Fit:
        """The judgement ``seconds`` of the vehicle's clock after a flight was seen, for which it waits ``wait_s`` at
        most, or when it is no longer heard then; ``said`` is given every moment that says something else than the one
        before."""
        session, began, last = self._session, time.monotonic(), ""
        since: tuple[float, float] | None = None  # of our clock and of the vehicle's, when the flight was seen
        try:
            while True:
                self._loop.turn(session, IDLE_S)
                now, moment = time.monotonic(), session.moment()
                text = f"{moment.verdict.text} {moment.output.fit.text}"
                if text != last:
                    last = text
                    said(moment)
                output, fit = moment.output, moment.output.fit
                if since is None:
                    if fit.seen.seconds > 0.0:
                        since = now, output.time_s
                    elif now - began >= wait_s:
                        return fit
                    continue
                silent = moment.verdict.reason in _SILENT and now - since[0] >= seconds
                if silent or output.time_s - since[1] >= seconds:
                    return fit
        finally:
            self._loop.close()
