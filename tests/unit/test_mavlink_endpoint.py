"""Endpoints: their modules, their URLs, their sends."""

from __future__ import annotations

import ast
import select
import socket
import time
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import nff_companion
from nff_companion.errors import ConfigError
from nff_companion.mavlink.codec import Codec, dialect
from nff_companion.mavlink.endpoints.tcp import Tcp
from nff_companion.mavlink.endpoints.tcp_server import TcpServer
from nff_companion.mavlink.hub import Hub
from sitl.trials.process import free_port

PACKAGE = Path(nff_companion.__file__).parent
MATRIX = dialect.MAVLink_nff_allocation_matrix_message(1234567, 7, 500, 1, 1, 4, 8, 1, [k / 4 + 1 for k in range(48)])


def modules(folder: Path) -> dict[str, Path]:
    return {
        ".".join(("nff_companion", *path.relative_to(PACKAGE).with_suffix("").parts)): path
        for path in folder.rglob("*.py")
        if path.name not in ("__init__.py", "nff.py")
    }


def test_no_module_of_the_wire_imports_itself_through_others() -> None:
    known = modules(PACKAGE)
    graph: dict[str, set[str]] = {}
    for name in modules(PACKAGE / "mavlink"):
        taken: set[str] = set()
        # Imports within functions count: a ring that is closed later is a ring.
        for node in ast.walk(ast.parse(known[name].read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                taken |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        graph[name] = taken & known.keys()
    assert list(TopologicalSorter(graph).static_order())
    kinds = {name: taken for name, taken in graph.items() if ".endpoints." in name}
    assert len(kinds) >= 4
    allowed = {f"nff_companion.{name}" for name in ("errors", "mavlink.urls", "mavlink.send_queue")}
    assert set().union(*kinds.values()) <= allowed, "an endpoint kind knows what a URL is and how to send, no more"


@pytest.mark.parametrize("url", ["udpin:::1:14550", "tcp:[fe80::1]:5760", "udpout://[::1]:14550"])
def test_an_address_of_the_other_family_is_refused_by_name(url: str) -> None:
    from nff_companion.mavlink.urls import parse

    with pytest.raises(ConfigError, match="IPv6"):
        parse(url)


@pytest.mark.parametrize("kind", ["tcp", "tcpin"])
def test_a_peer_that_reads_slowly_gets_whole_frames_and_the_rest_is_counted(kind: str) -> None:
    port, poll = free_port(), select.poll()
    if kind == "tcp":
        with socket.create_server(("127.0.0.1", port)) as listener:
            hub = Hub([f"tcp:127.0.0.1:{port}"], 1, 191, poll, 0.0)
            peer, _ = listener.accept()
        outgoing = hub._ports[0].endpoint
        assert isinstance(outgoing, Tcp)
        ours = outgoing._socket
    else:
        hub = Hub([f"tcpin:127.0.0.1:{port}"], 1, 191, poll, 0.0)
        peer = socket.create_connection(("127.0.0.1", port))
        peer.sendall(Codec(1, 1).pack(MATRIX))
        assert poll.poll(1000)
        hub.read(hub._ports[0].descriptor, 0.0)
        incoming = hub._ports[0].endpoint
        assert isinstance(incoming, TcpServer)
        assert incoming._client is not None
        ours = incoming._client
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    codec, received, sent = Codec(1, 1), 0, 4000
    peer.setblocking(False)
    for k in range(sent):
        hub.send(MATRIX, None, 0.0)
        if k % 10 == 0 and select.select([peer], [], [], 0)[0]:
            received += len(codec.parse(peer.recv(503)))
    dropped = hub.dropped
    deadline = time.monotonic() + 20.0
    while received < sent - dropped and time.monotonic() < deadline:
        hub.maintain(0.0)
        if select.select([peer], [], [], 0.05)[0]:
            received += len(codec.parse(peer.recv(65536)))
    assert codec.bad_frames == 0, "half a frame was sent"
    assert 0 < dropped < sent
    assert received == sent - dropped
    assert hub.dropped_by_port == {f"{kind}:127.0.0.1:{port}": dropped}
    peer.close()
    hub.close()
