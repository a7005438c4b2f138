"""The daemon's own word about itself during a test flight."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from nff_companion.daemon.status_server import ask
from nff_companion.errors import EndpointError

_SETTLED = ("healthy", "observing")


class CompanionState:
    """Asked through the status socket, now and then."""

    def __init__(self, socket: Path) -> None:
        self._socket = str(socket)
        self._last: dict[str, Any] = {}
        self._counted: list[tuple[float, int]] = []  # wall time and samples, at the first and last answer
        self.text = "does not answer yet"

    def document(self) -> dict[str, Any]:
        """What it says now; empty when it does not answer."""
        try:
            answer = ask(self._socket, {"command": "status"})
        except EndpointError as error:
            self.text = str(error)
            self._counted = self._counted[:1]
            return {}
        if answer["counters"]["samples"]:  # before the first there is no rate
            self._counted[1:] = [(time.monotonic(), answer["counters"]["samples"])]
        return answer

    def begin(self) -> None:
        """Count samples from now on."""
        self._counted = []
        self.refresh()

    def refresh(self) -> None:
        """Ask again."""
        self._last = self.document()
        self.text = str(self._last.get("reason", self.text))

    def ready(self) -> bool:
        """Whether, when last asked, it flew with everything it needs."""
        last = self._last
        return last.get("reason_name") in _SETTLED and bool(last.get("flying")) and not last["slow_streams"]

    @property
    def mean_rate_hz(self) -> float | None:
        """Mean rate of the samples taken since ``begin``, by the wall clock; None when it does not answer now."""
        if len(self._counted) < 2:
            return None
        (began, first), (ended, last) = self._counted
        return (last - first) / (ended - began)
