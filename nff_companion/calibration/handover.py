"""What the daemon hands to the process that calibrates from its flights, and what that answers."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.errors import LogError

_WIDTH = 13  # of a row of recorder.py, without the motors


class Flown(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The head: ``airframe`` file or name with which it was flown, behind which filters, and parameters that the
    autopilot has as the file says; ``target`` is the file to be written."""

    airframe: str
    target: str
    motors: int
    samples: int
    thrust_to_weight: float | None = None
    gyro_filter_hz: float
    accelerometer_filter_hz: float
    told: dict[str, float] = {}


class Outcome(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``proposed``: ``file`` was written; ``agrees``: the file flown is as good; ``missing``: what is said in
    ``missing`` must be flown first; ``refused``: nothing can be made of these flights; ``failed``: file, disk, memory.

    ``differs`` as (short for the pilot, sentence)."""

    outcome: Literal["proposed", "agrees", "missing", "refused", "failed"]
    text: str
    differs: list[tuple[str, str]] = []
    missing: list[str] = []
    file: str = ""
    flown_s: float = 0.0


def packed(flown: Flown, time_s: NDArray[np.float64], values: NDArray[np.float32]) -> bytes:
    """One line of JSON, then the numbers as they are in memory."""
    return msgspec.json.encode(flown) + b"\n" + time_s.tobytes() + values.tobytes()


def unpacked(data: bytes) -> tuple[Flown, NDArray[np.float64], NDArray[np.float32]]:
    """Raises LogError where ``data`` is none of it."""
    line, _, numbers = data.partition(b"\n")
    try:
        flown = msgspec.json.decode(line, type=Flown)
        count, width = flown.samples, _WIDTH + flown.motors
        time_s = np.frombuffer(numbers, np.float64, count)
        values = np.frombuffer(numbers, np.float32, count * width, offset=time_s.nbytes).reshape(count, width)
    except (msgspec.ValidationError, msgspec.DecodeError, ValueError) as error:
        raise LogError(f"what was flown cannot be understood: {error}") from error
    return flown, time_s, values
