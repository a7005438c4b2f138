"""Through which port the vehicle is heard: it may be heard twice, directly and through a router."""

from __future__ import annotations

_SILENT_S = 0.2  # without samples: shorter than what interrupts the estimate
_WINDOW_S = 1.0
_BETTER = 1.5  # times as many samples


class PortChoice:
    """One port is kept while it brings samples, and no other brings many more. ``now_s`` of our clock."""

    def __init__(self) -> None:
        self.port: int | None = None
        self._samples: dict[int, int] = {}
        self._window_until_s = self._sample_s = -float("inf")

    def takes(self, port: int, *, sample: bool, now_s: float) -> bool:
        """Whether a message at ``port`` is taken; ``sample``: it is one of those that complete a sample."""
        if sample:
            if now_s >= self._window_until_s:
                self._choose(now_s)
            self._samples[port] = self._samples.get(port, 0) + 1
        if port != self.port:
            if now_s - self._sample_s <= _SILENT_S:
                return False
            self.port = port
        if sample:
            self._sample_s = now_s
        return True

    def _choose(self, now_s: float) -> None:
        """After a window: the port with many more samples."""
        most = max(self._samples, key=self._samples.__getitem__, default=None)
        if most is not None and self._samples[most] > _BETTER * self._samples.get(self.port or 0, 0):
            self.port = most
        self._samples.clear()
        self._window_until_s = now_s + _WINDOW_S
