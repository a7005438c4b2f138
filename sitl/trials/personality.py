"""Which autopilot the vehicles of a trial are: as plain as our dialect, ArduPilots with our applet, or PX4s."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError
from sitl.trials.virtual import Px4Trial, Workshop

PERSONALITIES = ("plain", "ardupilot", "px4")


@dataclass(frozen=True, kw_only=True)
class Personality:
    """What ``VirtualFlight`` takes of it; both None: our dialect."""

    workshop: Workshop | None = None
    px4: Px4Trial | None = None


def prepared(name: str, vehicle: Vehicle, allocation: str, folder: str) -> Personality:
    """For autopilots that fly ``vehicle``; ``folder`` for the scripts of ArduPilots, and for the journals of what was
    changed in PX4s. Raises ConfigError for an unknown name."""
    if name == "ardupilot":
        return Personality(workshop=Workshop.prepare(vehicle, allocation, folder))
    if name == "px4":
        return Personality(px4=Px4Trial(state=Path(folder)))
    if name != "plain":
        raise ConfigError(f"personality {name!r} is unknown: choose one of {', '.join(PERSONALITIES)}")
    return Personality()
