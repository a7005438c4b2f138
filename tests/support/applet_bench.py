"""A vehicle in the air with the shipped applet in a real Lua, and a hand that sends it messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.ardupilot import tunnel
from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.autopilots.ardupilot.tunnel import Kind, TunnelMessage
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, dialect
from sitl import airframe
from sitl.autopilot.ardupilot.personality import ArduPilotPersonality
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet, FleetOptions

SYSTEM = 1
INSTANCE = 4711


class AppletBench:
    """``send`` and ``fly``; what the applet answered is in ``heard``, newest last."""

    def __init__(self, folder: Path, *, scripted: bool = True, height_m: float = 10.0) -> None:
        self.vehicle: Vehicle = vehicle.load("octo-x")
        install(self.vehicle, folder, of_trial(self.vehicle), scripted=scripted)
        self.fleet = Fleet(airframe.load(vehicle.path_of("octo-x")), FleetOptions(seeds=[1], height_m=height_m))
        parameters = {"FRAME_CLASS": 17.0 if scripted else 3.0}
        self.autopilot = ArduPilotPersonality(self.fleet, 0, folder, parameters, SYSTEM)
        self._companion = Codec(SYSTEM, COMPANION_COMPONENT)
        self._at_autopilot = Codec(SYSTEM, 1)
        self.heard: list[TunnelMessage] = []
        self.told: list[tuple[int, int, TunnelMessage]] = []  # with channel and component that it was sent to
        self.sequence = 0

    @property
    def now_ms(self) -> int:
        return self.autopilot.millis()

    @property
    def applied(self) -> dict[str, int]:
        return next(m.values for m in reversed(self.heard) if m.kind == Kind.APPLIED)

    @property
    def factors(self) -> NDArray[np.float64]:
        assert self.autopilot.port.factors is not None
        return self.autopilot.port.factors

    @property
    def pwm(self) -> NDArray[np.float64]:
        return self.autopilot.port.pwm_at(self.fleet.time_s)

    def send(
        self,
        message: TunnelMessage,
        *,
        system: int = SYSTEM,
        component: int = COMPANION_COMPONENT,
        instance: int = INSTANCE,
        channel: int = 0,
    ) -> None:
        self.sequence = tunnel.following(self.sequence)
        message.values.setdefault("sequence", self.sequence)
        message.values.setdefault("instance", instance)
        self.send_bytes(message.pack(), system=system, component=component, channel=channel)

    def send_bytes(
        self, data: bytes, *, system: int = SYSTEM, component: int = COMPANION_COMPONENT, channel: int = 0
    ) -> None:
        codec = Codec(system, component)
        frame = codec.pack(tunnel.wrap(data, (SYSTEM, 1)))
        for received in self._at_autopilot.parse(frame):
            self.autopilot.receive(received, channel)

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * AUTOPILOT_RATE_HZ)):
            self.autopilot.step()
            for channel, message in self.autopilot.outgoing():
                if message.get_type() == "TUNNEL":
                    inner = tunnel.unwrap(message)
                    assert inner is not None
                    self.heard.append(inner)
                    self.told.append((channel, message.target_component, inner))
            self.fleet.step()

    # -- messages -----------------------------------------------------------------------------------------------

    def heartbeat(self, **sender: int) -> None:
        self.send(TunnelMessage(Kind.HEARTBEAT, {}), **sender)

    def declare(self, mask: int, *, age_ms: int = 5, values: dict[str, int] | None = None, **sender: int) -> None:
        fields = {"sample_ms": self.now_ms - age_ms, "failed": mask, **(values or {})}
        self.send(TunnelMessage(Kind.DECLARATION, fields), **sender)

    def table(self, mask: int, factors: NDArray[np.int16]) -> None:
        self.send(TunnelMessage(Kind.TABLE, {"failed": mask}, factors))

    def release(self, *, leaving: bool = False, **sender: int) -> None:
        flags = tunnel.LEAVING if leaving else 0
        self.send(TunnelMessage(Kind.RELEASE, {"sample_ms": self.now_ms - 5, "flags": flags}), **sender)

    def matrix(
        self, mask: int, factors: NDArray[np.int16], *, timeout_ms: int = 500, age_ms: int = 5, **extra: int
    ) -> None:
        values = {"sample_ms": self.now_ms - age_ms, "timeout_ms": timeout_ms, "failed": mask, "flags": 0, **extra}
        self.send(TunnelMessage(Kind.MATRIX, values, factors))

    def override(self, pwm: NDArray[np.int_], *, timeout_ms: int = 50, age_ms: int = 5, **extra: int) -> None:
        values = {"sample_ms": self.now_ms - age_ms, "timeout_ms": timeout_ms, **extra}
        self.send(TunnelMessage(Kind.OVERRIDE, values, pwm=pwm.astype(np.uint16)))


__all__ = ["AppletBench", "Kind", "TunnelMessage", "dialect"]
