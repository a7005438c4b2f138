"""As much of a PX4 as its adapter meets: parameters, version, heartbeat. Its storage outlives a fork."""

from __future__ import annotations

import mmap
from collections.abc import Callable

import numpy as np

from nff_companion.autopilots.px4.adapter import Px4Adapter
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, Message, dialect
from nff_companion.mavlink.services.parameter_reader import decode, encode, name_of

V1_16 = 0x011000FF
_REAL, _INT = dialect.MAV_PARAM_TYPE_REAL32, dialect.MAV_PARAM_TYPE_INT32


class FakePx4:
    def __init__(self, vehicle: Vehicle, version: int = V1_16, **changes: float) -> None:
        values: dict[str, float] = {"CA_ROTOR_COUNT": vehicle.motors, "CA_METHOD": 2, "MC_AIRMODE": 0}
        for i in range(vehicle.motors):
            x, y = vehicle.position_m[i]
            values |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_PZ": 0.0}
            values |= {f"CA_ROTOR{i}_AX": 0.0, f"CA_ROTOR{i}_AY": 0.0, f"CA_ROTOR{i}_AZ": -1.0}
            values |= {f"CA_ROTOR{i}_CT": 6.5, f"CA_ROTOR{i}_KM": 0.05 * vehicle.spin[i]}
            values[f"PWM_MAIN_FUNC{i + 1}"] = 101 + i
        values["THR_MDL_FAC"] = 0.65
        values |= changes
        self.names = list(values)
        self.kinds = {n: _INT if n in ("CA_ROTOR_COUNT", "CA_METHOD") or "FUNC" in n else _REAL for n in values}
        self._memory = mmap.mmap(-1, 8 * len(values))  # shared with children that are killed
        self.stored = np.frombuffer(self._memory, float)
        self.stored[:] = np.float32(list(values.values()))
        self.version = version
        self.armed = False
        self.deaf = False
        self.sets: list[tuple[str, float]] = []
        self._out = Codec(1, 1)
        self._in = Codec(1, 1)
        self._companion_out = Codec(1, COMPANION_COMPONENT)
        self._companion_in = Codec(1, COMPANION_COMPONENT)

    def value(self, name: str) -> float:
        return float(self.stored[self.names.index(name)])

    def scales(self) -> list[float]:
        return [self.value(name) for name in self.names if name.endswith("_CT")]

    def answer(self, message: Message, on_set: Callable[[], None] = lambda: None) -> list[Message]:
        (message,) = self._in.parse(self._companion_out.pack(message))
        kind = message.get_type()
        if self.deaf:
            return []
        if kind == "COMMAND_LONG" and message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            version = dialect.MAVLink_autopilot_version_message(
                0, self.version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 7
            )
            return self._through([version])
        if kind == "PARAM_REQUEST_READ" and name_of(message) in self.names:
            return self._through([self._param(name_of(message))])
        if kind == "PARAM_SET" and name_of(message) in self.names:
            name = name_of(message)
            assert message.param_type == self.kinds[name]
            value = decode(message.param_value, message.param_type, bytewise=True)
            self.stored[self.names.index(name)] = np.float32(value)
            self.sets.append((name, value))
            on_set()
            return self._through([self._param(name)])
        return []

    def heartbeat(self) -> list[Message]:
        mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return self._through([dialect.MAVLink_heartbeat_message(14, dialect.MAV_AUTOPILOT_PX4, mode, 0, 4, 3)])

    def _param(self, name: str) -> Message:
        kind = self.kinds[name]
        value = encode(self.value(name), kind, bytewise=True)
        return dialect.MAVLink_param_value_message(name.encode(), value, kind, len(self.names), 0)

    def _through(self, messages: list[Message]) -> list[Message]:
        return [received for m in messages for received in self._companion_in.parse(self._out.pack(m))]


def talk(adapter: Px4Adapter, px4: FakePx4, start_s: float, seconds: float, on_set: Callable[[], None] = lambda: None):
    """Let both speak for a while; the time at its end."""
    now = start_s
    for message in px4.heartbeat():
        adapter.observe(message)
    while now < start_s + seconds:
        for request in adapter.tick(now):
            for reply in px4.answer(request, on_set):
                adapter.observe(reply)
        now += 0.02
    return now
