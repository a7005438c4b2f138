"""As much of a PX4 as its adapter meets: parameters, version, heartbeat, injection. Its storage outlives a fork.

It takes a burst of parameters in parts up to a second apart, and drops and delays as a real link does, when asked to.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.base import Permit
from nff_companion.autopilots.px4.adapter import Method, Px4Adapter
from nff_companion.autopilots.schedule import Declare
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, Message, dialect
from nff_companion.mavlink.services.parameter_reader import decode, encode, name_of

V1_16 = 0x011000FF
_REAL, _INT = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32
_STEP_S = 0.02
_QUEUE = 64  # messages that wait to be read; what comes beyond is lost, as in a receive buffer


@dataclass(frozen=True)
class Link:
    """``drops``: whether a message is lost, in either direction; ``part``: PARAM_SETs read at once, then a pause."""

    delay_s: float = 0.0
    part: int | None = None
    pause_s: float = 1.0
    drops: Callable[[Message], bool] = lambda message: False


class FakePx4:
    def __init__(
        self,
        vehicle: Vehicle,
        version: int = V1_16,
        link: Link | None = None,
        changes: Mapping[str, float] | None = None,
    ) -> None:
        values: dict[str, float] = {"CA_ROTOR_COUNT": vehicle.motors, "CA_METHOD": 2, "MC_AIRMODE": 0}
        for i in range(vehicle.motors):
            x, y = vehicle.position_m[i]
            values |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_PZ": 0.0}
            values |= {f"CA_ROTOR{i}_AX": 0.0, f"CA_ROTOR{i}_AY": 0.0, f"CA_ROTOR{i}_AZ": -1.0}
            values |= {f"CA_ROTOR{i}_CT": 6.5, f"CA_ROTOR{i}_KM": 0.05 * vehicle.spin[i]}
            values[f"PWM_MAIN_FUNC{i + 1}"] = 101 + i
        values["THR_MDL_FAC"] = 0.65
        values |= changes or {}
        self.names = list(values)
        self.kinds = {n: _INT if n in ("CA_ROTOR_COUNT", "CA_METHOD") or "FUNC" in n else _REAL for n in values}
        self._memory = mmap.mmap(-1, 8 * len(values))  # shared with children that are killed
        self.stored = np.frombuffer(self._memory, float)
        self.stored[:] = np.array(list(values.values()), np.float32)
        self.version, self.link = version, Link() if link is None else link
        self.armed = False
        self.deaf = False
        self.locked: set[str] = set()  # answered with the value that stays
        self.refusing: set[str] = set()  # answered with PARAM_ERROR
        self.injection_result = int(dialect.MAV_RESULT_ACCEPTED)
        self.injected: list[tuple[int, int]] = []  # motor, type
        self.received: list[Message] = []  # everything that was sent to it
        self.sets: list[tuple[str, float]] = []  # what was taken
        self._inbox: list[tuple[float, Message]] = []
        self._outbox: list[tuple[float, Message]] = []
        self._resume_s = -np.inf
        self._out = Codec(1, 1)
        self._in = Codec(1, 1)
        self._companion_out = Codec(1, COMPANION_COMPONENT)
        self._companion_in = Codec(1, COMPANION_COMPONENT)

    def value(self, name: str) -> float:
        return float(self.stored[self.names.index(name)])

    def scales(self) -> list[float]:
        return [self.value(name) for name in self.names if name.endswith("_CT")]

    def moments(self) -> list[float]:
        return [self.value(name) for name in self.names if name.endswith("_KM")]

    def kinds_received(self) -> set[str]:
        return {m.get_type() for m in self.received}

    def receive(self, message: Message, now_s: float) -> None:
        (message,) = self._in.parse(self._companion_out.pack(message))
        self.received.append(message)
        if not self.deaf and len(self._inbox) < _QUEUE and not self.link.drops(message):
            self._inbox.append((now_s + self.link.delay_s, message))

    def due(self, now_s: float, on_set: Callable[[], None] = lambda: None) -> list[Message]:
        """What it says until ``now_s``."""
        taken = 0
        while self._inbox and self._inbox[0][0] <= now_s and now_s >= self._resume_s:
            message = self._inbox.pop(0)[1]
            for reply in self._answer(message, on_set):
                if not self.link.drops(reply):
                    self._outbox.append((now_s + self.link.delay_s, reply))
            taken += message.get_type() == "PARAM_SET"
            if self.link.part is not None and taken >= self.link.part:
                self._resume_s = now_s + self.link.pause_s
        said = [m for at_s, m in self._outbox if at_s <= now_s]
        self._outbox = [(at_s, m) for at_s, m in self._outbox if at_s > now_s]
        return self.through(said)

    def _answer(self, message: Message, on_set: Callable[[], None]) -> list[Message]:
        kind = message.get_type()
        if kind == "COMMAND_LONG":
            return self._command(message)
        if kind == "PARAM_REQUEST_READ" and name_of(message) in self.names:
            return [self.announce(name_of(message))]
        if kind == "PARAM_SET" and name_of(message) in self.names:
            return self._set(message, on_set)
        return []

    def _command(self, message: Message) -> list[Message]:
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            return [
                dialect.MAVLink_autopilot_version_message(0, self.version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 7)
            ]
        if message.command == dialect.MAV_CMD_INJECT_FAILURE:
            self.injected.append((int(message.param3), int(message.param2)))
            return [dialect.MAVLink_command_ack_message(message.command, self.injection_result)]
        return []

    def _set(self, message: Message, on_set: Callable[[], None]) -> list[Message]:
        name = name_of(message)
        assert message.param_type == self.kinds[name]
        if name in self.refusing:
            error = dialect.MAV_PARAM_ERROR_READ_ONLY
            return [dialect.MAVLink_param_error_message(1, COMPANION_COMPONENT, name.encode(), -1, error)]
        if name not in self.locked:
            value = decode(message.param_value, message.param_type, bytewise=True)
            self.stored[self.names.index(name)] = np.float32(value)
            self.sets.append((name, value))
            on_set()
        return [self.announce(name)]

    def heartbeat(self) -> list[Message]:
        mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return self.through([dialect.MAVLink_heartbeat_message(14, dialect.MAV_AUTOPILOT_PX4, mode, 0, 4, 3)])

    def announce(self, name: str) -> Message:
        """PARAM_VALUE as it is broadcast after a change."""
        kind = self.kinds[name]
        value = encode(self.value(name), kind, bytewise=True)
        return dialect.MAVLink_param_value_message(name.encode(), value, kind, len(self.names), 0)

    def through(self, messages: Sequence[Message]) -> list[Message]:
        """As they arrive."""
        return [received for m in messages for received in self._companion_in.parse(self._out.pack(m))]


def from_another(message: Message, system: int = 255, component: int = 190) -> Message:
    """The message as somebody else on the link sends it; a ground station unless named."""
    (received,) = Codec(1, COMPANION_COMPONENT).parse(Codec(system, component).pack(message))
    return received


def talk(
    adapter: Px4Adapter,
    px4: FakePx4,
    start_s: float,
    seconds: float,
    on_set: Callable[[], None] = lambda: None,
    permit: Permit = Permit.ACT,
) -> float:
    """Let both speak for a while; the time at its end. A heartbeat at its beginning, and each second."""
    now, beat_s = start_s, start_s
    while now < start_s + seconds:
        if now >= beat_s:
            beat_s += 1.0
            for message in px4.heartbeat():
                adapter.observe(message, now)
        for request in adapter.due(now, permit):
            px4.receive(request, now)
        for reply in px4.due(now, on_set):
            adapter.observe(reply, now)
        now += _STEP_S
    return now


def octo(ratio: float = 2.56) -> Vehicle:
    return vehicle_model.load("px4-octo-x", thrust_to_weight=ratio)


def without(model: Vehicle, motors: Sequence[int]) -> NDArray[np.float64]:
    """(m,) effectiveness with these motors (from 1) dead."""
    eta = np.ones(model.motors)
    eta[[motor - 1 for motor in motors]] = 0.0
    return eta


def declare(eta: NDArray[np.float64], time_s: float = 10.0) -> Declare:
    """Declaration of motor effectiveness (m,)."""
    return Declare(time_s, eta == 0.0, eta)


def tell(adapter: Px4Adapter, px4: FakePx4, eta: NDArray[np.float64], now_s: float) -> list[Message]:
    """Encode a declaration at ``now_s`` and hand it over; what was sent."""
    adapter.condition(now_s)
    messages = adapter.encode(declare(eta, now_s))
    for message in messages:
        px4.receive(message, now_s)
    return messages


def on_ground(folder: Path, px4: FakePx4, model: Vehicle, method: Method = "scale") -> tuple[Px4Adapter, float]:
    """An adapter that has read everything before arming."""
    adapter = Px4Adapter(model, (1, 1), folder / "journal", method)
    px4.armed = False
    return adapter, talk(adapter, px4, 0.0, 4.0)


def in_flight(folder: Path, px4: FakePx4, model: Vehicle, method: Method = "scale") -> tuple[Px4Adapter, float]:
    """And that was there when the vehicle armed."""
    adapter, now = on_ground(folder, px4, model, method)
    px4.armed = True
    return adapter, talk(adapter, px4, now, 0.1)
