"""What is found when everything was read: can this PX4 be told of its motors, and with which words?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from nff_companion.autopilots.px4 import outputs, rates
from nff_companion.autopilots.px4.injection import INJECTION_NEEDS
from nff_companion.autopilots.px4.journal import Entry
from nff_companion.autopilots.px4.parameter_change import names_of
from nff_companion.autopilots.px4.remedy import Advisor, disagreement, geometry_of
from nff_companion.autopilots.px4.remedy_book import RemedyBook
from nff_companion.condition import Reason, Statement
from nff_companion.core.vehicle import Vehicle

_SUFFIXES = ("PX", "PY", "PZ", "AX", "AY", "AZ", "CT", "KM")


@dataclass(frozen=True)
class Examined:
    """``found``: CT and KM as they were before us. ``left``: an earlier run has left them changed."""

    found: Mapping[str, float]
    left: bool
    advisor: Advisor
    remedies: RemedyBook


def names(vehicle: Vehicle) -> list[str]:
    """Parameters that are looked at; samples wait for the first."""
    rotors = [f"CA_ROTOR{i}_{suffix}" for i in range(vehicle.motors) for suffix in _SUFFIXES]
    others = ["CA_ROTOR_COUNT", "CA_METHOD", "MC_AIRMODE", "THR_MDL_FAC", *INJECTION_NEEDS]
    return [rates.INTEGRATION, *rotors, *others, *outputs.names(vehicle)]


def examine(
    values: Mapping[str, float], vehicle: Vehicle, left: list[Entry], *, injecting: bool
) -> Examined | Statement:
    """From parameter ``values`` and the journal ``left`` over; why nothing may be told, where that is found."""
    motors = vehicle.motors
    count = values.get("CA_ROTOR_COUNT", 0.0)
    if int(count) != motors:
        return Statement(Reason.CONTRADICTION, f"CA_ROTOR_COUNT is {count:.0f}, the airframe has {motors} motors")
    mine = names_of(motors)
    strange = next((entry.name for entry in left if entry.name not in mine), None)
    if strange is not None:
        detail = f"journal holds {strange}, which this airframe lacks: connect that vehicle, or remove the file"
        return Statement(Reason.JOURNAL, detail)
    try:
        found = {name: values[name] for name in mine}
        found.update({entry.name: entry.value for entry in left})
        geometry = geometry_of({**values, **found}, motors)
    except KeyError as error:
        return Statement(Reason.PARAMETER_SILENT, str(error.args[0]))
    wrong = (
        disagreement(geometry, vehicle)
        or outputs.contradiction(values, vehicle)
        or outputs.conflict(values, found, injecting=injecting)
    )
    if wrong:
        return Statement(Reason.CONTRADICTION, wrong)
    advisor = Advisor(vehicle, geometry)
    return Examined(found, bool(left), advisor, RemedyBook(advisor, motors))
