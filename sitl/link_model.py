"""A bad link: latency, jitter, loss, duplication, corruption, by a seeded generator. Bytes in, bytes out later."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class LinkOptions:
    """``loss``, ``duplication`` and ``corruption`` are probabilities of one datagram."""

    latency_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    duplication: float = 0.0
    corruption: float = 0.0


class LinkModel:
    """One direction of a link. Jitter may reorder datagrams, as a real network does."""

    def __init__(self, options: LinkOptions, seed: int) -> None:
        self._options = options
        self._random = np.random.default_rng(seed)
        self._queue: list[tuple[float, int, bytes]] = []
        self._count = 0

    def send(self, now_s: float, data: bytes) -> None:
        """Put a datagram on the way."""
        o, random = self._options, self._random
        if o.loss and random.random() < o.loss:
            return
        copies = 2 if o.duplication and random.random() < o.duplication else 1
        for _ in range(copies):
            sent = data
            if o.corruption and random.random() < o.corruption:
                changed = bytearray(data)
                changed[int(random.integers(len(changed)))] ^= 1 << int(random.integers(8))
                sent = bytes(changed)
            delay = o.latency_s + (o.jitter_s * random.random() if o.jitter_s else 0.0)
            self._count += 1
            heapq.heappush(self._queue, (now_s + delay, self._count, sent))

    def receive(self, now_s: float) -> list[bytes]:
        """Datagrams that have arrived by ``now_s``."""
        out = []
        while self._queue and self._queue[0][0] <= now_s + 1e-9:
            out.append(heapq.heappop(self._queue)[2])
        return out
