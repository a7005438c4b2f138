"""What a real flight did, from what the autopilot and the companion said, in the autopilot's time."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.mavlink.codec import Message

_CRASH_TILT_DEG = 90.0
_GROUND_M = 1.0


@dataclass(slots=True)
class FlightRecord:
    """Positions NED in m at ``time_s``, tilts, events of the companion, and when motors failed and were declared."""

    time_s: list[float] = field(default_factory=list)
    position_m: list[tuple[float, float, float]] = field(default_factory=list)
    tilt_time_s: list[float] = field(default_factory=list)
    tilt_deg: list[float] = field(default_factory=list)
    yaw_rate_deg_s: list[float] = field(default_factory=list)
    events: list[tuple[float, int, bool, float]] = field(default_factory=list)  # sample time, motor, declared, eta
    faults: list[tuple[float, int]] = field(default_factory=list)  # time, mask
    applied: list[tuple[float, int]] = field(default_factory=list)  # time on the autopilot, mask

    @property
    def now_s(self) -> float:
        """The autopilot's clock, as last heard; 0 before."""
        return self.time_s[-1] if self.time_s else 0.0

    def observe(self, message: Message) -> None:
        """Take any message."""
        kind = message.get_type()
        if kind == "LOCAL_POSITION_NED":
            self.time_s.append(1e-3 * message.time_boot_ms)
            self.position_m.append((message.x, message.y, message.z))
        elif kind == "ATTITUDE":
            self.tilt_time_s.append(1e-3 * message.time_boot_ms)
            tilt = np.degrees(np.arccos(np.clip(np.cos(message.roll) * np.cos(message.pitch), -1.0, 1.0)))
            self.tilt_deg.append(float(tilt))
            self.yaw_rate_deg_s.append(float(np.degrees(message.yawspeed)))
        elif kind == "NFF_FAULT_EVENT":
            self.events.append((1e-6 * message.time_usec, message.motor, bool(message.declared), message.effectiveness))
        elif kind == "STATUSTEXT":
            text = message.text.decode(errors="replace") if isinstance(message.text, bytes) else message.text
            if (match := re.match(r"FAULT (\d+) (\d+)", text)) is not None:
                self.faults.append((1e-3 * int(match.group(2)), int(match.group(1))))
            elif (match := re.match(r"NFF: failed mask (\d+) at (\d+)", text)) is not None:
                self.applied.append((1e-3 * int(match.group(2)), int(match.group(1))))

    def summary(self, reference: NDArray[np.float64] | None, from_s: float, until_s: float) -> dict[str, Any]:
        """Crash, worst tilt, worst distance from ``reference`` (k, 3): the points of the intended path."""
        time_s, position = np.array(self.time_s), np.array(self.position_m).reshape(-1, 3)
        during = (time_s >= from_s) & (time_s <= until_s)
        tilt_time, tilt = np.array(self.tilt_time_s), np.array(self.tilt_deg)
        tilts = tilt[(tilt_time >= from_s) & (tilt_time <= until_s)]
        heights = -position[during, 2]
        worst_tilt = float(tilts.max()) if tilts.size else 0.0
        crashed = worst_tilt > _CRASH_TILT_DEG or (heights.size > 0 and float(heights.min()) < _GROUND_M)
        off = rms = 0.0
        if reference is not None and during.any():
            distance = distance_to_path(position[during], reference)
            off, rms = float(distance.max()), float(np.sqrt((distance**2).mean()))
        return {
            "crashed": bool(crashed),
            "max_tilt_deg": round(worst_tilt, 2),
            "max_position_error_m": round(off, 3),
            "position_rms_m": round(rms, 4),
            "height_lost_m": None
            if heights.size == 0 or reference is None
            else round(max(float(-reference[:, 2].mean() - heights.min()), 0.0), 3),
        }


def distance_to_path(points: NDArray[np.float64], path: NDArray[np.float64]) -> NDArray[np.float64]:
    """(k,) distance of each point (k, 3) from a polyline (j, 3), or from its only point."""
    if len(path) == 1:
        return np.asarray(np.linalg.norm(points - path[0], axis=1))
    best = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(path):
        along = b - a
        share = np.clip((points - a) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(points - (a + share[:, None] * along), axis=1))
    return best


def fault_report(record: FlightRecord, failures: list[int]) -> tuple[list[dict[str, Any]], int]:
    """Each failed motor with its delays, and the number of false declarations."""
    started = next((t for t, mask in record.faults if mask), None)
    declared = [(t, motor, eta) for t, motor, on, eta in record.events if on]
    faults = []
    for motor in failures:
        found = next(((t, eta) for t, m, eta in declared if m == motor and started is not None and t >= started), None)
        applied = next((t for t, mask in record.applied if mask >> (motor - 1) & 1), None)
        faults.append(
            {
                "motor": motor,
                "failed_at_s": started,
                "isolated_at_s": None if found is None else round(found[0], 4),
                "delay_s": None if found is None or started is None else round(found[0] - started, 4),
                "applied_delay_s": None if applied is None or started is None else round(applied - started, 4),
                "effectiveness": None if found is None else round(found[1], 3),
            }
        )
    false = sum(1 for t, motor, _ in declared if motor not in failures or started is None or t < started)
    return faults, false
