"""Rates that PX4 honours."""

from __future__ import annotations

import numpy as np

from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader
from nff_companion.mavlink.services.streams import Stream

INTEGRATION = "IMU_INTEG_RATE"  # inertial samples, and the attitude made of them, come no faster
_RATE_MAX_HZ = 250.0  # of its control loop: an interval below 4 ms is never met, one a little above at half the rate
_UNKNOWN_S = 2.0  # without an answer: samples are taken as they come


def streams(rate_hz: float, integration_hz: float | None = None) -> list[Stream]:
    """Messages to ask for when samples at ``rate_hz`` are wanted. Beyond 125 Hz, 250 Hz is asked for, and stated; what
    is to come is ``integration_hz`` where that is less (200 Hz on a board as it is bought)."""
    ids = dialect
    asked = _RATE_MAX_HZ if rate_hz > 0.5 * _RATE_MAX_HZ else rate_hz
    rate = asked if integration_hz is None or integration_hz < 1.0 else min(asked, integration_hz)
    return [
        Stream(ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate, asked_hz=asked),
        Stream(ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, rate, asked_hz=asked),
        Stream(ids.MAVLINK_MSG_ID_HIGHRES_IMU, rate, asked_hz=asked),
        Stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, min(rate, 50.0), required=False),
        Stream(ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0, required=False),
        Stream(ids.MAVLINK_MSG_ID_ESC_STATUS, min(rate, 100.0), required=False),
    ]


class Waiting:
    """Samples wait until it is known at which rate they come, so that the companion is built for it before it watches a
    flight: also where it was started in one."""

    def __init__(self) -> None:
        self._over = False
        self._since_s = np.inf  # the first sample

    def over(self, reader: ParameterReader, now_s: float) -> bool:
        """At a sample, whether it may be taken."""
        if not self._over:
            self._since_s = min(self._since_s, now_s)
            answered = INTEGRATION in reader.values or INTEGRATION in reader.absent
            self._over = answered or now_s >= self._since_s + _UNKNOWN_S
        return self._over
