"""The plant as the physics of a real autopilot: recorded exchanges replayed byte by byte, and bad frames refused."""

from __future__ import annotations

import socket
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nff_companion.core import vehicle
from nff_companion.errors import EndpointError, FrameError
from nff_companion.mavlink.codec import Codec, Message, dialect
from sitl import airframe
from sitl.faults import Fault
from sitl.serve.ardupilot_json import ArduPilotServer, parse
from sitl.serve.physics import Physics, PhysicsOptions
from sitl.serve.px4_hil import Px4Server, outputs_of, pressure_hpa
from sitl.trials.process import free_port

DATA = Path(__file__).parents[1] / "data"


def physics(name: str = "octo-x", faults: list[Fault] | None = None, **options: Any) -> Physics:
    return Physics(airframe.load(vehicle.path_of(name)), PhysicsOptions(**options), faults)


def records(name: str) -> list[bytes]:
    """Records of a file: u16 length, then as many bytes."""
    data, out, at = (DATA / name).read_bytes(), [], 0
    while at < len(data):
        (length,) = struct.unpack_from("<H", data, at)
        out.append(data[at + 2 : at + 2 + length])
        at += 2 + length
    return out


# -- ArduPilot --------------------------------------------------------------------------------------------------------


def test_a_recorded_exchange_with_ardupilot_is_answered_byte_by_byte() -> None:
    exchange = records("ardupilot_json_exchange.bin")
    assert len(exchange) >= 200
    server = ArduPilotServer(physics("arducopter-octa-x"), port=free_port())
    try:
        for k in range(0, len(exchange), 2):
            assert server.handle(parse(exchange[k])) == exchange[k + 1], f"frame {k // 2}"
    finally:
        server.close()
    assert server.physics.time_s > 0.05


def test_the_same_frame_again_is_answered_the_same_and_moves_nothing() -> None:
    server = ArduPilotServer(physics(), port=free_port())
    request = struct.pack("<HHI16H", 18458, 1000, 7, *[1500] * 16)
    first = server.handle(parse(request))
    time_s = server.physics.time_s
    assert server.handle(parse(request)) == first
    assert server.physics.time_s == time_s
    assert server.handle(parse(struct.pack("<HHI16H", 18458, 1000, 8, *[1500] * 16))) != first
    server.close()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "0 bytes"),
        (struct.pack("<HHI16H", 999, 400, 1, *[0] * 16), "magic 999"),
        (struct.pack("<HHI15H", 18458, 400, 1, *[0] * 15), "has 38 bytes, expected 40"),
        (struct.pack("<HHI16H", 29569, 400, 1, *[0] * 16), "32 channels"),
        (struct.pack("<HHI16H", 18458, 0, 1, *[0] * 16), "frame rate 0"),
    ],
)
def test_a_bad_request_gets_a_clear_error_and_no_answer(data: bytes, reason: str) -> None:
    with pytest.raises(FrameError, match=reason):
        parse(data)
    port = free_port()
    server = ArduPilotServer(physics(), port=port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(0.1)
        client.sendto(data, ("127.0.0.1", port))
        assert server.step(1.0)
        assert reason in server.last_error
        assert server.bad_requests == 1
        with pytest.raises(TimeoutError):
            client.recv(1000)
    server.close()


def test_the_answer_is_what_the_interface_parses() -> None:
    import json

    server = ArduPilotServer(physics(), port=free_port())
    answer = server.handle(parse(struct.pack("<HHI32H", 29569, 1200, 1, *[1000] * 32)))
    server.close()
    assert answer.startswith(b"\n") and answer.endswith(b"}\n")
    document = json.loads(answer)
    assert document["imu"]["accel_body"][2] == pytest.approx(-9.80665, abs=0.3)
    assert document["timestamp"] == pytest.approx(1 / 1200)
    assert b'"gyro":[' in answer and b", " in answer


# -- PX4 --------------------------------------------------------------------------------------------------------------


def test_a_recorded_exchange_with_px4_is_repeated_byte_by_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    exchange = records("px4_hil_exchange.bin")  # what PX4 said in a frame (may be empty), then our frame
    assert len(exchange) >= 200
    server = Px4Server(physics("px4-octo-x"), port=free_port())
    parser = Codec(1, 200)
    sent: list[bytes] = []
    monkeypatch.setattr(server, "_send", lambda message: sent.append(server._codec.pack(message)))
    answers: list[bytes] = []

    def receive(timeout_s: float) -> bool:
        taken = [server.take(message) for message in parser.parse(answers.pop(0))]
        return any(taken)

    monkeypatch.setattr(server, "_receive", receive)
    for k in range(0, len(exchange), 2):
        answers.append(exchange[k])
        sent.clear()
        server.step()
        assert b"".join(sent) == exchange[k + 1], f"frame {k // 2}"
    assert server.locked
    server.close()


def test_px4_is_stepped_in_lock_step_over_tcp_and_its_leaving_is_said() -> None:
    port = free_port()
    server = Px4Server(physics(), port=port)
    server.speed = 100.0
    client = socket.create_connection(("127.0.0.1", port))
    ended: list[Exception] = []

    def serve() -> None:
        try:
            server.run(lambda: False)
        except EndpointError as error:
            ended.append(error)

    thread = threading.Thread(target=serve)
    thread.start()
    codec = Codec(1, 1)
    times: list[int] = []
    while len(times) < 200:
        for message in codec.parse(client.recv(4096)):
            if message.get_type() == "HIL_SENSOR":
                times.append(message.time_usec)
                controls = dialect.MAVLink_hil_actuator_controls_message(
                    message.time_usec, [0.9] * 8 + [0.0] * 8, 129, 1
                )
                client.sendall(codec.pack(controls))
    client.close()
    thread.join(5.0)
    assert set(np.diff(times)) == {4000}, "4 ms of its clock a frame, none left out"
    assert server.physics.position_m[2] < -0.5, "it has climbed"
    assert "PX4" in str(ended[0])
    server.close()


def test_outputs_of_px4_are_checked() -> None:
    def message(controls: list[float], mode: int = 129) -> Message:
        made = dialect.MAVLink_hil_actuator_controls_message(0, controls + [0.0] * (16 - len(controls)), mode, 1)
        return Codec(1, 200).parse(Codec(1, 1).pack(made))[0]

    assert outputs_of(message([0.5] * 8), 8) == pytest.approx(np.full(8, 0.5))
    assert not outputs_of(message([0.5] * 8, mode=1), 8).any(), "disarmed"
    assert outputs_of(message([float("nan")] + [0.5] * 7), 8)[0] == 0.0
    with pytest.raises(FrameError, match="expected -1 to 1"):
        outputs_of(message([5.0] * 8), 8)


# -- physics ----------------------------------------------------------------------------------------------------------


def test_it_climbs_hovers_fails_and_falls() -> None:
    plant = physics(faults=[Fault(vehicle=0, motor=1, start_s=1.0)])
    octo = vehicle.load("octo-x")
    for _ in range(250):
        plant.step(np.full(8, 0.75), 0.004)
    assert plant.position_m[2] < -1.0
    hover = octo.output_for(np.full(8, octo.hover))
    for _ in range(500):
        plant.step(hover, 0.004)
    assert plant.state.crashed[0], "nobody balances it after the failure"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_outputs_that_are_no_numbers_stand_still(bad: float) -> None:
    plant = physics()
    plant.step(np.full(8, bad), 0.004)
    assert not plant.output.any()
    assert np.isfinite(plant.position_m).all()


def test_the_same_seed_flies_the_same_at_any_frame_length() -> None:
    ends = []
    for interval in (0.004, 0.004):
        plant = physics(seed=3, wind_m_s=5.0, turbulence_m_s=1.0)
        for _ in range(100):
            plant.step(np.full(8, 0.8), interval)
        ends.append(plant.position_m.copy())
    assert np.array_equal(ends[0], ends[1])


def test_pressure_falls_with_height() -> None:
    assert pressure_hpa(0.0) == pytest.approx(1013.25)
    assert pressure_hpa(1000.0) == pytest.approx(898.7, abs=0.5)
