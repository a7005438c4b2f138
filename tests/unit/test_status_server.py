"""The status socket: whose it is, who may command, and that nobody holds it up."""

from __future__ import annotations

import json
import os
import select
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from nff_companion.daemon.status_server import Peer, StatusServer, ask, may_command
from nff_companion.errors import EndpointError, NffError

Make = Callable[..., StatusServer]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    made: list[StatusServer] = []

    def make(
        path: Path = tmp_path / "s",
        handler: Callable[[dict[str, Any]], dict[str, Any]] = lambda request: {"got": request},
        **options: Any,
    ) -> StatusServer:
        made.append(StatusServer(str(path), handler, **options))
        return made[-1]

    yield make
    for server in made:
        server.close()


def serve(server: StatusServer, times: int = 20) -> None:
    for _ in range(times):
        if select.select([server.fileno()], [], [], 0.02)[0]:
            server.serve()


def client(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    made.settimeout(2.0)
    made.connect(str(path))
    return made


# -- the path ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["file", "folder", "pipe", "link to a file", "link to nothing", "link to a socket"])
def test_what_is_no_socket_is_never_deleted(make: Make, tmp_path: Path, what: str) -> None:
    path, other = tmp_path / "precious", tmp_path / "other"
    if what == "file":
        path.write_text("years of work")
    elif what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    else:
        if what == "link to a file":
            other.write_text("years of work")
        elif what == "link to a socket":
            with socket.socket(socket.AF_UNIX) as stale:
                stale.bind(str(other))
        path.symlink_to(other)
    before = path.lstat()
    with pytest.raises(NffError, match=r"precious.*not a socket"):
        make(path)
    assert path.lstat() == before
    if what == "link to nothing":
        assert not other.exists()


def test_a_socket_that_nobody_answers_on_is_replaced(make: Make, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(tmp_path / "s"))
    make()
    with client(tmp_path / "s"):
        assert True, "somebody listens again"


def test_another_daemon_that_answers_is_left_alone(make: Make, tmp_path: Path) -> None:
    first = make()
    with pytest.raises(EndpointError, match="another daemon answers at"):
        make()
    with client(tmp_path / "s") as monitor:
        monitor.sendall(b'{"command": "status"}\n')
        serve(first)
        assert json.loads(monitor.recv(4096)) == {"got": {"command": "status"}}


def test_a_daemon_that_ends_does_not_remove_the_socket_of_its_successor(make: Make, tmp_path: Path) -> None:
    first = make()
    (tmp_path / "s").unlink()
    make()
    first.close()
    assert (tmp_path / "s").is_socket()


def test_folders_that_are_made_for_it_can_be_entered(make: Make, tmp_path: Path) -> None:
    make(tmp_path / "new" / "deep" / "s")
    assert all(stat.S_IMODE((tmp_path / name).stat().st_mode) & 0o500 == 0o500 for name in ("new", "new/deep"))


def test_a_file_that_was_put_in_the_sockets_place_gives_no_rights(make: Make, tmp_path: Path) -> None:
    server = make(peer_of=lambda _: Peer(1000, 1000, ()))
    with client(tmp_path / "s") as monitor:
        (tmp_path / "s").unlink()
        (tmp_path / "s").write_text("")
        os.chown(tmp_path / "s", -1, 1000)
        monitor.sendall(b'{"command": "lift", "motor": 1}\n')
        serve(server, 3)
        assert "refused" in json.loads(monitor.recv(4096))["error"]


# -- who may command --------------------------------------------------------------------------------------------------


def test_root_the_daemons_user_and_the_sockets_group_command_and_nobody_else() -> None:
    mine, group = 990, 500
    assert may_command(Peer(0, 0, ()), mine, group)
    assert may_command(Peer(mine, 990, ()), mine, group)
    assert may_command(Peer(1000, group, ()), mine, group)
    assert may_command(Peer(1000, 1000, (4, group)), mine, group)
    assert not may_command(Peer(1000, 1000, (4, 24)), mine, group)


@pytest.mark.parametrize("request_", [{"command": "lift", "motor": 1}, {"command": "mode", "mode": "observe"}])
def test_a_stranger_may_look_but_not_touch(make: Make, tmp_path: Path, request_: dict[str, Any]) -> None:
    asked: list[dict[str, Any]] = []

    def handler(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request)
        return {"fine": True}

    server = make(handler=handler, peer_of=lambda _: Peer(1000, 1000, (24,)))
    answers = []
    for request in (request_, {"command": "status"}, {}):
        with client(tmp_path / "s") as monitor:
            monitor.sendall(json.dumps(request).encode() + b"\n")
            serve(server)
            answers.append(json.loads(monitor.recv(4096)))
    assert "uid 1000" in answers[0]["error"]
    assert "group" in answers[0]["error"]
    assert answers[1:] == [{"fine": True}] * 2
    assert asked == [{"command": "status"}, {}]


def test_everyone_may_connect(make: Make, tmp_path: Path) -> None:
    make()
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o666


@contextmanager
def somebody_else(groups: list[int]) -> Iterator[None]:
    """Act as a user of these groups; the kernel notes who connects at the moment of it."""
    before = os.getgroups()
    os.setgroups(groups)
    os.setegid(65534)
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)
        os.setgroups(before)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may become somebody else")
@pytest.mark.parametrize(("groups", "allowed"), [([], False), ([54321], True)])
def test_another_user_is_known_by_the_kernels_word(make: Make, groups: list[int], allowed: bool) -> None:
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)
        path = Path(name) / "s"
        server = make(path)
        os.chown(path, 0, 54321)
        for request, answered in (({"command": "status"}, True), ({"command": "lift", "motor": 1}, allowed)):
            with somebody_else(groups):
                monitor = client(path)
            with monitor:
                monitor.sendall(json.dumps(request).encode() + b"\n")
                serve(server, 3)
                answer = json.loads(monitor.recv(4096))
            assert ("error" not in answer) == answered, answer
        server.close()


# -- clients ----------------------------------------------------------------------------------------------------------


def test_a_request_may_come_in_pieces(make: Make, tmp_path: Path) -> None:
    server = make()
    with client(tmp_path / "s") as monitor:
        for piece in (b'{"comm', b'and": "sta', b'tus"}'):
            monitor.sendall(piece)
            serve(server, 3)
        monitor.setblocking(False)
        with pytest.raises(BlockingIOError):
            monitor.recv(4096)
        monitor.sendall(b"\n")
        serve(server, 3)
        assert json.loads(monitor.recv(4096)) == {"got": {"command": "status"}}


def test_a_request_may_end_with_the_clients_last_word(make: Make, tmp_path: Path) -> None:
    server = make()
    with client(tmp_path / "s") as monitor:
        monitor.sendall(b'{"command": "status"}')
        monitor.shutdown(socket.SHUT_WR)
        serve(server, 3)
        assert json.loads(monitor.recv(4096)) == {"got": {"command": "status"}}


def test_a_request_without_end_is_refused(make: Make, tmp_path: Path) -> None:
    server = make()
    with client(tmp_path / "s") as monitor:
        monitor.sendall(b"x" * 5000)
        serve(server, 3)
        assert "longer than" in json.loads(monitor.recv(4096))["error"]


@pytest.mark.parametrize(("data", "word"), [(b"nonsense\n", "JSON"), (b"[]\n", "object"), (b"\xff\n", "JSON")])
def test_nonsense_is_answered(make: Make, tmp_path: Path, data: bytes, word: str) -> None:
    server = make()
    with client(tmp_path / "s") as monitor:
        monitor.sendall(data)
        serve(server, 3)
        assert word in json.loads(monitor.recv(4096))["error"]


def test_silent_and_slow_clients_hold_up_nobody(make: Make, tmp_path: Path) -> None:
    server = make(handler=lambda _: {"much": "x" * 1_000_000})
    silent = []
    for _ in range(30):
        silent.append(client(tmp_path / "s"))
        serve(server, 2)
    slow = client(tmp_path / "s")
    slow.sendall(b"{}\n")
    began = time.monotonic()
    for _ in range(20):
        server.serve()
    assert time.monotonic() - began < 0.5
    received = b""
    while not received.endswith(b"\n"):
        received += slow.recv(65536)
        server.serve()
    assert len(json.loads(received)["much"]) == 1_000_000
    for one in [*silent, slow]:
        one.close()


def test_an_answer_that_breaks_off_is_an_error_of_ours(tmp_path: Path) -> None:
    import threading

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen()

        def half() -> None:
            connection, _ = listener.accept()
            connection.recv(4096)
            connection.send(b'{"mode": "ob')
            connection.close()

        thread = threading.Thread(target=half)
        thread.start()
        with pytest.raises(EndpointError, match="broke off"):
            ask(str(tmp_path / "s"), {"command": "status"})
        thread.join()
