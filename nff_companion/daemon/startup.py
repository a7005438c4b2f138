"""What the daemon and its doctor make of one configuration, the same for both."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable
from pathlib import Path

from nff_companion.autopilots.meeting import Meeting
from nff_companion.calibration.recorder import FlightRecorder
from nff_companion.companion import Companion
from nff_companion.core import basis_network
from nff_companion.core import vehicle as vehicle_model
from nff_companion.daemon.configuration import MODES, Config, default_state_folder
from nff_companion.mavlink.codec import Message
from nff_companion.session import Session, SessionOptions

log = logging.getLogger("nff")

_JOURNAL = "parameters.journal"


def prepare(
    config: Config, now_s: float, *, act: bool = True, host_status: Callable[[], Message] | None = None
) -> Session:
    """The session of ``config``; ``act`` False: one that changes nothing. Raises ConfigError, NetworkError."""
    vehicle = vehicle_model.load(config.vehicle.airframe, thrust_to_weight=config.vehicle.thrust_to_weight)
    folder = state_folder(config)
    link, method = config.link, config.companion.allocation
    instance = 1 + secrets.randbelow(0xFFFF)
    meeting = Meeting(vehicle, link.autopilot, method, folder / _JOURNAL, link.px4_method, instance=instance)
    network = basis_network.for_vehicle(vehicle, config.vehicle.network, config.tuning.network)
    note = basis_network.left_out(vehicle, config.vehicle.network)
    if note and act:
        log.warning("network %s", note)
    confirmed = config.companion.confirmed or bool(vehicle.confirmed)
    companion = Companion(vehicle, link.rate_hz, config.tuning, allocation=method, network=network, confirmed=confirmed)
    options = SessionOptions(
        mode=MODES[config.companion.mode] if act else MODES["observe"],
        rate_hz=link.rate_hz,
        component=link.component,
        system=link.system,
        stream_timeout_s=link.stream_timeout_s,
        act=act,
        network_note=note,
    )
    recorder = None
    if act and config.companion.propose:
        kept = config.tuning.proposal
        recorder = FlightRecorder(vehicle.motors, min(round(kept.memory_s * link.rate_hz), kept.samples_max))
    return Session(companion, meeting, options, now_s, host_status, recorder)


def state_folder(config: Config) -> Path:
    """Where what must survive is kept."""
    return Path(config.companion.state_folder or default_state_folder())


def endpoints(config: Config) -> list[str]:
    """All endpoint URLs, the autopilot's first."""
    return [config.link.endpoint, *config.link.more_endpoints]
