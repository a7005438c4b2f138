"""What the basis network is fed with: one vector for training and for flight.

The published inputs are velocity, attitude and motor commands (Science Robotics 2022; RA-L 2024: 15 of them). Ours are
the same facts without what physics says cannot matter (heading), with the wind made visible:

- velocity over ground in the body frame (3), m/s;
- lateral specific force (2), m/s^2: the drag of rotors and airframe, so a measure of the air speed;
- direction of gravity in the body frame, x and y (2): attitude without heading;
- body rates (3), rad/s;
- thrust of B0 w: the upward acceleration that the motors are asked for, after the filters of the residual, m/s^2.

The single motors are left out on purpose. In the null space of B0 no flight without a failure ever was. And in steady
flight the angular accelerations are zero, so that y = -B0 w on those axes: from the commanded torques a network can
read the answer, a failure's as well as the wind's, and would explain away what it is there to leave visible.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
)
COMMAND = 10  # index of the input that depends on u


def features(
    velocity_m_s: NDArray[np.float64],
    quaternion: NDArray[np.float64],
    lateral_m_s2: NDArray[np.float64],
    rate_rad_s: NDArray[np.float64],
    commanded: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Input vector (11,) from NED velocity (3,), body-to-NED quaternion (4,), lateral specific force (2,), body rates
    (3,) and B0 w (n,)."""
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
            float(commanded[0]),
        ]
    )
