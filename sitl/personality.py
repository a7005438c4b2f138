"""Who the emulated autopilot is on the wire: one that speaks our dialect, an ArduPilot with scripts, or a PX4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nff_companion.mavlink.codec import dialect
from sitl.autopilot.ardupilot.personality import ArduPilotPersonality
from sitl.autopilot.px4.personality import Px4Personality
from sitl.commands import Commander
from sitl.fleet import Fleet
from sitl.parameters import FloatParameters, Parameters, stock
from sitl.telemetry import Telemetry


@dataclass(frozen=True, kw_only=True)
class Spokesman:
    """Of one vehicle; neither ``ardupilot`` nor ``px4``: it speaks our dialect."""

    telemetry: Telemetry
    commander: Commander
    parameters: Parameters
    ardupilot: ArduPilotPersonality | None = None
    px4: Px4Personality | None = None


def spokesman(
    fleet: Fleet,
    vehicle: int = 0,
    system: int = 1,
    *,
    card: Path | None = None,
    px4: Mapping[str, float | int] | None = None,
) -> Spokesman:
    """``card``: folder with scripts, of an ArduPilot; ``px4``: a PX4, with these parameters that are not stock.
    Raises ConfigError."""
    if px4 is not None:
        mind = Px4Personality(fleet, vehicle, system, px4)
        return Spokesman(telemetry=mind.telemetry, commander=mind.commander, parameters=mind.table, px4=mind)
    telemetry, values = Telemetry(fleet, vehicle), stock(fleet.nominal, system)
    scripted = None
    if card is not None:
        scripted = ArduPilotPersonality(fleet, vehicle, card, values, system)
        del telemetry.makers[dialect.MAVLINK_MSG_ID_NFF_APPLIED]
    return Spokesman(
        telemetry=telemetry,
        commander=Commander(fleet, telemetry, vehicle),
        parameters=FloatParameters(values),
        ardupilot=scripted,
    )
