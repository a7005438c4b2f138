"""An emulated vehicle in a thread, for tests with real clients and real processes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from sitl.fleet import Fleet
from sitl.server import Server


class Flying:
    """Runs a server until left; ``wait_for`` polls a condition on the fleet."""

    def __init__(self, fleet: Fleet, urls: list[str], **options: Any) -> None:
        self.fleet = fleet
        self.server = Server(fleet, urls, **options)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.run, args=(float("inf"), self._stop.is_set))

    def __enter__(self) -> Flying:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()


def wait_for(condition: Callable[[], bool], what: str, timeout_s: float = 30.0) -> None:
    """Poll ``condition``; fails the test when it does not come true."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s} s for: {what}"
        time.sleep(0.01)
