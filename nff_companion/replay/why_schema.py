"""What ``nff why --json`` prints, as types: the schema that is shipped (``why.schema.json``) is made of them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

Count = Annotated[int, msgspec.Meta(ge=0)]
Seconds = Annotated[float, msgspec.Meta(ge=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class Explained(msgspec.Struct, forbid_unknown_fields=True):
    """Share of the variance of the measured accelerations; null: too little flight before the fault."""

    thrust: Share | None
    roll: Share | None
    pitch: Share | None
    yaw: Share | None


class Fault(msgspec.Struct, forbid_unknown_fields=True):
    """One declaration; motors from 1, times in s from the first record."""

    motor: Annotated[int, msgspec.Meta(ge=1, le=12)]
    time_s: Seconds
    effectiveness: float
    confidence: Share
    lifted_s: Seconds | None


class Airframe(msgspec.Struct, forbid_unknown_fields=True):
    """The vehicle that the flight was judged with. Made of a log, thrust and inertia go with a guessed mass and arm."""

    name: str
    made_of: Literal["log", "file"]
    motors: Annotated[int, msgspec.Meta(ge=4, le=12)]
    arm_m: float
    mass_kg: float
    inertia_kg_m2: Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
    max_thrust_n: float
    torque_per_thrust_m: float
    time_constant_s: float
    hover: Share
    how: list[str]


class Flight(msgspec.Struct, forbid_unknown_fields=True):
    """One flight of one vehicle."""

    file: str
    system: int | None
    verdict: Literal["fault", "no_fault", "not_judged"]
    reason: str
    frame: str | None
    duration_s: Seconds
    judged_s: Seconds
    refused_samples: Count
    explained: Explained
    faults: list[Fault]
    notes: list[str]
    airframe: Airframe | None


class Document(msgspec.Struct, forbid_unknown_fields=True):
    """What is printed."""

    flights: list[Flight]


def schema() -> dict[str, Any]:
    """JSON schema, draft 2020-12."""
    made = msgspec.json.schema(Document)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "nff why --json", **made}
