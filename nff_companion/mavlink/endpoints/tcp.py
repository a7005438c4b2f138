"""TCP endpoint that connects."""

from __future__ import annotations

import errno
import socket

from nff_companion.errors import EndpointError
from nff_companion.mavlink.send_queue import SendQueue
from nff_companion.mavlink.urls import Url

_AT_ONCE = 4096  # bytes of one read: garbage that takes long to parse must leave the loop its turn
_CONNECT_TIMEOUT_S = 0.5  # well below the watchdog: connecting blocks the loop


class Tcp:
    """Connects once; a lost connection raises and the caller opens a new one. ``parsed.host`` is an address.

    ``wait`` False: in flight nobody waits for a connection; it is made, or found impossible, between reads.
    """

    datagrams = False

    def __init__(self, url: str, parsed: Url, *, wait: bool = True) -> None:
        self.url = url
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._queue = SendQueue(self._socket.send)
        self._connected = False
        self._socket.settimeout(_CONNECT_TIMEOUT_S if wait else 0.0)
        try:
            self._socket.connect((parsed.host, parsed.number))
        except BlockingIOError:
            pass  # under way
        except OSError as error:
            self._socket.close()
            raise EndpointError(f"{url}: cannot connect: {error}; is the other side listening?") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    @property
    def connected(self) -> bool:
        """Whether the connection has been made."""
        if not self._connected:
            try:
                self._socket.getpeername()
            except OSError:
                return False  # under way, or impossible: the next read finds out
            self._connected = True
        return True

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, tuple[str, int] | None]]:
        """Bytes that have arrived."""
        try:
            data = self._socket.recv(_AT_ONCE)
        except BlockingIOError:
            return []
        except OSError as error:
            if error.errno == errno.ENOTCONN and not self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                return []  # still connecting
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error
        if not data:
            raise EndpointError(f"{self.url}: closed by the other side")
        return [(data, None)]

    def answer(self, sender: tuple[str, int] | None) -> None:
        """There is but one."""

    def send(self, data: bytes) -> bool:
        """Send the frame after what waits; False when it is dropped."""
        if not self.connected:
            return False
        try:
            return self._queue.send(data)
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error

    def flush(self) -> None:
        """Send of what waits as much as the connection takes."""
        try:
            self._queue.flush()
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
