"""All parameters of a live autopilot, whatever gets lost of them; it is only asked."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from nff_companion.daemon import live_parameters
from nff_companion.errors import EndpointError
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.services.parameter_list import ParameterList
from sitl.trials.process import free_port

TARGET = (1, dialect.MAV_COMP_ID_AUTOPILOT1)
INT32 = dialect.MAV_PARAM_TYPE_INT32
VALUES = {"FRAME_CLASS": 3.0, "FRAME_TYPE": 1.0, "MOT_THST_EXPO": 0.65, "MOT_PWM_MIN": 1000.0, "MOT_PWM_MAX": 2000.0}
VALUES |= {f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 9)}
VALUES |= {f"OTHER_{k}": float(k) for k in range(40)}


def answers(values: dict[str, float], *, bytewise: bool = False) -> list[Message]:
    out = []
    for index, (name, value) in enumerate(values.items()):
        kind, sent = dialect.MAV_PARAM_TYPE_REAL32, value
        if bytewise and value == round(value):
            kind, sent = INT32, struct.unpack("<f", struct.pack("<i", round(value)))[0]
        out.append(dialect.MAVLink_param_value_message(name.encode(), sent, kind, len(values), index))
    return out


class Autopilot:
    """Answers from a socket of its own; each parameter is lost the first time in ``lost`` of its turns."""

    def __init__(self, port: int, autopilot: int, lost: int) -> None:
        self._codec, self._peer = Codec(*TARGET), ("127.0.0.1", port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(0.05)
        self._heartbeat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_OCTOROTOR, autopilot, 0, 0, 3, 3)
        self._answers = answers(VALUES, bytewise=autopilot == dialect.MAV_AUTOPILOT_PX4)
        self._lost = dict.fromkeys(range(0, len(self._answers), lost), 1) if lost else {}
        self.asked: set[str] = set()
        self.ended = threading.Event()

    def run(self) -> None:
        while not self.ended.is_set():
            self._socket.sendto(self._codec.pack(self._heartbeat), self._peer)
            try:
                data = self._socket.recv(2048)
            except (TimeoutError, ConnectionRefusedError):
                continue
            for message in self._codec.parse_datagram(data):
                self._answer(message)
        self._socket.close()

    def _answer(self, message: Message) -> None:
        self.asked.add(message.get_type())
        if message.get_type() == "PARAM_REQUEST_LIST":
            for index in range(len(self._answers)):
                self._send(index)
        elif message.get_type() == "PARAM_REQUEST_READ":
            self._send(message.param_index)

    def _send(self, index: int) -> None:
        if self._lost.pop(index, 0):
            return
        self._socket.sendto(self._codec.pack(self._answers[index]), self._peer)


@contextmanager
def flying(port: int, autopilot: int, lost: int = 0) -> Iterator[Autopilot]:
    found = Autopilot(port, autopilot, lost)
    thread = threading.Thread(target=found.run)
    thread.start()
    try:
        yield found
    finally:
        found.ended.set()
        thread.join(5.0)


@pytest.mark.parametrize("autopilot", [dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, dialect.MAV_AUTOPILOT_PX4])
@pytest.mark.parametrize("lost", [0, 3, 1])
def test_all_parameters_are_read_whatever_gets_lost(autopilot: int, lost: int) -> None:
    port = free_port()
    with flying(port, autopilot, lost) as vehicle:
        found = live_parameters.read(f"udpin:127.0.0.1:{port}", 20.0)
    assert found == pytest.approx(VALUES)
    assert vehicle.asked <= {"HEARTBEAT", "PARAM_REQUEST_LIST", "PARAM_REQUEST_READ"}


def test_without_an_autopilot_it_is_said_and_nothing_is_waited_for() -> None:
    with pytest.raises(EndpointError, match="no autopilot heard"):
        live_parameters.read(f"udpin:127.0.0.1:{free_port()}", 1.0)


def test_parameters_of_others_and_echoes_of_changes_do_not_count() -> None:
    found = ParameterList(TARGET, bytewise=False)
    own, other = Codec(*TARGET), Codec(2, 1)
    echo = dialect.MAVLink_param_value_message(b"FRAME_CLASS", 9.0, INT32, 2, 65535)
    first, second = answers({"A": 1.0, "B": 2.0})
    for codec, message in ((other, first), (own, echo), (own, first)):
        found.observe(own.parse_datagram(codec.pack(message))[0], 0.0)
    assert found.values == {"A": 1.0}
    assert not found.complete
    assert [m.param_index for m in found.due(1.0)] == [1]
    assert found.due(1.1) == []
    found.observe(own.parse_datagram(own.pack(second))[0], 1.2)
    assert found.complete
    assert found.due(9.0) == []


def test_an_airframe_file_is_made_of_a_live_autopilot(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from nff_companion.cli.main import app
    from nff_companion.core import vehicle

    port, out = free_port(), tmp_path / "mine.toml"
    with flying(port, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 5):
        arguments = ["airframe", "new", "--out", str(out), "--arm", "0.4", "--from", f"udpin:127.0.0.1:{port}"]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    made = vehicle.load(str(out))
    assert made.motors == 8
    assert made.command.thrust_expo == pytest.approx(0.65)
