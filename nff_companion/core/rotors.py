"""The rotors of an airframe file, and the effectiveness matrix B0 that they make. SI units, FRD body frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.tuning.span import about, span

ARM_M = (0.02, 10.0)
UPWARD_MIN = 0.5  # of a rotor's thrust
_AXIS_LENGTH = (0.5, 2.0)  # what is meant as a direction

Coordinate = Annotated[float, span(-10.0, 10.0, "m", "of a place in the body frame")]
Lag = Annotated[float, span(0.0, 1.0, "s", "time constant of thrust after command")]
Component = Annotated[float, span(-2.0, 2.0, "", "of a direction; its length is of no matter")]
Gain = Annotated[float, span(-1e4, 1e4, "m/s^2 or rad/s^2", "of the vehicle by one rotor at full output")]


class RotorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[rotor]]``: either angle (clockwise from the nose) and arm, or x forward and y right; all else has a default.

    ``axis`` is where the thrust pushes. ``acceleration`` is what one rotor at full output does to the vehicle (up,
    roll, pitch, yaw), instead of all that its place, axis and thrust would do.
    """

    spin: Literal["cw", "ccw"]
    angle_deg: Annotated[float, span(-360.0, 360.0, "deg", "clockwise from the nose")] | None = None
    arm_m: Annotated[float, span(*ARM_M, "m", "from the middle of the frame to the hub")] | None = None
    x_m: Coordinate | None = None
    y_m: Coordinate | None = None
    z_m: Coordinate = 0.0  # down
    axis: Annotated[tuple[Component, Component, Component], about("", "FRD, straight up when not given")] = (
        0.0,
        0.0,
        -1.0,
    )
    thrust: Annotated[float, span(0.3, 3.0, "", "of motor.max_thrust_n")] = 1.0
    time_constant_up_s: Lag | None = None  # as [motor] has it
    time_constant_down_s: Lag | None = None
    acceleration: tuple[Gain, Gain, Gain, Gain] | None = None

    def position_m(self) -> tuple[float, float]:
        """(x, y) from the middle of the frame. Raises ValueError when neither form is complete."""
        if self.angle_deg is not None and self.arm_m is not None:
            angle = math.radians(self.angle_deg)
            return self.arm_m * math.cos(angle), self.arm_m * math.sin(angle)
        if self.x_m is not None and self.y_m is not None:
            return self.x_m, self.y_m
        raise ValueError("give angle_deg and arm_m, or x_m and y_m")

    @property
    def upward(self) -> float:
        """Share of its thrust that carries; 1 straight up. NaN for an axis without a direction."""
        length = math.hypot(*self.axis)
        return -self.axis[2] / length if length > 0.0 else math.nan

    def fault(self) -> str | None:
        """Why no rotor pushes like this; None when one may."""
        if self.acceleration is not None:
            if self.axis != (0.0, 0.0, -1.0) or self.thrust != 1.0:
                return "acceleration: says all that axis and thrust would; leave those two out, or this"
            if self.acceleration[0] <= 0.0:
                return f"acceleration = {list(self.acceleration)}: its first number, m/s^2 upwards, must be above 0"
            return None
        length, (low, high) = math.hypot(*self.axis), _AXIS_LENGTH
        if not low <= length <= high:
            return f"axis = {list(self.axis)}: give a direction of length 1; {low:g} to {high:g} is allowed"
        if not self.upward >= UPWARD_MIN:
            return (
                f"axis = {list(self.axis)}: {self.upward:.2g} of the thrust pushes up, which is -z; at least"
                f" {UPWARD_MIN:g} must"
            )
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Rotors:
    """Arrays of m rotors, read-only. ``place_m`` is from the centre of mass, ``hub_m`` from the middle of the frame."""

    place_m: NDArray[np.float64]  # (m, 3)
    hub_m: NDArray[np.float64]  # (m, 3)
    axis: NDArray[np.float64]  # (m, 3) unit vectors
    spin: NDArray[np.float64]  # (m,) sign of the torque on the airframe about -axis: +1 turns ccw seen from above
    max_thrust_n: NDArray[np.float64]  # (m,) along the axis
    torque_per_thrust_m: float
    time_constant_up_s: NDArray[np.float64]  # (m,)
    time_constant_down_s: NDArray[np.float64]  # (m,)
    acceleration: NDArray[np.float64] | None = None  # (m, 4) at full output, when it is given instead of the above

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def effectiveness_si(self, mass_kg: float, inertia_kg_m2: NDArray[np.float64]) -> NDArray[np.float64]:
        """B0 (n, m): N upwards and N m about the body axes for thrust fraction 1 of each motor.

        A rotor at r that pushes with F along the unit vector a makes the force f = F a and the torque r x f, and its
        drag turns the airframe about -a by c F (about +a when it turns clockwise): straight up, a = (0, 0, -1), that is
        roll torque -y F, pitch torque x F and yaw torque +-c F. What tilted rotors push sideways is not in B0: it shows
        in the lateral specific force, as the wind on the rotors does, and is taken for that (residual.py).
        """
        if self.acceleration is not None:
            return self.acceleration.T * np.concatenate([[mass_kg], inertia_kg_m2])[:, None]
        (x, y, z), (along, across, _) = self.place_m.T, self.axis.T
        lift = -self.axis[:, 2]
        drag = self.torque_per_thrust_m * self.spin
        rows = np.stack([lift, -y * lift, x * lift, drag * lift])
        if self.tilted:
            rows[1] -= z * across + drag * along
            rows[2] += z * along - drag * across
            rows[3] += x * across - y * along
        return rows * self.max_thrust_n

    @property
    def tilted(self) -> bool:
        """Whether any pushes elsewhere than straight up."""
        return bool(self.axis[:, :2].any())

    def turned(self, quarter_turns: int) -> Rotors:
        """The same with the nose turned by quarter turns, numbered on by as many places."""
        c, s = round(math.cos(quarter_turns * math.pi / 2)), round(math.sin(quarter_turns * math.pi / 2))
        turn = np.array([[c, s], [-s, c]])

        def on(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.roll(values, quarter_turns, axis=0)

        def turned(vectors: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
            out = vectors.copy()
            out[:, first : first + 2] = vectors[:, first : first + 2] @ turn
            return on(out)

        return replace(
            self,
            place_m=turned(self.place_m),
            hub_m=turned(self.hub_m),
            axis=turned(self.axis),
            spin=on(self.spin),
            max_thrust_n=on(self.max_thrust_n),
            time_constant_up_s=on(self.time_constant_up_s),
            time_constant_down_s=on(self.time_constant_down_s),
            acceleration=None if self.acceleration is None else turned(self.acceleration, 1),
        )


def rotors_of(
    tables: Sequence[RotorTable],
    centre_of_mass_m: tuple[float, float, float],
    *,
    max_thrust_n: float,
    torque_per_thrust_m: float,
    time_constants_s: tuple[float, float],
) -> Rotors:
    """Arrays of ``tables`` without a fault; the numbers are those of ``[motor]``, the lags up and down.

    Raises ValueError when a place is not complete.
    """
    up_s, down_s = time_constants_s
    axis = np.array([table.axis for table in tables], float)
    accelerations = [table.acceleration for table in tables if table.acceleration is not None]
    hub_m = np.array([(*table.position_m(), table.z_m) for table in tables])
    return Rotors(
        place_m=hub_m - np.array(centre_of_mass_m),
        hub_m=hub_m,
        axis=axis / np.sqrt((axis * axis).sum(axis=1, keepdims=True)),
        spin=np.array([1.0 if table.spin == "ccw" else -1.0 for table in tables]),
        max_thrust_n=max_thrust_n * np.array([table.thrust for table in tables], float),
        torque_per_thrust_m=torque_per_thrust_m,
        time_constant_up_s=np.array([_or(table.time_constant_up_s, up_s) for table in tables], float),
        time_constant_down_s=np.array([_or(table.time_constant_down_s, down_s) for table in tables], float),
        acceleration=np.array(accelerations, float) if accelerations else None,
    )


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
