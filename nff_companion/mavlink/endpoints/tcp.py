"""TCP endpoints."""

from __future__ import annotations

import errno
import select
import socket

from nff_companion.errors import EndpointError
from nff_companion.mavlink.endpoint import Url

_CONNECT_TIMEOUT_S = 0.5  # well below the watchdog: connecting blocks the loop


class Tcp:
    """Connects once; a lost connection raises and the caller opens a new one.

    ``wait`` False: in flight nobody waits for a connection; it is made, or found impossible, between reads.
    """

    def __init__(self, url: str, parsed: Url, *, wait: bool = True) -> None:
        self.url = url
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
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
                if error.errno == errno.ENOTCONN and not self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                    return out  # still connecting
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
            if error.errno == errno.ENOTCONN:
                return False  # still connecting; a failure is found at the next read
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpServer:
    """Listens; the newest client is the peer. Its descriptor is that of a poll set of listener and client."""

    def __init__(self, url: str, parsed: Url) -> None:
        self.url = url
        self._client: socket.socket | None = None
        try:
            self._listener = socket.create_server((parsed.host, parsed.number))
        except OSError as error:
            raise EndpointError(
                f"{url}: cannot listen: {error.strerror}; is another program using the port?"
            ) from error
        self._listener.setblocking(False)
        self._poll = select.epoll()
        self._poll.register(self._listener.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._poll.fileno()

    def receive(self) -> list[bytes]:
        """Bytes that have arrived; a client that left is no error, the next one is waited for."""
        self._accept()
        out: list[bytes] = []
        while self._client is not None:
            try:
                data = self._client.recv(65536)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            if not data:
                self._leave()
                break
            out.append(data)
        return out

    def send(self, data: bytes) -> bool:
        """Send all of ``data``; False when there is no client, or its buffer is full."""
        if self._client is None:
            return False
        try:
            return self._client.send(data) == len(data)
        except BlockingIOError:
            return False
        except OSError:
            self._leave()
            return False

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        self._leave()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setblocking(False)
        self._poll.register(client.fileno(), select.EPOLLIN)
        self._client = client

    def _leave(self) -> None:
        if self._client is not None:
            self._poll.unregister(self._client.fileno())
            self._client.close()
            self._client = None

    def close(self) -> None:
        """Close the sockets."""
        self._leave()
        self._poll.close()
        self._listener.close()
