"""TCP endpoint that listens."""

from __future__ import annotations

import select
import socket

from nff_companion.errors import EndpointError
from nff_companion.mavlink.send_queue import SendQueue
from nff_companion.mavlink.urls import Url

_AT_ONCE = 4096  # bytes of one read: garbage that takes long to parse must leave the loop its turn


class TcpServer:
    """Listens; the newest client is the peer. Its descriptor is that of a poll set of listener and client."""

    datagrams = False

    def __init__(self, url: str, parsed: Url) -> None:
        self.url = url
        self._client: socket.socket | None = None
        self._queue: SendQueue | None = None
        self._sender: tuple[str, int] | None = None
        try:
            self._listener = socket.create_server((parsed.host, parsed.number))
        except OSError as error:
            raise EndpointError(
                f"{url}: cannot listen: {error.strerror}; is another program using the port?"
            ) from error
        self._listener.setblocking(False)
        self._poll = select.epoll()
        self._poll.register(self._listener.fileno(), select.EPOLLIN)

    @property
    def connected(self) -> bool:
        """Whether there is a client."""
        return self._client is not None

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._poll.fileno()

    def receive(self) -> list[tuple[bytes, tuple[str, int] | None]]:
        """Bytes that have arrived; a client that left is no error, the next one is waited for."""
        self._accept()
        if self._client is None:
            return []
        try:
            data = self._client.recv(_AT_ONCE)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._leave()
            return []
        return [(data, self._sender)]

    def answer(self, sender: tuple[str, int] | None) -> None:
        """There is but one."""

    def send(self, data: bytes) -> bool:
        """Send the frame after what waits; False when there is no client, or no room."""
        if self._queue is None:
            return False
        try:
            return self._queue.send(data)
        except OSError:
            self._leave()
            return False

    def flush(self) -> None:
        """Send of what waits as much as the connection takes."""
        try:
            if self._queue is not None:
                self._queue.flush()
        except OSError:
            self._leave()

    def _accept(self) -> None:
        try:
            client, self._sender = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:
            raise EndpointError(f"{self.url}: lost: {error.strerror}") from error
        self._leave()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setblocking(False)
        self._poll.register(client.fileno(), select.EPOLLIN)
        self._client, self._queue = client, SendQueue(client.send)

    def _leave(self) -> None:
        if self._client is not None:
            self._poll.unregister(self._client.fileno())
            self._client.close()
            self._client = self._queue = None

    def close(self) -> None:
        """Close the sockets."""
        self._leave()
        self._poll.close()
        self._listener.close()
