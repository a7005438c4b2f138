"""Fleet and companions in virtual time: many vehicles stepped together, each with the session that ships.

Every message is encoded, delayed and decoded; loop, schedule and adapters are the product's own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from nff_companion.allocation import allocator, tables
from nff_companion.allocation.plan import Plan
from nff_companion.autopilots.ardupilot.before import of_trial
from nff_companion.autopilots.ardupilot.install import install
from nff_companion.autopilots.base import Adapter
from nff_companion.autopilots.meeting import Kind, Meeting
from nff_companion.autopilots.px4.adapter import Method
from nff_companion.companion import Companion
from nff_companion.companion_state import Orders, Output
from nff_companion.condition import Mode
from nff_companion.core import basis_network
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.decision import Event
from nff_companion.core.parts import FLOWN, Parts
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import COMPANION_COMPONENT, Codec, Message
from nff_companion.session import Session, SessionOptions
from nff_companion.vehicle_link import Outgoing
from sitl import rotation
from sitl.fleet import AUTOPILOT_RATE_HZ, Fleet
from sitl.trials.channel import Channel
from sitl.trials.wire import SYSTEM, WireAutopilot

Alter = Callable[[Sample], Sample]


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """One companion of a trial."""

    mode: Mode = Mode.ALLOCATE
    tuning: Tuning = field(default_factory=Tuning)
    allocation: str = "trim"
    network: str = "airframe"
    parts: Parts = FLOWN
    confirmed: bool = True  # the airframe file is the plant's own
    airframe: str = ""  # of this companion; empty: the flight's
    alter: Alter | None = None  # the hand of a test on this companion's samples, in place of the flight's


@dataclass(frozen=True)
class Workshop:
    """What all companions of one airframe share: allocations computed ahead, and the card with the scripts."""

    plans: dict[int, Plan]
    card: Path

    @staticmethod
    def prepare(vehicle: Vehicle, method: str, folder: str) -> Workshop:
        """Compute and install into ``folder``."""
        card = Path(folder)
        install(vehicle, card, of_trial(vehicle), method=method)
        return Workshop(tables.compute(vehicle, allocator(method)), card)


@dataclass(frozen=True, kw_only=True)
class Px4Trial:
    """``state``: folder of the companions' journals; ``method`` by which they tell PX4 of a failure; ``parameters``
    that are not stock."""

    state: Path
    method: Method = "scale"
    parameters: Mapping[str, float | int] = field(default_factory=dict)


def temporary_card() -> tempfile.TemporaryDirectory[str]:
    """A folder for a card; removed when it is no longer used."""
    return tempfile.TemporaryDirectory(prefix="nff-card-")


class AlteredAdapter:
    """The hand of a test on the samples that an adapter gives."""

    def __init__(self, adapter: Adapter, alter: Alter) -> None:
        self._adapter, self._alter = adapter, alter

    def __getattr__(self, name: str) -> object:
        return getattr(self._adapter, name)

    def observe(self, message: Message, now_s: float) -> Sample | None:
        """The adapter's sample, altered."""
        sample = self._adapter.observe(message, now_s)
        return None if sample is None else self._alter(sample)


class _TrialMeeting(Meeting):
    """Adapters with a test's hand on their samples."""

    alter: Alter | None = None

    def adapter(self, kind: Kind, target: tuple[int, int]) -> Adapter:
        """A new one."""
        found = super().adapter(kind, target)
        # What it does not define itself it hands on, which no type says.
        return found if self.alter is None else cast("Adapter", AlteredAdapter(found, self.alter))


class TrialCompanion:
    """One vehicle of the fleet, its link, and its companion; and what that did."""

    def __init__(self, index: int, session: Session, autopilot: WireAutopilot, link_delay_s: float) -> None:
        self.index, self.session, self.autopilot = index, session, autopilot
        # The delay is for one direction each way, as a serial link has it.
        self.down: Channel[bytes] = Channel(link_delay_s)
        self.up: Channel[bytes] = Channel(link_delay_s)
        self._codec = Codec(SYSTEM, COMPANION_COMPONENT)
        self._now_s = 0.0
        self.events: list[tuple[float, Event]] = []

    @property
    def output(self) -> Output:
        """Of the last step."""
        return self.session.output

    @property
    def attitude_desired(self) -> NDArray[np.float64] | None:
        """(3, 3) body to NED that the override's law wanted last; None when it does not close the loop."""
        desired = self.session.state.loop.memory.desired
        return None if desired is None else np.array(desired).T

    def before(self, now_s: float) -> None:
        """The autopilot's side before its loops."""
        for data in self.up.receive(now_s):
            self.autopilot.take(data)
        self.autopilot.scripts()

    def after(self, now_s: float) -> None:
        """The autopilot's telemetry after its loops."""
        self.autopilot.telemetry()
        for data in self.autopilot.outgoing():
            self.down.send(now_s, data)

    def think(self, now_s: float) -> None:
        """The companion's turn: what has arrived, and what is due."""
        self._now_s = now_s
        for data in self.down.receive(now_s):
            for message in self._codec.parse(data):
                self._send(self.session.take(message, 0, now_s))
        self._send(self.session.due(now_s))
        self.events += self.session.news()

    def order(self, orders: Orders) -> None:
        """The operator's word."""
        self._send(self.session.order(orders, self._now_s))

    def _send(self, outgoing: list[Outgoing]) -> None:
        for item in outgoing:
            self.up.send(self._now_s, self._codec.pack(item.message))


class VirtualFlight:
    """A fleet, some of whose vehicles have a companion."""

    def __init__(  # noqa: PLR0913 - the options of a trial, all by name
        self,
        fleet: Fleet,
        companions: dict[int, TrialOptions],
        *,
        airframe: str,
        thrust_to_weight: float | None = None,
        rate_hz: float = 200.0,
        link_delay_s: float = 0.01,
        workshop: Workshop | None = None,
        rotor_speeds: bool = False,
        alter: Alter | None = None,
        stubborn_hz: float | None = None,
        px4: Px4Trial | None = None,
    ) -> None:
        """``workshop``: the vehicles are ArduPilots with our applet; ``px4``: they are PX4s; with neither, they speak
        our dialect. ``alter`` is the hand of a test on the samples."""
        self.fleet = fleet
        model = vehicle_model.load(airframe, thrust_to_weight=thrust_to_weight)
        rate = AUTOPILOT_RATE_HZ / max(round(AUTOPILOT_RATE_HZ / rate_hz), 1)
        self.companions: list[TrialCompanion] = []
        flown = model
        for index, options in companions.items():
            model = vehicle_model.load(options.airframe) if options.airframe else flown
            meeting = _TrialMeeting(
                model,
                "px4" if px4 is not None else "nff" if workshop is None else "ardupilot",
                options.allocation,
                Path("/nonexistent") if px4 is None else px4.state / f"{index + 1}.journal",
                "scale" if px4 is None else px4.method,
                instance=index + 1,
                plans=None if workshop is None else workshop.plans,
            )
            meeting.alter = options.alter or alter
            named = options.network
            if named == "airframe" and not options.airframe:
                named = model.network or "airframe"  # by its name: also where the trial has changed the thrust
            companion = Companion(
                model,
                rate,
                options.tuning,
                allocation=options.allocation,
                network=basis_network.for_vehicle(model, named),
                parts=options.parts,
                confirmed=options.confirmed,
            )
            session = Session(companion, meeting, SessionOptions(mode=options.mode, rate_hz=rate), 0.0)
            card = None if workshop is None else workshop.card
            autopilot = WireAutopilot(
                fleet,
                index,
                card=card,
                rotor_speeds=rotor_speeds,
                stubborn_hz=stubborn_hz,
                px4=None if px4 is None else px4.parameters,
            )
            self.companions.append(TrialCompanion(index, session, autopilot, link_delay_s))

    def step(self) -> None:
        """One autopilot cycle of the fleet, and what the companions do in it."""
        fleet = self.fleet
        up = [companion for companion in self.companions if not fleet.state.crashed[companion.index]]
        for companion in up:
            companion.before(fleet.time_s)
        fleet.step()
        for companion in up:
            if not fleet.state.crashed[companion.index]:
                companion.after(fleet.time_s)
        for companion in self.companions:
            companion.think(fleet.time_s)


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
