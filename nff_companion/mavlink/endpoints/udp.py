"""UDP endpoint."""

from __future__ import annotations

import socket

from nff_companion.errors import EndpointError
from nff_companion.mavlink.endpoint import Url

_LARGEST = 65535


class Udp:
    """``udpin`` learns its peer from what it receives; ``udpout`` has a fixed one."""

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

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Datagrams that have arrived."""
        out: list[bytes] = []
        while True:
            try:
                data, sender = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                return out
            except ConnectionRefusedError:
                continue  # an earlier datagram found no listener: not an error of this port
            except OSError as error:
                raise EndpointError(f"{self.url}: lost: {error.strerror}") from error
            if not self._fixed:
                self._peer = sender
            out.append(data)

    def send(self, data: bytes) -> bool:
        """Send one datagram, or drop it."""
        if self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return False  # full, unreachable or refused now: this datagram is lost, the port is not
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
