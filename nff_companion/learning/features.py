"""What the basis network is fed with: one vector for training and for flight.

The published inputs are velocity, attitude and motor commands (Science Robotics 2022; RA-L 2024: 15 of them). Ours are
the same facts without what physics says cannot matter (heading), with the wind made visible:

- velocity over ground in the body frame (3), m/s;
- lateral specific force (2), m/s^2: the drag of rotors and airframe, so a measure of the air speed;
- direction of gravity in the body frame, x and y (2): attitude without heading;
- body rates (3), rad/s;
- B0 w (4): the accelerations that the motors are asked for, after the filters of the residual. The motors enter as the
  wrench that they make: in the null space of B0, where no flight without a failure ever was, the network is blind and
  cannot be wrong.
"""

from __future__ import annotations

import numpy as np

NAMES = (
    "velocity_x",
    "velocity_y",
    "velocity_z",
    "force_x",
    "force_y",
    "gravity_x",
    "gravity_y",
    "rate_x",
    "rate_y",
    "rate_z",
    "command_thrust",
    "command_roll",
    "command_pitch",
    "command_yaw",
)
COMMAND = slice(10, 14)


def features(
    velocity_m_s: np.ndarray,
    quaternion: np.ndarray,
    lateral_m_s2: np.ndarray,
    rate_rad_s: np.ndarray,
    commanded: np.ndarray,
) -> np.ndarray:
    """Input vector (14,) from NED velocity (3,), body-to-NED quaternion (4,), lateral specific force (2,), body rates
    (3,) and B0 w (4,)."""
    w, x, y, z = quaternion.tolist()
    north, east, down = velocity_m_s.tolist()
    gx, gy, gz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return np.array(
        [
            (1 - 2 * (y * y + z * z)) * north + 2 * (x * y + w * z) * east + gx * down,
            2 * (x * y - w * z) * north + (1 - 2 * (x * x + z * z)) * east + gy * down,
            2 * (x * z + w * y) * north + 2 * (y * z - w * x) * east + gz * down,
            *lateral_m_s2.tolist(),
            gx,
            gy,
            *rate_rad_s.tolist(),
            *commanded.tolist(),
        ]
    )
