"""One vehicle of the fleet as a PX4 to whoever speaks MAVLink with it."""

from __future__ import annotations

from collections.abc import Mapping

from nff_companion.errors import ConfigError
from sitl.autopilot.px4.commander import Px4Commander
from sitl.autopilot.px4.mixer import Px4Mixer
from sitl.autopilot.px4.parameters import ParameterTable, hover_of, stock
from sitl.autopilot.px4.telemetry import Px4Telemetry
from sitl.fleet import Fleet


class Px4Personality:
    """Its loops are the emulation's, tuned for the vehicle; allocation and outputs are PX4's, by its parameters."""

    def __init__(
        self, fleet: Fleet, vehicle: int = 0, system: int = 1, changes: Mapping[str, float | int] | None = None
    ) -> None:
        """``changes`` of stock parameters, as they were at boot. Raises ConfigError for an airframe whose outputs PX4
        does not drive."""
        nominal = fleet.nominal
        least, most = float(nominal.spin_min[0]), nominal.spin_max
        if (least, most) != (0.0, 1.0):
            raise ConfigError(
                f"airframe {nominal.name}: PX4 drives outputs over their whole range, spin_min 0 and spin_max 1, not "
                f"{least:g} and {most:g}; take px4-octo-x, or make one with `nff airframe new --autopilot px4`"
            )
        self.table = ParameterTable(stock(nominal, hover_of(nominal), system) | dict(changes or {}))
        self.mixer = Px4Mixer(self.table, nominal)
        self.telemetry = Px4Telemetry(fleet, vehicle, self.table, self.mixer)
        self.commander = Px4Commander(fleet, vehicle, self.telemetry, self.table, self.mixer)
        fleet.autopilot.mixers[vehicle] = self.mixer

    def step(self) -> None:
        """To be called at each autopilot cycle, before the loops."""
        self.telemetry.noted()
