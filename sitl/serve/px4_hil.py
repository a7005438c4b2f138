"""Physics of a PX4 in SITL by its simulator link: TCP, MAVLink 2 HIL messages, in lock-step.

PX4 connects to us and waits for the first HIL_SENSOR, whose time_usec is its clock. Once it answers with
HIL_ACTUATOR_CONTROLS, each of our frames waits for its answer; until then we run by the wall clock.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import EndpointError, FrameError
from nff_companion.mavlink.codec import Codec, Message, dialect
from sitl import rotation
from sitl.serve.physics import Physics, pace
from sitl.telemetry import HOME_ALTITUDE_M, to_global

PORT = 4560
STEP_S = 0.004
_SYSTEM, _COMPONENT = 1, 200
_ARMED = 128
_SLOW_EVERY = 5  # magnetometer and barometer come at 50 Hz
_GPS_EVERY = 25  # 10 Hz
_ACCEL_GYRO, _MAG, _BARO = 0x03F, 0x1C0, 0x1A00
_ANSWER_S = 1.0
# Magnetic field at home, gauss, NED: strength 0.58, inclination -66 deg, declination 12.4 deg.
_FIELD = 0.58 * np.array(
    [
        math.cos(math.radians(-66)) * math.cos(math.radians(12.4)),
        math.cos(math.radians(-66)) * math.sin(math.radians(12.4)),
        math.sin(math.radians(-66)),
    ]
)
_MAG_NOISE_GAUSS, _BARO_NOISE_HPA = 0.002, 0.01
_SEA_LEVEL_HPA, _SCALE_M, _EXPONENT = 1013.25, 44330.0, 5.2559


def pressure_hpa(altitude_m: float) -> float:
    """Of the standard atmosphere."""
    return float(_SEA_LEVEL_HPA * (1.0 - altitude_m / _SCALE_M) ** _EXPONENT)


def outputs_of(message: Message, motors: int) -> NDArray[np.float64]:
    """(m,) motor outputs of HIL_ACTUATOR_CONTROLS; zeros when disarmed. Raises FrameError."""
    controls = np.array(message.controls[:motors], float)
    driven = controls[np.isfinite(controls)]
    if driven.size and (driven.min() < -1.0 or driven.max() > 1.0):
        raise FrameError(
            f"HIL_ACTUATOR_CONTROLS with controls from {driven.min():g} to {driven.max():g}, expected -1 to 1"
        )
    if not message.mode & _ARMED:
        return np.zeros(motors)
    return np.nan_to_num(controls, nan=0.0)


class Px4Server:
    """Listens on TCP for one PX4."""

    def __init__(self, physics: Physics, host: str = "127.0.0.1", port: int = PORT, seed: int = 1) -> None:
        """Raises EndpointError."""
        self.physics = physics
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise EndpointError(
                f"tcp {host}:{port}: cannot listen: {error.strerror}; is another simulator running?"
            ) from error
        self._client: socket.socket | None = None
        self._codec = Codec(_SYSTEM, _COMPONENT)
        self._random = np.random.default_rng(seed)
        self._outputs = np.zeros(physics.parameters.motors)
        self._frame = 0
        self.locked = False  # it answers each frame
        self.missed = 0
        self.last_error = ""
        self.speed = 1.0  # may be changed while it runs

    @property
    def time_usec(self) -> int:
        """The clock that PX4 is given."""
        return round(1e6 * (1.0 + self._frame * STEP_S))

    @property
    def bad_frames(self) -> int:
        """Frames that did not parse."""
        return self._codec.bad_frames

    def accept(self, timeout_s: float) -> bool:
        """Wait for PX4 to connect; False when it has not."""
        self._listener.settimeout(timeout_s)
        try:
            client, _ = self._listener.accept()
        except TimeoutError:
            return False
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self.locked = False
        return True

    def sensor_message(self) -> Message:
        """HIL_SENSOR of now."""
        physics = self.physics
        gyro, force = physics.inertial()
        fields = _ACCEL_GYRO
        noise = self._random.standard_normal(4)
        field = rotation.to_matrix(physics.quaternion[None])[0].T @ _FIELD + _MAG_NOISE_GAUSS * noise[:3]
        altitude = HOME_ALTITUDE_M - float(physics.position_m[2])
        pressure = pressure_hpa(altitude) + _BARO_NOISE_HPA * float(noise[3])
        if self._frame % _SLOW_EVERY == 0:
            fields |= _MAG | _BARO
        return dialect.MAVLink_hil_sensor_message(
            self.time_usec, *force.tolist(), *gyro.tolist(), *field.tolist(), pressure, 0.0, altitude, 20.0, fields, 0
        )

    def gps_message(self) -> Message:
        """HIL_GPS of now."""
        latitude, longitude, altitude = to_global(self.physics.position_m)
        velocity = [round(100 * float(v)) for v in self.physics.velocity_m_s]
        speed = round(100 * float(np.linalg.norm(self.physics.velocity_m_s[:2])))
        course = round(100 * math.degrees(math.atan2(velocity[1], velocity[0]))) % 36000
        return dialect.MAVLink_hil_gps_message(
            self.time_usec, 3, latitude, longitude, altitude, 30, 40, speed, *velocity, course, 14
        )

    def step(self) -> None:
        """One frame: plant, sensors out, and the answer in. Raises EndpointError when PX4 is gone."""
        self.physics.step(self._outputs, STEP_S)
        self._frame += 1
        self._send(self.sensor_message())
        if self._frame % _GPS_EVERY == 0:
            self._send(self.gps_message())
        if not self._receive(_ANSWER_S if self.locked else 0.0) and self.locked:
            self.missed += 1

    def _send(self, message: Message) -> None:
        assert self._client is not None
        try:
            self._client.sendall(self._codec.pack(message))
        except OSError as error:
            raise EndpointError(f"PX4 left: {error.strerror}") from error

    def _receive(self, timeout_s: float) -> bool:
        """Take what has come; whether an answer was among it."""
        assert self._client is not None
        deadline = time.monotonic() + timeout_s
        answered = False
        while True:
            self._client.settimeout(max(deadline - time.monotonic(), 0.0) or 1e-6 if not answered else 1e-6)
            try:
                data = self._client.recv(65536)
            except (TimeoutError, BlockingIOError):
                return answered
            except OSError as error:
                raise EndpointError(f"PX4 left: {error.strerror}") from error
            if not data:
                raise EndpointError("PX4 closed the simulator link")
            for message in self._codec.parse(data):
                answered = self.take(message) or answered
            if answered:
                return True

    def take(self, message: Message) -> bool:
        """One message of PX4; whether it is the answer to a frame."""
        if message.get_type() != "HIL_ACTUATOR_CONTROLS":
            return False
        try:
            self._outputs = outputs_of(message, self.physics.parameters.motors)
        except FrameError as error:
            self.last_error = str(error)
            return True
        self.locked = True
        return True

    def run(self, stop: Callable[[], bool], on_step: Callable[[], None] = lambda: None) -> None:
        """Serve until ``stop()`` or PX4 leaves, no faster than ``speed`` times the wall clock."""
        while self._client is None and not stop():
            self.accept(0.2)
        next_s = time.monotonic()
        while not stop():
            self.step()
            on_step()
            next_s = pace(next_s, STEP_S / self.speed)

    def close(self) -> None:
        """Close the sockets."""
        if self._client is not None:
            self._client.close()
        self._listener.close()
