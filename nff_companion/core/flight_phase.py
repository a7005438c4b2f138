"""Is the vehicle in free flight? On the ground the ground pushes too, and any residual would be nonsense. Pure.

What stands does not climb, and what tips over on its legs climbs no higher than its arms are long: a vehicle that does
is off the ground long before it is high, and there a failure is weighed at once.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.sample import Sample
from nff_companion.core.tuning import FlightPhaseTuning
from nff_companion.core.vehicle import Vehicle


class FlightPhaseState(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of the flight. Heights in m above where the position counts from; None: not known."""

    flying: bool = False
    flew: bool = False  # since it was armed
    landed_and_disarmed: bool = False  # with this sample, after a flight
    hit: bool = False  # something was hit near the ground, and it may still be standing on it
    over: int = 0  # samples in a row beyond what the motors can give
    ground_m: float | None = None
    pushing_since_s: float | None = None
    climbing_since_s: float | None = None  # level, off the ground
    idle_since_s: float | None = None
    aloft_since_s: float | None = None  # in the air, on less thrust than would carry this airframe


class FlightPhase:
    """Constants of one airframe; ``step`` takes and returns the state."""

    def __init__(self, vehicle: Vehicle, tuning: FlightPhaseTuning | None = None) -> None:
        self._tuning, self._hover = tuning or FlightPhaseTuning(), vehicle.hover
        full = vehicle.full_thrust_n / vehicle.mass_kg
        self._arm_m = float(np.linalg.norm(vehicle.position_m[:, :2], axis=1).max())
        self._level = math.cos(math.radians(self._tuning.lifted_tilt_deg))
        self._impact_squared = (self._tuning.impact_share * full + self._tuning.impact_m_s2) ** 2

    def step(self, state: FlightPhaseState, sample: Sample, thrust: NDArray[np.float64]) -> FlightPhaseState:
        """One sample; ``thrust`` (m,) fractions commanded."""
        height = None if sample.position_m is None else -float(sample.position_m[2])
        if not sample.armed:
            return FlightPhaseState(ground_m=height, landed_and_disarmed=state.flew)
        o, time_s = self._tuning, sample.time_s
        share = float(thrust.sum()) / len(thrust) / self._hover
        pushing_since = None if share < o.thrust_share else _since(state.pushing_since_s, time_s)
        climbing_since = None
        if not state.flying and pushing_since is not None and self._climbs(sample, height, state.ground_m):
            climbing_since = _since(state.climbing_since_s, time_s)
        idle_since = None if share > o.ended_share else _since(state.idle_since_s, time_s)
        hit, ground, flying = state.hit, state.ground_m, state.flying
        force = sample.specific_force_m_s2
        over = state.over + 1 if float(force @ force) > self._impact_squared else 0
        if over >= o.impact_samples and self._low(sample, height, ground):
            # What was hit still pushes: only a climb from here, or the autopilot's word, is flight again.
            hit, ground, flying, pushing_since = True, height, False, None
        if flying:
            flying = idle_since is None or time_s - idle_since < o.ended_after_s
        elif pushing_since is not None:
            flying = self._taken_off(sample, time_s - pushing_since, height, ground, hit=hit)
            flying = flying or (not hit and climbing_since is not None and time_s - climbing_since >= o.lifted_after_s)
            hit = hit and not flying
        aloft_since = None
        if not flying and not hit and self._aloft(sample, share, ground):
            aloft_since = _since(state.aloft_since_s, time_s)
            # High up it flies all the same: the file is wrong about its thrust, which the flight will show. The
            # autopilot's word alone is not enough (ArduCopter says so on the ground, once the pilot gives throttle),
            # nor height after a flight: it may stand on a roof.
            high = height is not None and height - (ground or 0.0) > o.height_m
            flying = high and not state.flew and time_s - aloft_since >= o.assumed_after_s
        return FlightPhaseState(
            flying=flying,
            flew=state.flew or flying,
            hit=hit,
            over=over,
            ground_m=ground,
            pushing_since_s=pushing_since,
            climbing_since_s=climbing_since,
            idle_since_s=idle_since,
            aloft_since_s=aloft_since,
        )

    def _aloft(self, sample: Sample, share: float, ground_m: float | None) -> bool:
        """In the air, by the autopilot's word or its height, on a ``share`` of hover thrust that would not carry this
        airframe."""
        if not self._tuning.ended_share < share < self._tuning.thrust_share:
            return False
        if sample.landed is not None or sample.position_m is None or ground_m is None:
            return sample.landed is False
        return -float(sample.position_m[2]) - ground_m > self._tuning.height_m

    def _climbs(self, sample: Sample, height: float | None, ground: float | None) -> bool:
        """Rising from the ground, and higher than tipping over a leg lifts it. (What the autopilot says of having
        landed comes seldom: it may be a second old.)"""
        o, velocity, q = self._tuning, sample.velocity_m_s, sample.quaternion
        if height is None or ground is None or velocity is None or q is None or not sample.moves_plausibly:
            return False
        level = 1.0 - 2.0 * float(q[1] * q[1] + q[2] * q[2])
        if level < self._level or -float(velocity[2]) < o.lifted_climb_m_s:
            return False
        return height - ground > o.lifted_m + self._arm_m * math.sqrt(max(1.0 - level * level, 0.0))

    def _taken_off(
        self, sample: Sample, pushing_s: float, height: float | None, ground: float | None, *, hit: bool
    ) -> bool:
        o = self._tuning
        if height is not None and ground is not None and height - ground > o.height_m:
            return pushing_s >= o.sure_after_s
        if ground is None and sample.landed is False:
            return pushing_s >= o.told_after_s
        return pushing_s >= o.assumed_after_s and (not hit or sample.landed is False)

    def _low(self, sample: Sample, height: float | None, ground: float | None) -> bool:
        """Near enough to the ground to have hit it. Where the ground is, a restart in flight does not know: then the
        autopilot's word counts, and without one a vehicle that has no height."""
        if height is not None and ground is not None:
            return height - ground < self._tuning.impact_below_m
        return sample.landed is True or (sample.landed is None and height is None)


def _since(before: float | None, time_s: float) -> float:
    return time_s if before is None or time_s < before else before
