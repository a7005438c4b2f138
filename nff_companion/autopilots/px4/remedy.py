"""What to tell PX4 about failed motors, and whether its allocator would fly with it.

Telling it the truth is not always right: with both motors of a 90-degree same-spin pair of an octorotor told dead, the
minimum-norm hover solution has a negative motor and the desaturation takes the collective to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.px4 import allocator
from nff_companion.autopilots.px4.allocator import Geometry
from nff_companion.core.vehicle import Vehicle
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.comparison import contradictions_of_frame

_THRUST_RESERVE = 1.0  # largest thrust over weight that the told allocator must reach
_BIAS_MAX = 0.03  # of an axis' full torque left over at hover
_STEP = 0.05  # torque demand to probe with
_RESPONSE_MIN, _RESPONSE_MAX = 0.35, 2.5  # of the healthy vehicle's answer to it
_CROSS_MAX = 0.6  # what it does to the other of roll and pitch, against the wanted
_YAW_RESPONSE_MIN = 0.2
_SAME_PLACE = 0.1  # of the farthest rotor's distance


@dataclass(frozen=True)
class Prediction:
    """What the vehicle would do. Torques in shares of each axis' full torque; ``response`` over the healthy one's."""

    collective: float | None  # thrust setpoint at hover, None: it cannot hover
    thrust_ratio: float  # largest thrust over weight
    bias: NDArray[np.float64]  # (3,) torque left over at hover, with what the healthy vehicle's integrators hold
    response: NDArray[np.float64]  # (3,) least over both directions
    cross: float

    def fault(self, *, yaw: bool) -> str:
        """Why it must not be triggered; empty when it may."""
        if self.collective is None or self.thrust_ratio < _THRUST_RESERVE:
            return f"its allocator would give at most {self.thrust_ratio:.2f} of the weight"
        if np.abs(self.bias[:2]).max() > _BIAS_MAX or (yaw and abs(self.bias[2]) > _BIAS_MAX):
            return f"torque of {np.abs(self.bias).max():.2f} would be left over at hover"
        low, high = float(self.response[:2].min()), float(self.response[:2].max())
        if low < _RESPONSE_MIN or high > _RESPONSE_MAX or self.cross > _CROSS_MAX:
            return f"roll or pitch would answer with {low:.2f} of what is wanted"
        if yaw and self.response[2] < _YAW_RESPONSE_MIN:
            return f"yaw would answer with {self.response[2]:.2f} of what is wanted"
        return ""


@dataclass(frozen=True)
class Remedy:
    """``effectiveness`` (m,) to scale each CT with, and whether every KM is set to 0, or those of ``still`` (indices).

    ``first``: index of the motor whose CT is to be sent ahead of everything else, None: the moments go first. PX4 takes
    a burst of parameters in parts, up to a second apart.
    """

    effectiveness: NDArray[np.float64]
    yaw_released: bool
    first: int | None = None
    still: tuple[int, ...] = ()


@dataclass(frozen=True)
class NoRemedy:
    """Nothing may be told, and why. ``no_lift``: the motors left cannot carry the weight, whatever is told."""

    reason: str
    no_lift: bool = False


class Advisor:
    """For one vehicle whose true motors are our model's, and PX4's ``geometry`` as it was configured."""

    def __init__(self, vehicle: Vehicle, geometry: Geometry) -> None:
        self._vehicle, self._geometry = vehicle, geometry
        # Demand (3,) that the autopilot's integrators hold in a healthy hover: rotors unlike, mass beside the middle.
        self._trim = np.zeros(3)
        ones = np.ones(vehicle.motors)
        mix = allocator.mix_matrix(geometry)
        found = self._hover(geometry, mix, ones)
        self._healthy = None
        if found[0] is not None:
            self._trim = self._trimmed(geometry, mix, ones, found[0])
            self._healthy = self._responses(geometry, mix, ones, found[0])

    def _wrench(
        self, geometry: Geometry, mix: NDArray[np.float64], true: NDArray[np.float64], demand: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(4,) thrust, roll, pitch, yaw in normalised units of what the motors really give."""
        return self._vehicle.effectiveness @ (true * allocator.allocate(mix, demand, geometry))

    def _trimmed(
        self, geometry: Geometry, mix: NDArray[np.float64], true: NDArray[np.float64], collective: float
    ) -> NDArray[np.float64]:
        """(3,) torque demand without which a torque would be left over."""
        left = self._wrench(geometry, mix, true, self._demand(collective))[1:]
        gain = self._responses(geometry, mix, true, collective).mean(axis=1).T / _STEP
        return np.asarray(-np.linalg.pinv(gain, rcond=1e-6) @ left)

    def _demand(self, collective: float) -> NDArray[np.float64]:
        """(6,) at hover."""
        return np.array([*self._trim, 0.0, 0.0, -collective])

    def _hover(
        self, geometry: Geometry, mix: NDArray[np.float64], true: NDArray[np.float64]
    ) -> tuple[float | None, float]:
        """Least collective that carries the weight, and the largest thrust over weight."""
        collectives = np.linspace(0.0, 1.0, 51)
        thrust = np.array([self._wrench(geometry, mix, true, self._demand(c))[0] for c in collectives])
        enough = np.flatnonzero(thrust >= self._vehicle.hover)
        largest = float(thrust.max()) / self._vehicle.hover
        return (float(collectives[enough[0]]) if enough.size else None), largest

    def _responses(
        self, geometry: Geometry, mix: NDArray[np.float64], true: NDArray[np.float64], collective: float
    ) -> NDArray[np.float64]:
        """(3, 2, 3) change of torque to a demand on each axis in both directions."""
        base = self._demand(collective)
        at_rest = self._wrench(geometry, mix, true, base)
        out = np.zeros((3, 2, 3))
        for axis in range(3):
            for k, sign in enumerate((1.0, -1.0)):
                demand = base.copy()
                demand[axis] += sign * _STEP
                out[axis, k] = sign * (self._wrench(geometry, mix, true, demand) - at_rest)[1:]
        return out

    def predict(self, told: NDArray[np.float64], true: NDArray[np.float64], *, yaw_released: bool) -> Prediction:
        """With CT scaled by ``told`` (m,) when the motors really are ``true`` (m,)."""
        geometry = self._geometry.scaled(told, yaw_released=yaw_released, still=self._still(told))
        mix = allocator.mix_matrix(geometry)
        collective, ratio = self._hover(geometry, mix, true)
        if collective is None or self._healthy is None:
            return Prediction(collective, ratio, np.zeros(3), np.zeros(3), np.inf)
        bias = self._wrench(geometry, mix, true, self._demand(collective))[1:]
        now = self._responses(geometry, mix, true, collective)
        healthy = np.array([self._healthy[i, :, i].mean() for i in range(3)])
        response = np.array([now[i, :, i].min() / healthy[i] if healthy[i] else 1.0 for i in range(3)])
        cross = max(
            float(np.abs(now[a, :, b]).max()) / max(float(now[a, :, a].min()), 1e-9) for a, b in ((0, 1), (1, 0))
        )
        return Prediction(collective, ratio, bias, response, cross)

    def _still(self, effectiveness: NDArray[np.float64]) -> tuple[int, ...]:
        """Motors (indices) that must get the same command: two above each other of which one is lost, and it is not
        known which. Of the difference of the two PX4 would make yaw."""
        place, spin = self._geometry.position_m[:, :2], np.sign(self._geometry.moment_ratio)
        near = np.linalg.norm(place[:, None] - place, axis=2) < _SAME_PLACE * np.linalg.norm(place, axis=1).max()
        partly = (effectiveness > 0.0) & (effectiveness < 1.0)
        alike = near & (spin[:, None] != spin) & (effectiveness[:, None] == effectiveness) & partly
        return tuple(np.flatnonzero(alike.any(axis=1)).tolist())

    def _first(self, effectiveness: NDArray[np.float64]) -> int | None:
        """Which part of the burst the vehicle flies best with while the rest is not yet taken."""
        best: tuple[float, int | None] = (self._score(np.ones_like(effectiveness), effectiveness), None)
        for motor in np.flatnonzero(effectiveness < 1.0):
            told = np.ones_like(effectiveness)
            told[motor] = effectiveness[motor]
            best = max(best, (self._score(told, effectiveness), int(motor)), key=lambda pair: pair[0])
        return best[1]

    def _score(self, told: NDArray[np.float64], true: NDArray[np.float64]) -> float:
        prediction = self.predict(told, true, yaw_released=False)
        return min(prediction.thrust_ratio, 1.05) - 2.0 * float(np.abs(prediction.bias).max())

    def lifts(self, effectiveness: NDArray[np.float64]) -> bool:
        """Whether motors of ``effectiveness`` (m,) carry the weight, all at full output."""
        return float(self._vehicle.effectiveness[0] @ effectiveness) >= self._vehicle.hover

    def remedy(self, effectiveness: NDArray[np.float64]) -> Remedy | NoRemedy:
        """What to tell for true motor ``effectiveness`` (m,): the truth, or the truth without yaw, or nothing."""
        reason = ""
        for released in (False, True):
            prediction = self.predict(effectiveness, effectiveness, yaw_released=released)
            fault = prediction.fault(yaw=not released)
            if not fault:
                first = self._first(effectiveness) if released else None
                return Remedy(effectiveness.copy(), released, first, self._still(effectiveness))
            reason = reason or fault
        return NoRemedy(reason, no_lift=not self.lifts(effectiveness))


def geometry_of(values: dict[str, float], motors: int) -> Geometry:
    """Geometry from CA_* parameters. Raises KeyError for one that is missing."""

    def column(*suffixes: str) -> NDArray[np.float64]:
        return np.array([[values[f"CA_ROTOR{i}_{s}"] for s in suffixes] for i in range(motors)])

    return Geometry(
        position_m=column("PX", "PY", "PZ"),
        axis=column("AX", "AY", "AZ"),
        thrust_coefficient=column("CT")[:, 0],
        moment_ratio=column("KM")[:, 0],
        airmode=int(values.get("MC_AIRMODE", 0)),
        desaturate=int(values.get("CA_METHOD", 2)) != 0,
    )


def disagreement(geometry: Geometry, vehicle: Vehicle) -> str:
    """How PX4's rotors differ from the airframe file's; empty when they agree in place, order and spin."""
    # KM is positive for a rotor that turns counter-clockwise. Place and scale are the user's.
    frame = Frame("CA_ROTORn of PX4", geometry.position_m[:, :2], np.sign(geometry.moment_ratio))
    return "; ".join(contradictions_of_frame(vehicle, frame))
