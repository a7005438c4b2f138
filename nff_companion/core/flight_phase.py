"""Is the vehicle in free flight? On the ground the ground pushes too, and any residual would be nonsense."""

from __future__ import annotations

import numpy as np

from nff_companion.core.sample import Sample
from nff_companion.core.tuning import DEFAULT, FlightPhaseTuning
from nff_companion.core.vehicle import Vehicle

FlightPhaseOptions = FlightPhaseTuning


class FlightPhase:
    """Small state machine over samples."""

    def __init__(self, vehicle: Vehicle, options: FlightPhaseTuning = DEFAULT.flight_phase) -> None:
        self._options, self._hover = options, vehicle.hover
        full = vehicle.motors * vehicle.motor.max_thrust_n / vehicle.mass_kg
        self._impact_m_s2 = options.impact_share * full + options.impact_m_s2
        self._hit = False
        self._over = 0
        self._flying = False
        self._ground_m: float | None = None
        self._pushing_since_s: float | None = None
        self._idle_since_s: float | None = None
        self.disarmed_after_flight = False
        self._flew = False

    def step(self, sample: Sample, thrust: np.ndarray) -> bool:
        """True while flying; ``thrust`` (m,) fractions commanded."""
        o, time_s = self._options, sample.time_s
        share = float(thrust.mean()) / self._hover
        height = None if sample.position_m is None else -float(sample.position_m[2])
        self.disarmed_after_flight = False
        if not sample.armed:
            self.disarmed_after_flight = self._flew
            self._flying = self._flew = False
            self._ground_m = height
            self._pushing_since_s = None
            self._hit = False
            return False
        force = sample.specific_force_m_s2
        self._over = self._over + 1 if float(force @ force) > self._impact_m_s2**2 else 0
        low = height is None or self._ground_m is None or height - self._ground_m < o.impact_below_m
        if self._over >= o.impact_samples and low:
            # What was hit still pushes: only a climb from here, or the autopilot's word, is flight again.
            self._hit, self._ground_m, self._flying = True, height, False
            self._pushing_since_s = None
        if share < o.thrust_share:
            self._pushing_since_s = None
        elif self._pushing_since_s is None or time_s < self._pushing_since_s:
            self._pushing_since_s = time_s
        if share > o.ended_share:
            self._idle_since_s = None
        elif self._idle_since_s is None or time_s < self._idle_since_s:
            self._idle_since_s = time_s
        if self._flying:
            idle = self._idle_since_s is not None and time_s - self._idle_since_s >= o.ended_after_s
            self._flying = not idle
        elif self._pushing_since_s is not None:
            pushing = time_s - self._pushing_since_s
            high = height is not None and self._ground_m is not None and height - self._ground_m > o.height_m
            assumed = pushing >= o.assumed_after_s and (not self._hit or sample.landed is False)
            self._flying = assumed or (high and pushing >= o.sure_after_s)
            self._hit = self._hit and not self._flying
        self._flew = self._flew or self._flying
        return self._flying
