"""One flight of one vehicle in a log, as the readers hand it over: before an airframe is chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.telemetry_decoder import OUTPUT_AGE_MAX_S
from nff_companion.calibration.record import NO_BATTERY
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NotJudged
from nff_companion.replay.parameters import Parameters

Row = tuple[float, Sample]  # time of arrival in s, which is the sample's own where the log has no other
# Streams of 10 Hz jitter. What is older is no output that the sample was flown with.
OUTPUT_GAP_MAX_S = 1.5 * OUTPUT_AGE_MAX_S


@dataclass(frozen=True)
class Frame:
    """What the log says of the vehicle's frame; ``motors`` None: it does not say how many."""

    text: str
    motors: int | None = None
    frame_class: int | None = None
    frame_type: int | None = None


@dataclass(frozen=True)
class Reading:
    """``rows`` in the order of the log; ``outputs_hz`` at which the message ``outputs`` has the motors' outputs;
    ``battery`` (B, 2): s of the samples' clock, V at its terminals."""

    rows: Sequence[Row]
    outputs: str
    outputs_hz: float
    battery: NDArray[np.float64] = field(default_factory=lambda: NO_BATTERY)


@dataclass(frozen=True, kw_only=True)
class LogFlight:
    """``read`` gives the samples for an airframe; it raises LogError, and NotJudged with what is missing or contradicts
    the airframe. ``fit`` is the airframe behind the filters that the log tells of."""

    path: Path
    autopilot: Literal["ardupilot", "px4", ""]  # empty: another, or not known
    system: int | None  # MAVLink system, where the log tells
    parameters: Parameters
    frame: Frame | None
    first_s: float  # the first record
    take_off_s: float  # parameters count as they were then
    read: Callable[[Vehicle], Reading]
    fit: Callable[[Vehicle], Vehicle] = lambda vehicle: vehicle
    notes: list[str] = field(default_factory=list)  # what of the file could not be read

    @property
    def name(self) -> str:
        """File, and where the log tells the system."""
        return str(self.path) if self.system is None else f"{self.path} (system {self.system})"


def rate_of_outputs(time_s: NDArray[np.float64], name: str) -> float:
    """Hz of motor outputs at ``time_s`` (K,), of the message ``name``. Raises NotJudged where it is too low for
    anything."""
    gaps = np.diff(time_s)
    gaps = gaps[gaps > 0.0]
    if len(gaps) == 0:
        raise NotJudged(f"{name}: {len(time_s)} records with motor outputs; log them")
    gap_s = float(np.median(gaps))
    if gap_s > OUTPUT_GAP_MAX_S:
        least = 1.0 / OUTPUT_AGE_MAX_S
        raise NotJudged(f"{name} at {1.0 / gap_s:.2g} Hz: motor outputs at {least:.0f} Hz or more are needed")
    return 1.0 / gap_s


def newest(times: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index of the newest of ``times`` (K,) at each of ``at`` (N,), -1 before the first."""
    return np.asarray(np.searchsorted(times, at, side="right") - 1, np.int64)


def interpolated(
    times: NDArray[np.float64], values: NDArray[np.float64], at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Columns of ``values`` (K, c) at ``at`` (N,)."""
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)


def far(times: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) where what lies on either side is too far apart to be interpolated, or there is nothing on one."""
    index = newest(times, at)
    inside = (index >= 0) & ((index < len(times) - 1) | (times[index] == at))
    after = times[np.minimum(index + 1, len(times) - 1)]
    return ~inside & (np.abs(at - times[np.clip(index, 0, None)]) > OUTPUT_GAP_MAX_S) | (
        inside & (after - times[np.clip(index, 0, None)] > OUTPUT_GAP_MAX_S)
    )
