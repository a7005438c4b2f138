"""The daemon's door for its monitor and its operator: a Unix socket, one JSON request and one JSON answer a line."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nff_companion.errors import EndpointError

_LARGEST = 4096
_WAITING_MAX = 8
Handler = Callable[[dict[str, Any]], dict[str, Any]]


class StatusServer:
    """Never blocks: one short request a connection, answered at once."""

    def __init__(self, path: str, handler: Handler) -> None:
        self._path = Path(path)
        self._handler = handler
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.unlink(missing_ok=True)
            self._socket.bind(path)
        except OSError as error:
            self._socket.close()
            raise EndpointError(
                f"status socket {path} cannot be made: {error.strerror}; set companion.status_socket"
            ) from error
        os.chmod(path, 0o660)
        self._socket.listen(8)
        self._socket.setblocking(False)
        self._open: list[socket.socket] = []

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._socket.fileno()

    def connections(self) -> list[socket.socket]:
        """Connections whose request has not come yet."""
        return self._open

    def accept(self) -> None:
        """Take a waiting connection."""
        try:
            connection, _ = self._socket.accept()
        except BlockingIOError:
            return
        connection.setblocking(False)
        if len(self._open) >= _WAITING_MAX:
            self._open.pop(0).close()  # it connected and never asked
        self._open.append(connection)

    def serve(self, connection: socket.socket) -> None:
        """Answer the request on ``connection`` and close it."""
        try:
            data = connection.recv(_LARGEST)
            if data:
                connection.send((json.dumps(self._answer(data)) + "\n").encode())
        except OSError:
            data = b""  # the monitor went away: nothing to answer
        self._open.remove(connection)
        connection.close()

    def _answer(self, data: bytes) -> dict[str, Any]:
        try:
            request = json.loads(data)
        except (ValueError, RecursionError):
            return {"error": "request is not JSON"}
        if not isinstance(request, dict):
            return {"error": "request is not an object"}
        return self._handler(request)

    def close(self) -> None:
        """Remove the socket."""
        for connection in self._open:
            connection.close()
        self._socket.close()
        self._path.unlink(missing_ok=True)


def ask(path: str, request: dict[str, Any], timeout_s: float = 2.0) -> dict[str, Any]:
    """Client side: one request, its answer. Raises EndpointError when no daemon answers at ``path``."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            client.connect(path)
            client.sendall(json.dumps(request).encode())
            data = b""
            while not data.endswith(b"\n"):
                part = client.recv(65536)
                if not part:
                    break
                data += part
    except OSError as error:
        raise EndpointError(f"no daemon answers at {path}: {error.strerror or error}; is nff run active?") from error
    answer = json.loads(data)
    return answer if isinstance(answer, dict) else {}
