"""Is an airframe file the frame that the autopilot flies? Motor by motor, and by name.

Two descriptions of one vehicle differ: places are measured to a tenth, and the centre of mass is not in the middle.
What is no such error is another motor's place, or another direction of rotation.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from nff_companion.core.vehicle import Vehicle
from nff_companion.frames.catalogue import SPIN_NAMES, Frame, frames

_ANGLE_MAX_DEG = 15.0  # less where the next motor is nearer than twice that
_ARM_RATIO_MIN = 0.7  # of the shorter of two arms over the longer
_OUTERMOST = 0.9  # of the largest distance from an axis
_SAME_BEARING_DEG = 0.5  # coaxial motors, or two on one arm


def contradictions_of_frame(vehicle: Vehicle, frame: Frame, called: str = "") -> list[str]:
    """What of the airframe is not so of ``frame``, in words; empty when nothing is. ``called``: how messages name it.

    Of a frame that is ArduPilot's, length and width are each compared by themselves, as its mixer is scaled
    (AP_MotorsMatrix::normalise_rpy_factors); of another one, places of any scale.
    """
    called = called or frame.name
    if frame.without:
        return [f"{called}: there is no model of it: {frame.without}"]
    if frame.motors != vehicle.motors:
        return [f"the airframe file has {vehicle.motors} motors, {called} has {frame.motors}"]
    placed, turning = _placed(vehicle, frame), vehicle.spin[:, None] == frame.spin
    wrong = ~(placed & turning).diagonal()
    if not wrong.any():
        return []
    found = frame_of(vehicle)
    other = "" if found is None else f"{found.name}{_numbers(found)}"
    if placed.diagonal().all() and not turning.diagonal().any():
        ours, theirs = SPIN_NAMES[int(vehicle.spin[0])], SPIN_NAMES[int(frame.spin[0])]
        like = f", as of {other}" if other else ""
        return [f"all spins are reversed: motor 1 is {ours} in the airframe file{like}; {called} has it {theirs}"]
    another = other and 2 * wrong.sum() >= frame.motors  # else the frame is the same one, with a few motors changed
    out = [f"the airframe file's motors are those of {other}, not of {called}"] if another else []
    for motor in np.flatnonzero(wrong):
        out.append(_of_motor(vehicle, frame, int(motor), called, placed & turning, far=bool(~placed[motor, motor])))
    return out


def frame_of(vehicle: Vehicle) -> Frame | None:
    """The first frame of the catalogue that the airframe does not contradict; None: it is no one's."""
    return next((frame for frame in frames().values() if agrees(vehicle, frame)), None)


def agrees(vehicle: Vehicle, frame: Frame) -> bool:
    """Whether the airframe contradicts ``frame`` in nothing."""
    if frame.without or frame.motors != vehicle.motors or (frame.spin != vehicle.spin).any():
        return False
    return bool(_placed(vehicle, frame).diagonal().all())


def _numbers(frame: Frame) -> str:
    """FRAME_CLASS and FRAME_TYPE, where it has them."""
    if not frame.ardupilot:
        return ""
    frame_class, frame_type = frame.ardupilot[0]
    return f" (FRAME_CLASS {frame_class}, FRAME_TYPE {max(frame_type, 0)})"


def _of_motor(vehicle: Vehicle, frame: Frame, motor: int, called: str, same: NDArray[np.bool_], *, far: bool) -> str:
    """What is wrong with one motor (from 0). ``same`` (m, m): the file's motor is as the frame's."""
    ours, theirs = _described(vehicle.hub_position_m, vehicle.spin, motor), _described(frame.place, frame.spin, motor)
    if far and ours == theirs:
        arms = [_arms(place)[motor] for place in (vehicle.hub_position_m, frame.place)]
        ours, theirs = (f"{ours}, at {arm:.2f} of the longest arm" for arm in arms)
    taken = np.flatnonzero(same[motor])
    whose = f", and its motor {taken[0] + 1} there" if len(taken) else ""
    return f"motor {motor + 1}: the airframe file has it at {ours}; {called} at {theirs}{whose}"


def _described(place: NDArray[np.float64], spin: NDArray[np.float64], motor: int) -> str:
    forward, right = place[motor]
    return f"{math.degrees(math.atan2(right, forward)) + 0.0:.3g} deg, {SPIN_NAMES[int(spin[motor])]}"


def _arms(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) over the longest."""
    arm = np.hypot(*place.T)
    return np.asarray(arm / (arm.max() or 1.0))


def _placed(vehicle: Vehicle, frame: Frame) -> NDArray[np.bool_]:
    """(m, m): motor i of the airframe is at the place of motor k of the frame."""
    own, place = vehicle.hub_position_m, frame.place
    if not frame.ardupilot:
        return _near(own / (np.hypot(*own.T).mean() or 1.0), place / (np.hypot(*place.T).mean() or 1.0))
    rows = [_outermost(axis) for axis in np.abs(place).T]
    return _near(own / _sizes(own, rows), place / _sizes(place, rows))


def _outermost(distance: NDArray[np.float64]) -> int:
    """How many of the largest of ``distance`` (m,) are taken for the unit: a third of those that the frame has farthest
    out. Of the largest alone, one motor measured too far out would move all others."""
    return -(-int((distance > _OUTERMOST * distance.max()).sum()) // 3)


def _sizes(place: NDArray[np.float64], rows: list[int]) -> NDArray[np.float64]:
    """(2,) unit of each axis of ``place`` (m, 2): the mean of so many largest distances; 1 where all are 0."""
    size = np.array([np.sort(axis)[-count:].mean() for axis, count in zip(np.abs(place).T, rows, strict=True)])
    return np.where(size > 0.0, size, 1.0)


def _near(own: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(m, m) whether one of ``own`` (m, 2) is where one of ``place`` (m, 2) is, by bearing and arm."""
    wanted = _bearings(place)
    off = _apart(_bearings(own)[:, None], wanted)
    arm, length = np.hypot(*own.T)[:, None], np.hypot(*place.T)
    ratio = np.minimum(arm, length) / np.maximum(np.maximum(arm, length), 1e-12)
    return np.asarray((off < _allowed_deg(wanted)) & (ratio > _ARM_RATIO_MIN))


def _allowed_deg(bearing: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) by which a motor may be beside its place: never as much as half the way to the next."""
    apart = _apart(bearing[:, None], bearing)
    apart[apart < _SAME_BEARING_DEG] = 360.0
    return np.asarray(np.minimum(_ANGLE_MAX_DEG, 0.5 * apart.min(axis=1)))


def _bearings(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) deg clockwise from the nose."""
    return np.asarray(np.degrees(np.arctan2(place[:, 1], place[:, 0])))


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between two bearings, 0 to 180 deg."""
    return np.asarray(np.abs((one - other + 180.0) % 360.0 - 180.0))
