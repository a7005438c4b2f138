"""One telemetry sample, as the pipeline takes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SPEED_MAX_M_S = 200.0  # beyond what a vehicle flies: a fault of the estimate or of the link


@dataclass(slots=True)
class Sample:
    """One complete sample. FRD body, NED world, SI units; time in s of the autopilot's clock.

    ``output`` (m,): motor outputs 0..1 as the autopilot drives them (NaN: unknown). ``position_m``, ``velocity_m_s``
    and the targets are None where the autopilot does not send them. ``thrust`` is given instead of ``output`` by
    logs that hold thrusts: fractions of full thrust.
    """

    time_s: float
    gyro_rad_s: NDArray[np.float64]  # (3,)
    specific_force_m_s2: NDArray[np.float64]  # (3,)
    output: NDArray[np.float64]  # (m,)
    armed: bool
    quaternion: NDArray[np.float64] | None = None  # (4,) w x y z, body to NED
    position_m: NDArray[np.float64] | None = None  # (3,)
    velocity_m_s: NDArray[np.float64] | None = None  # (3,)
    target_position_m: NDArray[np.float64] | None = None  # (3,)
    target_yaw_rad: float | None = None
    target_velocity_m_s: NDArray[np.float64] | None = None  # (3,)
    target_acceleration_m_s2: NDArray[np.float64] | None = None  # (3,)
    landed: bool | None = None  # by the autopilot's word; None: it does not say
    thrust: NDArray[np.float64] | None = None  # (m,)
    rotor_speed_rad_s: NDArray[np.float64] | None = None  # (m,) NaN: no reading
    rotor_speed_time_s: NDArray[np.float64] | None = None  # (m,) when each was read

    @property
    def moves_plausibly(self) -> bool:
        """Attitude and velocity are there, finite, and those of a vehicle."""
        q, velocity = self.quaternion, self.velocity_m_s
        if q is None or velocity is None:
            return False
        # Comparisons with NaN are false.
        w, x, y, z = q.tolist()
        unit = abs(w * w + x * x + y * y + z * z - 1.0) < 0.05
        return unit and all(-_SPEED_MAX_M_S <= v <= _SPEED_MAX_M_S for v in velocity.tolist())
