"""Parameters of a vehicle, what they foretell of a record, and what was believed of them before.

Accelerations per thrust are those at the mean outputs of the record: there they show, while thrust at full output
hangs on the thrust curve as well. A mixer moves all motors of a healthy vehicle in four directions only, so that what
one motor does differently from its fellows is known by the prior alone, except for what it does to the trim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.calibration.chain import Motors, fraction
from nff_companion.core.vehicle import Vehicle

AXES = 4
THRUST, ROLL, PITCH, YAW = range(AXES)
DELAY, LAG, ASYMMETRY, EXPO, IDLE = range(5)
# Parameters of how outputs become thrust; then come gains, motors, centre of thrust, steady torque, lead of yaw.
SHAPE = 5
_MOTORS = SHAPE + AXES
LEAD = -1
_CURVE_STEP = 1e-3  # of output, curve and idle
_LEAD_S = 0.03  # of yaw, before any record was seen
_STEPS = np.array([5e-4, 0.01, 0.02, 0.01, 0.002])  # of the differences that derivatives are taken from


@dataclass(frozen=True, slots=True)
class Prior:
    """Deviations of what an owner knows, who has a ruler, a data sheet, and propellers of one kind; 0: taken as known.

    The mean of ``gain`` is what the record itself suggests.
    """

    delay_s: float = 0.006
    lag: float = 0.4  # of its logarithm
    asymmetry: float = 0.15  # of the logarithm of lag down over lag up
    expo: float = 0.2
    idle: float = 0.03
    gain: float = 1.5  # of its logarithm, roll and pitch
    yaw: float = 1.5  # the same of yaw
    motor: float = 0.05
    centre: float = 0.03  # of the farthest arm
    steady: float = 0.01  # of the same: torque of the air, as if the centre were elsewhere
    lead_s: float = 0.03  # a rotor that gathers speed turns the vehicle before its drag does

    def deviations(self, motors: int) -> NDArray[np.float64]:
        """(parameters,)."""
        shape = [self.delay_s, self.lag, self.asymmetry, self.expo, self.idle]
        gains = [0.0, self.gain, self.gain, self.yaw]  # thrust: what carries the vehicle is known
        lead_s = self.lead_s if self.yaw > 0.0 else 0.0
        return np.array(shape + gains + [self.motor] * motors + [self.centre] * 2 + [self.steady] * 2 + [lead_s])


BELIEVED = Prior()


@dataclass(frozen=True, slots=True)
class Layout:
    """What is taken of an airframe: ``rows`` (AXES, m) of the motors' torques, roll and pitch for a mean thrust of 1 at
    the farthest place, yaw for a mean drag of 1; ``thrust`` (m,) over the mean; ``full``: output of full thrust."""

    rows: NDArray[np.float64]
    thrust: NDArray[np.float64]
    full: float
    per_lift: tuple[float, float, float, float]  # logarithms of the file's gains over that of thrust

    @staticmethod
    def of(vehicle: Vehicle) -> Layout:
        """That of an airframe."""
        matrix = vehicle.effectiveness_si
        mean = float(matrix[THRUST].mean())
        drag = float(np.abs(matrix[YAW]).mean())
        arm = arm_m(vehicle)
        scale = np.array([mean * vehicle.motors, mean * arm, mean * arm, drag])
        gains = np.log(scale / np.concatenate([[vehicle.mass_kg], vehicle.inertia_kg_m2]))
        per_lift = (gains - gains[THRUST]).tolist()
        full = vehicle.command.spin_max
        return Layout(matrix / scale[:, None], matrix[THRUST] / mean, full, tuple(per_lift))

    @property
    def motors(self) -> int:
        """m."""
        return len(self.thrust)

    @property
    def parameters(self) -> int:
        """Length of a vector of them."""
        return _MOTORS + self.motors + 5


def arm_m(vehicle: Vehicle) -> float:
    """Of the farthest rotor."""
    return float(np.hypot(*vehicle.position_m.T).max())


def start(layout: Layout, lag_s: float, expo: float, idle: float, delay_s: float = 0.0) -> NDArray[np.float64]:
    """Parameters (parameters,) before any record was seen."""
    x = np.zeros(layout.parameters)
    x[[DELAY, LAG, EXPO, IDLE, LEAD]] = delay_s, np.log(lag_s), expo, idle, _LEAD_S
    return x


def shape_of(x: NDArray[np.float64], full: float) -> Motors:
    """Of the vector of parameters ``x``."""
    lag, half = float(np.exp(x[LAG])), 0.5 * float(x[ASYMMETRY])
    return Motors(
        delay_s=float(x[DELAY]),
        lag_up_s=lag * float(np.exp(-half)),
        lag_down_s=lag * float(np.exp(half)),
        expo=float(x[EXPO]),
        idle=float(x[IDLE]),
        full=full,
    )


def variants(x: NDArray[np.float64], full: float, free: NDArray[np.int64]) -> list[Motors]:
    """The shape at ``x``, and one step away in each of its parameters that is ``free``."""
    out = [shape_of(x, full)]
    for k in free:
        moved = x.copy()
        moved[k] += _STEPS[k]
        out.append(shape_of(moved, full))
    return out


def steepness(x: NDArray[np.float64], layout: Layout, output: float) -> tuple[float, NDArray[np.float64]]:
    """Relative change of thrust with ``output`` there, 1/output, and the derivative (parameters,) of its logarithm.

    What a command does is a gain times this, and is known better than either: of two vehicles of one record, the one
    with the steeper curve has the smaller gains.
    """

    def at(changed: NDArray[np.float64]) -> float:
        places = output + _CURVE_STEP * np.array([-1.0, 0.0, 1.0])
        low, middle, high = fraction(places, shape_of(changed, layout.full)).tolist()
        return float((high - low) / (2.0 * _CURVE_STEP * middle))

    slope = np.zeros(len(x))
    for k in (EXPO, IDLE):
        step = np.zeros(len(x))
        step[k] = _CURVE_STEP
        slope[k] = (np.log(at(x + step)) - np.log(at(x - step))) / (2.0 * _CURVE_STEP)
    return at(x), slope


def unit_rows(layout: Layout, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(AXES, m) of a motor's thrust on each axis, for gains of 1 and motors all alike."""
    cx, cy = x[centre_of(layout)]
    rows = layout.rows.copy()
    rows[ROLL] += cy * layout.thrust
    rows[PITCH] -= cx * layout.thrust
    return rows


def gains_of(layout: Layout) -> slice:
    """Where the logarithms of the gains are: m/s^2 of all motors, rad/s^2 of one at the farthest place."""
    return slice(SHAPE, _MOTORS)


def motors_of(layout: Layout) -> slice:
    """Where the motors' thrusts over the mean, less 1, are."""
    return slice(_MOTORS, _MOTORS + layout.motors)


def centre_of(layout: Layout) -> slice:
    """Where the centre of thrust's is that of mass, forward and right over the farthest arm."""
    return slice(_MOTORS + layout.motors, _MOTORS + layout.motors + 2)


def steady_of(layout: Layout) -> slice:
    """Where the steady torque of the air is, forward and right as the centre."""
    return slice(_MOTORS + layout.motors + 2, _MOTORS + layout.motors + 4)


def accelerations(x: NDArray[np.float64], layout: Layout) -> NDArray[np.float64]:
    """(AXES, m) of each motor at the mean outputs."""
    factors = 1.0 + x[motors_of(layout)]
    out: NDArray[np.float64] = np.exp(x[gains_of(layout)])[:, None] * unit_rows(layout, x) * factors
    return out


def foretold(
    x: NDArray[np.float64], layout: Layout, relative: NDArray[np.float64], free: NDArray[np.int64], dt_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Accelerations (AXES, N) and their derivatives (AXES, N, parameters), of thrusts over those of the mean outputs
    ``relative`` (1 + free, N, m), as ``variants`` gives them, ``dt_s`` apart."""
    matrix, m = accelerations(x, layout), layout.motors
    thrust, gain = relative[0], np.exp(x[gains_of(layout)])
    value = matrix @ thrust.T
    derivative = np.zeros((AXES, len(thrust), layout.parameters))
    for row, k in enumerate(free, start=1):
        derivative[:, :, k] = matrix @ (relative[row] - thrust).T / _STEPS[k]
    rows, factors = unit_rows(layout, x), 1.0 + x[motors_of(layout)]
    centre, steady = centre_of(layout), steady_of(layout)
    for axis in range(AXES):
        derivative[axis, :, SHAPE + axis] = value[axis]
        derivative[axis, :, motors_of(layout)] = gain[axis] * rows[axis] * thrust
    total, (bx, by) = thrust @ (factors * layout.thrust), x[steady]
    derivative[PITCH, :, centre.start] = -gain[PITCH] * total
    derivative[ROLL, :, centre.start + 1] = gain[ROLL] * total
    for axis, place, torque in ((PITCH, steady.start, -bx), (ROLL, steady.start + 1, by)):
        value[axis] += gain[axis] * m * torque
        derivative[axis, :, SHAPE + axis] = value[axis]
        derivative[axis, :, place] = gain[axis] * m * (-1.0 if axis == PITCH else 1.0)
    _led(x[LEAD], value, derivative, dt_s)
    return value, derivative


def _led(lead_s: float, value: NDArray[np.float64], derivative: NDArray[np.float64], dt_s: float) -> None:
    """In place: what turns a rotor faster turns the vehicle the other way, in proportion to the change of thrust. Of a
    propeller of 15 inches that is ahead of its drag by as much as its motor lags."""
    change = np.gradient(value[YAW], dt_s)
    value[YAW] += lead_s * change
    derivative[YAW] += lead_s * np.gradient(derivative[YAW], dt_s, axis=0)
    derivative[YAW, :, LEAD] = change
