"""A ground station that flies a test: commands with acknowledgement, waiting for conditions, never for time alone."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from nff_companion.errors import EndpointError, NffError
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.mavlink.endpoint import Endpoint, open_endpoint
from nff_companion.mavlink.services.parameter_reader import decode, encode, name_of
from nff_companion.mavlink.services.streams import Stream, interval

_SYSTEM = 255
_COMPONENT = 190
_STEP_S = 0.1
_AGAIN_S = 1.0
_REAL = dialect.MAV_PARAM_TYPE_REAL32


class FlightError(NffError, RuntimeError):
    """A test flight did not get as far as its failure."""


@dataclass(slots=True)
class Pilot:
    """One connection to an autopilot. ``last`` is the newest message by type; hooks see every message."""

    url: str
    bytewise: bool = False
    last: dict[str, Message] = field(default_factory=dict)
    texts: list[str] = field(default_factory=list)
    hooks: list[Callable[[Message], None]] = field(default_factory=list)
    _endpoint: Endpoint | None = None
    _codec: Codec = field(default_factory=lambda: Codec(_SYSTEM, _COMPONENT))
    _heartbeat_s: float = 0.0
    target: tuple[int, int] = (1, 1)

    def connect(self, timeout_s: float = 20.0) -> None:
        """Open the connection and wait for a heartbeat. Raises FlightError."""
        deadline = time.monotonic() + timeout_s
        while self._endpoint is None:
            try:
                self._endpoint = open_endpoint(self.url)
            except EndpointError as error:
                if time.monotonic() > deadline:
                    raise FlightError(f"{error} (after {timeout_s:.0f} s)") from error
                time.sleep(_STEP_S)  # pace of the attempts
        self.wait(lambda: "HEARTBEAT" in self.last, timeout_s, "a heartbeat")

    def close(self) -> None:
        """Close the connection."""
        if self._endpoint is not None:
            self._endpoint.close()
            self._endpoint = None

    def pump(self, seconds: float) -> None:
        """Take what arrives within ``seconds``."""
        assert self._endpoint is not None
        now = time.monotonic()
        if now - self._heartbeat_s > _AGAIN_S:
            self._heartbeat_s = now
            self.send(
                dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
            )
        select.select([self._endpoint.fileno()], [], [], seconds)
        try:
            arrived = self._endpoint.receive()
        except EndpointError as error:
            raise FlightError(f"the autopilot is gone: {error}") from error
        for data, sender in arrived:
            self._endpoint.answer(sender)
            for message in self._codec.parse(data):
                self._take(message)

    def _take(self, message: Message) -> None:
        if message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
            self.last[message.get_type()] = message
        if message.get_type() == "STATUSTEXT":
            text = message.text
            self.texts.append(text.decode(errors="replace") if isinstance(text, bytes) else text)
        for hook in self.hooks:
            hook(message)

    def send(self, message: Message) -> None:
        """Send a message."""
        assert self._endpoint is not None
        self._endpoint.send(self._codec.pack(message))

    def wait(
        self,
        condition: Callable[[], bool],
        timeout_s: float,
        what: str,
        again: Callable[[], None] | None = None,
        again_s: float = _AGAIN_S,
    ) -> None:
        """Until ``condition()``; ``again()`` is called now and then meanwhile. Raises FlightError."""
        deadline = time.monotonic() + timeout_s
        next_s = 0.0
        while not condition():
            now = time.monotonic()
            if now > deadline:
                raise FlightError(f"waited {timeout_s:.0f} s for {what}; last texts: {self.texts[-3:]}")
            if again is not None and now >= next_s:
                next_s = now + again_s
                again()
            self.pump(_STEP_S)

    def command(self, command: int, *params: float) -> None:
        """Send COMMAND_LONG."""
        values = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(*self.target, command, 0, *values))

    def stream(self, message_id: int, rate_hz: float) -> None:
        """Ask for a message."""
        self.send(interval(Stream(message_id, rate_hz), self.target))

    def parameter(self, name: str, timeout_s: float = 10.0) -> float:
        """Value of a parameter. Raises FlightError."""
        found: list[float] = []

        def look(message: Message) -> None:
            if message.get_type() == "PARAM_VALUE" and name_of(message) == name:
                found.append(decode(message.param_value, message.param_type, bytewise=self.bytewise))

        request = dialect.MAVLink_param_request_read_message(*self.target, name.encode(), -1)
        self._with_hook(look, lambda: bool(found), timeout_s, name, lambda: self.send(request))
        return found[-1]

    def set_parameter(self, name: str, value: float, kind: int = _REAL, timeout_s: float = 10.0) -> None:
        """Set a parameter and see it taken. Raises FlightError."""
        taken: list[bool] = []

        def look(message: Message) -> None:
            if message.get_type() == "PARAM_VALUE" and name_of(message) == name:
                now = decode(message.param_value, message.param_type, bytewise=self.bytewise)
                taken.append(abs(now - value) <= 1e-5 * max(abs(value), 1.0))

        message = dialect.MAVLink_param_set_message(
            *self.target, name.encode(), encode(value, kind, bytewise=self.bytewise), kind
        )
        self._with_hook(look, lambda: any(taken), timeout_s, f"{name} = {value}", lambda: self.send(message))

    def _with_hook(
        self,
        hook: Callable[[Message], None],
        condition: Callable[[], bool],
        timeout_s: float,
        what: str,
        again: Callable[[], None],
    ) -> None:
        self.hooks.append(hook)
        try:
            self.wait(condition, timeout_s, what, again)
        finally:
            self.hooks.remove(hook)

    @property
    def armed(self) -> bool:
        """By the last heartbeat."""
        heartbeat = self.last.get("HEARTBEAT")
        return heartbeat is not None and bool(heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def local(self) -> tuple[float, float, float] | None:
        """Estimated position NED in m."""
        message = self.last.get("LOCAL_POSITION_NED")
        return None if message is None else (message.x, message.y, message.z)
