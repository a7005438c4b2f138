"""Rates that PX4 honours."""

from __future__ import annotations

from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.services.streams import Stream

_RATE_MAX_HZ = 250.0  # of its control loop: an interval below 4 ms is never met, one a little above at half the rate


def streams(rate_hz: float) -> list[Stream]:
    """Messages to ask for when samples at ``rate_hz`` are wanted. Beyond 125 Hz, 250 Hz is asked for, and stated."""
    ids = dialect
    rate = _RATE_MAX_HZ if rate_hz > 0.5 * _RATE_MAX_HZ else rate_hz
    return [
        Stream(ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate),
        Stream(ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, rate),
        Stream(ids.MAVLINK_MSG_ID_HIGHRES_IMU, rate),
        Stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, min(rate, 50.0), required=False),
        Stream(ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0, required=False),
        Stream(ids.MAVLINK_MSG_ID_ESC_STATUS, min(rate, 100.0), required=False),
    ]
