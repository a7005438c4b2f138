"""Physics of an ArduPilot in SITL by its JSON interface (``--model JSON:host``): UDP, in lock-step.

Request, little endian: magic u16 (18458: 16 channels, 29569: 32), frame rate u16, frame count u32, pwm u16[16 or 32].
Answer to the sender: one JSON object between newlines (SIM_JSON.cpp, whose parser needs arrays spaced as here).
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import EndpointError, FrameError
from sitl.serve.physics import Physics, pace

PORT = 9002
_MAGIC = {18458: 16, 29569: 32}
_HEAD = struct.Struct("<HHI")
_RATE_MAX_HZ = 4000
_REPORT_BAD_S = 5.0


@dataclass(frozen=True)
class Request:
    """One request: pulse widths in microseconds, one a channel."""

    frame_rate_hz: int
    frame_count: int
    pwm: tuple[int, ...]


def parse(data: bytes) -> Request:
    """A request from its bytes. Raises FrameError that says what is wrong with them."""
    if len(data) < _HEAD.size:
        raise FrameError(f"request of {len(data)} bytes, at least {_HEAD.size} are needed")
    magic, rate, count = _HEAD.unpack_from(data)
    channels = _MAGIC.get(magic)
    if channels is None:
        raise FrameError(f"magic {magic}, expected one of {', '.join(map(str, _MAGIC))}: is the sender an ArduPilot?")
    size = _HEAD.size + 2 * channels
    if len(data) != size:
        raise FrameError(f"request for {channels} channels has {len(data)} bytes, expected {size}")
    if not 0 < rate <= _RATE_MAX_HZ:
        raise FrameError(f"frame rate {rate} Hz is not between 1 and {_RATE_MAX_HZ}")
    return Request(rate, count, struct.unpack_from(f"<{channels}H", data, _HEAD.size))


def _array(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{float(v):.9g}" for v in values) + "]"


def answer(physics: Physics, gyro: NDArray[np.float64], force: NDArray[np.float64]) -> bytes:
    """The state as the interface wants it."""
    return (
        f'\n{{"timestamp":{physics.time_s:.9f},'
        f'"imu":{{"gyro":{_array(gyro)},"accel_body":{_array(force)}}},'
        f'"position":{_array(physics.position_m)},'
        f'"velocity":{_array(physics.velocity_m_s)},'
        f'"quaternion":{_array(physics.quaternion)}}}\n'
    ).encode()


class ArduPilotServer:
    """Listens on UDP; each new frame is one step of the plant."""

    def __init__(self, physics: Physics, host: str = "127.0.0.1", port: int = PORT) -> None:
        """Raises EndpointError."""
        self.physics = physics
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise EndpointError(
                f"udp {host}:{port}: cannot bind: {error.strerror}; is another simulator running?"
            ) from error
        self._last: Request | None = None
        self._answer = b""
        self.bad_requests = 0
        self.last_error = ""
        self.speed = 1.0

    def step(self, timeout_s: float) -> bool:
        """Answer one request; False when none came in time."""
        self._socket.settimeout(timeout_s)
        try:
            data, sender = self._socket.recvfrom(65535)
        except TimeoutError:
            return False
        try:
            request = parse(data)
        except FrameError as error:
            self.bad_requests += 1
            self.last_error = str(error)
            return True
        self._socket.sendto(self.handle(request), sender)
        return True

    def handle(self, request: Request) -> bytes:
        """The answer to a request. The same frame again is answered the same: it was lost on the way."""
        if self._last is not None and request.frame_count == self._last.frame_count and self._answer:
            return self._answer
        p = self.physics.parameters
        pwm = np.array(request.pwm[: p.motors], float)
        output = np.where(pwm > 0, (pwm - p.pwm_min) / (p.pwm_max - p.pwm_min), 0.0)
        self.physics.step(output, 1.0 / request.frame_rate_hz)
        self._last = request
        self._answer = answer(self.physics, *self.physics.inertial())
        return self._answer

    def run(self, stop: Callable[[], bool], on_step: Callable[[], None] = lambda: None) -> None:
        """Serve until ``stop()``, no faster than ``speed`` times the wall clock."""
        next_s = time.monotonic()
        while not stop():
            before = self.physics.time_s
            if self.step(0.2):
                on_step()
                next_s = pace(next_s, (self.physics.time_s - before) / self.speed)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
