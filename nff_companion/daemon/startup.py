"""What the daemon and its doctor make of one configuration, the same for both."""

from __future__ import annotations

from pathlib import Path

from nff_companion.autopilots.meeting import Meeting
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.vehicle import Vehicle
from nff_companion.daemon.configuration import Config, default_state_folder

_JOURNAL = "parameters.journal"


def prepare(config: Config) -> tuple[Vehicle, Meeting]:
    """The vehicle, and the adapters it may need. Raises ConfigError."""
    vehicle = vehicle_model.load(config.vehicle.airframe, thrust_to_weight=config.vehicle.thrust_to_weight)
    folder = Path(config.companion.state_folder or default_state_folder())
    link, method = config.link, config.companion.allocation
    return vehicle, Meeting(vehicle, link.autopilot, method, folder / _JOURNAL, link.px4_method)


def endpoints(config: Config) -> list[str]:
    """All endpoint URLs, the autopilot's first."""
    return [config.link.endpoint, *config.link.more_endpoints]
