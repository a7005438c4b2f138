"""Fleet and companions in virtual time: many vehicles stepped together, each with its own pipeline.

The link between them delays; it does not encode (the wire has its own tests and the demo).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.decision import Event
from nff_companion.core.sample import Sample
from nff_companion.pipeline import Mode, Output, Pipeline, PipelineOptions
from sitl import rotation
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.trials.channel import Channel
from sitl.trials.wire import WireCompanion, Workshop

MATRIX_TIMEOUT_S = 0.5
OVERRIDE_TIMEOUT_S = 0.1
MATRIX_INTERVAL_S = 0.05


@dataclass(frozen=True, slots=True)
class Command:
    """A command on its way to the autopilot."""

    kind: Literal["declaration", "matrix", "override"]
    sequence: int
    sample_s: float
    value: np.ndarray


class Companion:
    """One vehicle's pipeline with its two channels, and what it did."""

    def __init__(self, index: int, pipeline: Pipeline, link_delay_s: float) -> None:
        self.index, self.pipeline = index, pipeline
        # The delay is for one direction each way, as a serial link has it.
        self.down: Channel[Sample] = Channel(link_delay_s)
        self.up: Channel[Command] = Channel(link_delay_s)
        self.outputs: Output | None = None
        self.events: list[tuple[float, Event]] = []
        self._sequence = 0
        self._matrix_sent_s = -np.inf
        self._declared = np.zeros(pipeline.vehicle.motors, bool)

    def think(self, now_s: float) -> None:
        """Process the samples that have arrived and send what follows from them."""
        for message in self.down.receive(now_s):
            output = self.pipeline.step(message, self.pipeline.respond(message))
            self.outputs = output
            self.events += [(now_s, event) for event in output.events]
            if output.mode == Mode.OBSERVE:
                continue
            self._sequence += 1
            changed = bool((output.failed != self._declared).any())
            if changed:
                self._declared = output.failed.copy()
                self.up.send(now_s, Command("declaration", self._sequence, output.time_s, output.failed.copy()))
            if output.plan is not None and (changed or now_s - self._matrix_sent_s >= MATRIX_INTERVAL_S):
                self._matrix_sent_s = now_s
                self.up.send(now_s, Command("matrix", self._sequence, output.time_s, output.plan.matrix))
            if output.override is not None:
                self.up.send(now_s, Command("override", self._sequence, output.time_s, output.override))


class VirtualFlight:
    """A fleet, some of whose vehicles have a companion."""

    def __init__(
        self,
        fleet: Fleet,
        companions: dict[int, PipelineOptions],
        *,
        airframe: str,
        thrust_to_weight: float | None,
        rate_hz: float,
        link_delay_s: float,
        make_pipeline: Callable[[vehicle_model.Vehicle, float, PipelineOptions], Pipeline] = Pipeline,
        workshop: Workshop | None = None,
        rotor_speeds: bool = False,
        alter: Callable[[Sample], Sample] = lambda sample: sample,
    ) -> None:
        """``workshop``: the companions meet ArduPilot with our applet on the wire; without it, the emulation itself.
        ``alter`` is the hand of a test on the telemetry of the latter."""
        self._alter, self._rotor_speeds = alter, rotor_speeds
        self.fleet = fleet
        self._every = max(round(AUTOPILOT_RATE_HZ / rate_hz), 1)
        model = vehicle_model.load(airframe, thrust_to_weight=thrust_to_weight)
        rate = AUTOPILOT_RATE_HZ / self._every
        self.companions: list[Companion | WireCompanion] = []
        for index, options in companions.items():
            pipeline = make_pipeline(model, rate, options)
            self.companions.append(
                Companion(index, pipeline, link_delay_s)
                if workshop is None
                else WireCompanion(index, pipeline, fleet, rate, link_delay_s, workshop, rotor_speeds)
            )

    def _sample(self, index: int) -> Sample:
        return self._alter(sample_of(self.fleet, index, rotor_speeds=self._rotor_speeds))

    def step(self) -> None:
        """One autopilot cycle of the fleet, and what the companions do in it."""
        fleet = self.fleet
        now = fleet.time_s
        for companion in self.companions:
            index = companion.index
            if fleet.state.crashed[index]:
                continue
            if isinstance(companion, WireCompanion):
                companion.autopilot_step()
                continue
            for message in companion.up.receive(now):
                self._deliver(index, message, now)
        fleet.step()
        now = fleet.time_s
        for companion in self.companions:
            if fleet.state.crashed[companion.index]:
                continue
            if isinstance(companion, WireCompanion):
                companion.telemetry_step()
            elif fleet.cycle % self._every == 0:
                companion.down.send(now, self._sample(companion.index))
        for companion in self.companions:
            companion.think(fleet.time_s)

    def _deliver(self, index: int, command: Command, now_s: float) -> None:
        autopilot = self.fleet.autopilot
        port = autopilot.ports[index]
        sequence, sample_s, value = command.sequence, command.sample_s, command.value
        if command.kind == "declaration":
            armed = bool(autopilot.armed[index])
            port.receive_declaration(value, sequence=sequence, sample_s=sample_s, now_s=now_s, armed=armed)
        elif command.kind == "matrix":
            port.receive_matrix(value, sequence=sequence, sample_s=sample_s, now_s=now_s, timeout_s=MATRIX_TIMEOUT_S)
        else:
            port.receive_override(
                value,
                sequence=sequence,
                sample_s=sample_s,
                now_s=now_s,
                timeout_s=OVERRIDE_TIMEOUT_S,
                armed=bool(autopilot.armed[index]),
            )
        autopilot.port_changed()


def sample_of(fleet: Fleet, index: int, *, rotor_speeds: bool = False) -> Sample:
    """What the autopilot of vehicle ``index`` would send now."""
    measured, autopilot = fleet.sensors.measured, fleet.autopilot
    speed = None
    if rotor_speeds:
        p = fleet.parameters
        speed = np.sqrt(fleet.state.thrust_n[index] / p.max_thrust_n[index]) * p.max_speed_rad_s
    return Sample(
        time_s=fleet.time_s,
        gyro_rad_s=measured.gyro_rad_s[index],
        specific_force_m_s2=measured.specific_force_m_s2[index],
        output=autopilot.output[index],
        armed=bool(autopilot.armed[index]),
        quaternion=measured.quaternion[index],
        position_m=measured.position_m[index],
        velocity_m_s=measured.velocity_m_s[index],
        target_position_m=autopilot.position.path[index].copy(),
        target_velocity_m_s=autopilot.position.path_velocity[index].copy(),
        target_acceleration_m_s2=autopilot.position.path_acceleration[index].copy(),
        target_yaw_rad=float(rotation.yaw_of(autopilot.attitude.target[index])),
        rotor_speed_rad_s=speed,
        rotor_speed_time_s=None if speed is None else np.full(len(speed), fleet.time_s),
    )
