"""Sessions for tests: flown in virtual time, or bare."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nff_companion.autopilots.meeting import Meeting
from nff_companion.autopilots.twins import Rank, custom_mode
from nff_companion.companion import Companion
from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle
from nff_companion.mavlink.codec import Codec, Message, dialect
from nff_companion.session import Session, SessionOptions
from nff_companion.vehicle_link import Outgoing
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialCompanion, TrialOptions, VirtualFlight


def flight(faults: list[Fault], *, mode: Mode = Mode.ALLOCATE, **options: Any) -> VirtualFlight:
    fleet = Fleet(
        plant_airframe.load(vehicle.path_of("octo-x"), thrust_to_weight=options.get("thrust_to_weight")),
        FleetOptions(seeds=[1], height_m=10.0, wind_m_s=2.0, turbulence_m_s=0.5, model_error=0.05),
        faults,
    )
    return VirtualFlight(fleet, {0: TrialOptions(mode=mode)}, airframe="octo-x", **options)


def fly(trial: VirtualFlight, until_s: float, sent: list[Message] | None = None) -> TrialCompanion:
    """Fly on; ``sent`` gathers what the companion sends."""
    companion = trial.companions[0]
    codec = Codec(1, 1)
    while trial.fleet.time_s < until_s:
        trial.step()
        if sent is not None:
            for _, data in companion.up.queue:
                sent += codec.parse(data)
            companion.up.queue.clear()  # nothing arrives: whatever is sent is looked at, not obeyed
    return companion


def reason(companion: TrialCompanion) -> Reason:
    return companion.session.moment().verdict.reason


def autopilot_heartbeat(
    system: int = 1, autopilot: int = 3, armed: bool = False, kind: int = 14, component: int = 1
) -> Message:
    mode = 1 | (128 if armed else 0)
    message = dialect.MAVLink_heartbeat_message(kind, autopilot, mode, 4, 4, 3)
    (received,) = Codec(1, 191).parse(Codec(system, component).pack(message))
    return received


def from_autopilot(message: Message, system: int = 1, component: int = 1) -> Message:
    (received,) = Codec(1, 191).parse(Codec(system, component).pack(message))
    return received


def bare_session(*, act: bool = True, system: int = 0, instance: int = 7, mode: Mode = Mode.ALLOCATE) -> Session:
    model = vehicle.load("octo-x")
    meeting = Meeting(model, "auto", "trim", Path("/nonexistent/j"), instance=instance, plans={})
    options = SessionOptions(mode=mode, act=act, system=system)
    return Session(Companion(model, 200.0), meeting, options, 0.0)


def texts(outgoing: list[Outgoing]) -> list[str]:
    return [str(item.message.text) for item in outgoing if item.message.get_type() == "STATUSTEXT"]


def companion_heartbeat(instance: int, component: int = 191, rank: Rank = Rank.CLAIMANT) -> Message:
    message = dialect.MAVLink_heartbeat_message(18, 8, 0, custom_mode(instance, Mode.ALLOCATE, rank), 4, 3)
    (received,) = Codec(1, 191).parse(Codec(1, component).pack(message))
    return received
