"""The daemon's own word about itself during a test flight."""

from __future__ import annotations

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
        self.text = "does not answer yet"

    def document(self) -> dict[str, Any]:
        """What it says now; empty when it does not answer."""
        try:
            return ask(self._socket, {"command": "status"})
        except EndpointError as error:
            self.text = str(error)
            return {}

    def refresh(self) -> None:
        """Ask again."""
        self._last = self.document()
        self.text = str(self._last.get("reason", self.text))

    def ready(self) -> bool:
        """Whether, when last asked, it flew with everything it needs."""
        last = self._last
        return last.get("reason_name") in _SETTLED and bool(last.get("flying")) and not last["slow_streams"]
