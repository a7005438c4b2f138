"""The daemon's door for its monitor and its operator: a Unix socket, one JSON request and one JSON answer a line.

Whoever may reach the socket may ask for the status. Commands are for root, for the daemon's own user and for the group
that owns the socket, which is the daemon's primary group (``Group=`` of the systemd unit), by the kernel's word.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import stat
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nff_companion.errors import EndpointError

_LARGEST = 4096  # bytes of a request
_WAITING_MAX = 8
_ANSWER_MAX = 4_000_000  # bytes that wait for one slow reader
_OPEN_TO_ALL = 0o666
_SO_PEERGROUPS = getattr(socket, "SO_PEERGROUPS", 59)  # of <asm-generic/socket.h>; Python does not name it
Handler = Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Peer:
    """Who is at the other end of a connection."""

    uid: int
    gid: int
    groups: tuple[int, ...]


def peer_of(connection: socket.socket) -> Peer:
    """By the kernel, as of the moment of connecting (SO_PEERCRED, SO_PEERGROUPS of unix(7))."""
    _, uid, gid = struct.unpack("iII", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    try:
        groups = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, 1024)
    except OSError:  # an old kernel, or more groups than fit: the primary one counts
        groups = b""
    return Peer(uid, gid, struct.unpack(f"{len(groups) // 4}I", groups))


def may_command(peer: Peer, own_uid: int, group: int) -> bool:
    """Whether ``peer`` may do more than look; ``group`` owns the socket."""
    return peer.uid in (0, own_uid) or group in (peer.gid, *peer.groups)


@dataclass(slots=True)
class _Client:
    socket: socket.socket
    request: bytes = b""
    answer: bytes = field(default=b"")  # what is left to be sent of it


class StatusServer:
    """Never blocks: a client is read and answered as it comes. Its descriptor is that of a poll set of all of them."""

    def __init__(self, path: str, handler: Handler, peer_of: Callable[[socket.socket], Peer] = peer_of) -> None:
        """Raises EndpointError when another daemon answers at ``path``, or what is there is not a socket."""
        self._path, self._handler, self._peer_of = Path(path), handler, peer_of
        self._clients: dict[int, _Client] = {}
        _make_way(self._path)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise EndpointError(f"folder of status socket {path} cannot be made: {error.strerror}") from error
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # By the mask, not by chmod afterwards: that would follow what somebody puts there in between.
        mask = os.umask(0o777 & ~_OPEN_TO_ALL)
        try:
            self._socket.bind(path)
            self._mine = _identity(self._path)
        except OSError as error:
            self._socket.close()
            raise EndpointError(
                f"status socket {path} cannot be made: {error.strerror}; set companion.status_socket"
            ) from error
        finally:
            os.umask(mask)
        self._socket.listen(8)
        self._socket.setblocking(False)
        self._poll = select.epoll()
        self._poll.register(self._socket.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._poll.fileno()

    def serve(self) -> None:
        """Accept, read and answer whoever is ready now."""
        for descriptor, _ in self._poll.poll(0):
            if descriptor == self._socket.fileno():
                self._accept()
            elif descriptor in self._clients:
                client = self._clients[descriptor]
                try:
                    done = self._send(client) if client.answer else self._read(client)
                except OSError:
                    done = True  # the monitor went away: nothing to answer
                if done:
                    self._leave(descriptor)

    def close(self) -> None:
        """Close the connections and remove the socket, if it is still ours."""
        if self._poll.closed:
            return
        for descriptor in list(self._clients):
            self._leave(descriptor)
        self._poll.close()
        self._socket.close()
        if _identity(self._path) == self._mine:
            self._path.unlink(missing_ok=True)

    # -- one client ---------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            connection, _ = self._socket.accept()
        except OSError:
            return  # it left again
        connection.setblocking(False)
        if len(self._clients) >= _WAITING_MAX:
            self._leave(next(iter(self._clients)))  # the oldest: it never asked, or does not read
        self._clients[connection.fileno()] = _Client(connection)
        self._poll.register(connection.fileno(), select.EPOLLIN)

    def _leave(self, descriptor: int) -> None:
        self._poll.unregister(descriptor)
        self._clients.pop(descriptor).socket.close()

    def _read(self, client: _Client) -> bool:
        """Take what has come of the request; True when the connection is done with."""
        data = client.socket.recv(_LARGEST)
        client.request += data
        line, newline, _ = client.request.partition(b"\n")
        if not newline and data and len(line) <= _LARGEST:
            return False
        if not line:
            return True
        if len(line) > _LARGEST:
            answer = {"error": f"request is longer than {_LARGEST} bytes"}
        else:
            answer = self._answer(line, self._peer_of(client.socket))
        client.answer = (json.dumps(answer) + "\n").encode()
        if len(client.answer) > _ANSWER_MAX:
            client.answer = b'{"error": "the answer is too long"}\n'
        return self._send(client)

    def _send(self, client: _Client) -> bool:
        """Send what the connection takes of the answer; True when nothing is left."""
        with contextlib.suppress(BlockingIOError):
            client.answer = client.answer[client.socket.send(client.answer) :]
        if client.answer:
            self._poll.modify(client.socket.fileno(), select.EPOLLOUT)
        return not client.answer

    def _group(self) -> int:
        """The group that owns the socket; ours, when something else is at its place."""
        return self._path.lstat().st_gid if _identity(self._path) == self._mine else os.getegid()

    def _answer(self, line: bytes, peer: Peer) -> dict[str, Any]:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return {"error": "request is not JSON"}
        if not isinstance(request, dict):
            return {"error": "request is not an object"}
        command = request.get("command", "status")
        if command != "status":
            group = self._group()
            if not may_command(peer, os.geteuid(), group):
                return {
                    "error": f"command {command!r} is refused: uid {peer.uid} is neither root nor the daemon's user "
                    f"nor in the group {group} that owns {self._path}; become one of these"
                }
        return self._handler(request)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of what is at ``path`` itself, not of what it points to; None when there is nothing."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _make_way(path: Path) -> None:
    """Remove a socket that nobody answers on. Raises EndpointError for anything else that is there."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return  # nothing there, or binding will say what is wrong
    if not stat.S_ISSOCK(mode):
        raise EndpointError(
            f"status socket {path}: what is there is not a socket, and is left as it is; set companion.status_socket"
        )
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
        caller.setblocking(False)
        try:
            caller.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except BlockingIOError:
            pass  # it has callers enough waiting: it lives
        except OSError as error:
            raise EndpointError(f"status socket {path} is in use or not ours: {error.strerror}") from error
    raise EndpointError(f"another daemon answers at {path}; end it, or set companion.status_socket")


def ask(path: str, request: dict[str, Any], timeout_s: float = 2.0) -> dict[str, Any]:
    """Client side: one request, its answer. Raises EndpointError when no daemon answers at ``path``."""
    data = b""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            client.connect(path)
            client.sendall(json.dumps(request).encode() + b"\n")
            while not data.endswith(b"\n"):
                part = client.recv(65536)
                if not part:
                    break
                data += part
    except OSError as error:
        raise EndpointError(f"no daemon answers at {path}: {error.strerror or error}; is nff run active?") from error
    try:
        answer = json.loads(data)
    except ValueError as error:
        raise EndpointError(f"the answer of the daemon at {path} broke off; ask again") from error
    return answer if isinstance(answer, dict) else {}
