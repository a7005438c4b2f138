"""Which way of declaring a motor failed each firmware version understands (read in its source, flown on v1.16)."""

from __future__ import annotations

from dataclasses import dataclass

from nff_companion.mavlink.codec import dialect


@dataclass(frozen=True)
class Behaviour:
    """``inject_type``: FAILURE_TYPE that makes it reallocate; None: none does."""

    scales: bool
    inject_type: int | None


_KNOWN = {
    (1, 14): Behaviour(scales=True, inject_type=None),
    (1, 15): Behaviour(scales=True, inject_type=None),
    (1, 16): Behaviour(scales=True, inject_type=int(dialect.FAILURE_TYPE_OFF)),
    (1, 17): Behaviour(scales=True, inject_type=int(dialect.FAILURE_TYPE_STUCK)),
}


def version_of(flight_sw_version: int) -> tuple[int, int, int]:
    """Major, minor, patch of AUTOPILOT_VERSION."""
    return flight_sw_version >> 24 & 0xFF, flight_sw_version >> 16 & 0xFF, flight_sw_version >> 8 & 0xFF


def text_of(version: tuple[int, int, int]) -> str:
    """As people write it."""
    return ".".join(str(part) for part in version)


def behaviour(version: tuple[int, int, int]) -> Behaviour | None:
    """What this version does; None for one that nobody has looked at."""
    return _KNOWN.get(version[:2])
