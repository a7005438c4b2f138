"""TCP client endpoint."""

from __future__ import annotations

import socket

from nff_companion.errors import EndpointError
from nff_companion.link.endpoint import Url

_CONNECT_TIMEOUT_S = 0.5  # well below the watchdog: connecting blocks the loop


class Tcp:
    """Connects once; a lost connection raises and the caller opens a new one."""

    def __init__(self, url: str, parsed: Url) -> None:
        self.url = url
        try:
            self._socket = socket.create_connection((parsed.host, parsed.number), _CONNECT_TIMEOUT_S)
        except OSError as error:
            raise EndpointError(f"{url}: cannot connect: {error}; is the other side listening?") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Bytes that have arrived."""
        out: list[bytes] = []
        while True:
            try:
                data = self._socket.recv(65536)
            except BlockingIOError:
                return out
            except OSError as error:
                raise EndpointError(f"{self.url}: lost: {error.strerror}") from error
            if not data:
                raise EndpointError(f"{self.url}: closed by the other side")
            out.append(data)

    def send(self, data: bytes) -> bool:
        """Send all of ``data``; False when the buffer is full."""
        try:
            return self._socket.send(data) == len(data)
        except BlockingIOError:
            return False
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
