"""One direction of a link in virtual time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Item = TypeVar("Item")


@dataclass(slots=True)
class Channel(Generic[Item]):
    """Messages under way, oldest first."""

    delay_s: float
    queue: deque[tuple[float, Item]] = field(default_factory=deque)

    def send(self, now_s: float, message: Item) -> None:
        """Put a message on the way."""
        self.queue.append((now_s + self.delay_s, message))

    def receive(self, now_s: float) -> list[Item]:
        """Messages that have arrived."""
        out: list[Item] = []
        while self.queue and self.queue[0][0] <= now_s + 1e-9:
            out.append(self.queue.popleft()[1])
        return out
