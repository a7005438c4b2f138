"""UDP endpoint."""

from __future__ import annotations

import socket

from nff_companion.errors import EndpointError
from nff_companion.mavlink.urls import Url

_LARGEST = 65535
_AT_ONCE = 64  # datagrams of one read: a flood must leave the loop its turn


class Udp:
    """``udpin`` sends to whom it was told to ``answer``; ``udpout`` has a fixed peer. ``parsed.host`` is an address."""

    datagrams = True

    def __init__(self, url: str, parsed: Url) -> None:
        self.url = url
        self._fixed = parsed.kind == "udpout"
        address = (parsed.host, parsed.number)
        self._peer: tuple[str, int] | None = address if self._fixed else None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(("", 0) if self._fixed else address)
        except OSError as error:
            self._socket.close()
            raise EndpointError(f"{url}: cannot bind: {error.strerror}; is another program using the port?") from error

    @property
    def connected(self) -> bool:
        """Whether there is a peer."""
        return self._peer is not None

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, tuple[str, int] | None]]:
        """Datagrams that have arrived, each with its sender."""
        out: list[tuple[bytes, tuple[str, int] | None]] = []
        while len(out) < _AT_ONCE:
            try:
                out.append(self._socket.recvfrom(_LARGEST))
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                continue  # an earlier datagram found no listener: not an error of this port
            except OSError as error:
                raise EndpointError(f"{self.url}: lost: {error.strerror}") from error
        return out

    def answer(self, sender: tuple[str, int] | None) -> None:
        """From now on send to ``sender``."""
        if not self._fixed:
            self._peer = sender

    def send(self, data: bytes) -> bool:
        """Send one datagram, or drop it."""
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return False  # full, unreachable or refused now: this datagram is lost, the port is not
        return True

    def flush(self) -> None:
        """Nothing waits: a datagram goes whole or not at all."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
