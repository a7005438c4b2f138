"""An airframe file with the numbers that a fit has found; what was measured says so, with its deviation.

Accelerations alone show in flight: mass and the size of the frame stay as they are in the file, and thrust, inertia and
drag are made to give the accelerations that were found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tomlkit
from numpy.typing import NDArray

from nff_companion.calibration import chain, model
from nff_companion.calibration.fit import Fit
from nff_companion.core.motor_order import Order
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError

_DELAY_MAX_S = 0.1


@dataclass(frozen=True, slots=True)
class Number:
    """One of the file: its ``key``, ``value`` and ``deviation`` (of vectors the largest), in ``unit``."""

    key: str
    value: float | list[float]
    deviation: float
    unit: str


@dataclass(frozen=True, slots=True)
class _Physical:
    """What the parameters are of a vehicle of this mass and size."""

    max_thrust_n: float
    inertia_kg_m2: NDArray[np.float64]
    torque_per_thrust_m: float
    centre_m: NDArray[np.float64]  # (2,)
    thrust: NDArray[np.float64]  # (m,) factors of the file


def numbers(vehicle: Vehicle, fit: Fit) -> list[Number]:
    """What of the file of ``vehicle`` was found, and how well. Raises ConfigError."""
    if vehicle.rotors.acceleration is not None:
        raise ConfigError(
            f"airframe {vehicle.name} gives accelerations of its rotors: begin with one that has places and thrusts"
        )
    now = _physical(vehicle, fit, fit.x)
    shape = model.shape_of(fit.x, fit.layout.full)
    lag = fit.deviation[model.LAG]

    def off(pick: Callable[[_Physical], float | NDArray[np.float64]]) -> float:
        return float(np.max(_deviation(vehicle, fit, lambda p: np.atleast_1d(pick(p)))))

    return [
        Number("motor.max_thrust_n", now.max_thrust_n, off(lambda p: p.max_thrust_n), "N"),
        Number("airframe.inertia_kg_m2", now.inertia_kg_m2.tolist(), off(lambda p: p.inertia_kg_m2), "kg m^2"),
        Number("motor.torque_per_thrust_m", now.torque_per_thrust_m, off(lambda p: p.torque_per_thrust_m), "m"),
        Number("motor.time_constant_up_s", shape.lag_up_s, shape.lag_up_s * lag, "s"),
        Number("motor.time_constant_down_s", shape.lag_down_s, shape.lag_down_s * lag, "s"),
        Number("command.thrust_expo", min(max(shape.expo, 0.0), 1.0), fit.deviation[model.EXPO], ""),
        Number("command.spin_min", min(max(shape.idle, 0.0), 0.5), fit.deviation[model.IDLE], ""),
        Number(
            "telemetry.output_delay_s",
            min(max(shape.delay_s, 0.0), _DELAY_MAX_S),
            fit.deviation[model.DELAY],
            "s",
        ),
        Number("airframe.centre_of_mass_m", [*now.centre_m.tolist(), 0.0], off(lambda p: p.centre_m), "m"),
        Number("rotor.thrust", now.thrust.tolist(), off(lambda p: p.thrust), ""),
    ]


def _physical(vehicle: Vehicle, fit: Fit, x: NDArray[np.float64]) -> _Physical:
    layout, m = fit.layout, vehicle.motors
    lift, roll, pitch, yaw = np.exp(x[model.gains_of(layout)]).tolist()
    hover = float(chain.fraction(np.array(fit.mean_output), model.shape_of(x, layout.full)))
    factors = layout.thrust * (1.0 + x[model.motors_of(layout)])
    mean_n = vehicle.mass_kg * lift / m  # of one motor, at the mean outputs
    arm = model.arm_m(vehicle)
    jx, jy = mean_n * arm / roll, mean_n * arm / pitch
    given = vehicle.inertia_kg_m2
    jz = float(given[2] / (given[0] + given[1]) * (jx + jy))
    drag = yaw * jz / mean_n
    if vehicle.rotors.tilted:  # most of yaw is not drag
        drag = vehicle.motor.torque_per_thrust_m
        jz = mean_n * float(np.abs(vehicle.effectiveness_si[3]).mean() / vehicle.effectiveness_si[0].mean()) / yaw
    return _Physical(
        max_thrust_n=mean_n / hover,
        inertia_kg_m2=np.array([jx, jy, jz]),
        torque_per_thrust_m=drag,
        centre_m=(vehicle.hub_position_m - vehicle.position_m).mean(axis=0) + arm * x[model.centre_of(layout)],
        thrust=factors / factors.mean(),
    )


def _deviation(vehicle: Vehicle, fit: Fit, pick: Callable[[_Physical], NDArray[np.float64]]) -> NDArray[np.float64]:
    """Of numbers that follow from the parameters, to first order."""
    here = pick(_physical(vehicle, fit, fit.x))
    free = np.flatnonzero(fit.prior > 0.0)
    slopes = np.empty((len(here), len(free)))
    for column, k in enumerate(free):
        moved = fit.x.copy()
        step = 0.01 * max(fit.deviation[k], 1e-6)
        moved[k] += step
        slopes[:, column] = (pick(_physical(vehicle, fit, moved)) - here) / step
    inner = fit.covariance[np.ix_(free, free)]
    return np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", slopes, inner, slopes)))


def written(text: str, found: list[Number], name: str, source: str) -> str:
    """The airframe file ``text`` with these numbers, called ``name``; the rest of it stays as it was."""
    document = tomlkit.parse(text)
    table = document["airframe"]
    table["name"], table["source"], table["confirmed"] = name, source, source
    table.pop("network", None)  # trained with other numbers
    for number in found:
        place, key = number.key.split(".")
        note = f"calibrated, +-{number.deviation:.2g} {number.unit}".rstrip()
        if place == "rotor":
            assert isinstance(number.value, list)
            for rotor, value in zip(document["rotor"], number.value, strict=True):
                rotor[key] = _item(value, note)
            continue
        document[place][key] = _item(number.value, note)
    return tomlkit.dumps(document)


def reordered(text: str, order: Order) -> str:
    """The airframe file ``text`` with two motors swapped, or with spins reversed; nobody has confirmed it."""
    document = tomlkit.parse(unconfirmed(text))
    rotors = document["rotor"]
    if order.swapped:
        one, other = (rotors[motor - 1] for motor in order.swapped)
        first, second = one.unwrap(), other.unwrap()
        for rotor, new in ((one, second), (other, first)):
            for key in list(rotor):
                rotor.pop(key)
            rotor.update(new)
    for motor in order.reversed:
        rotors[motor - 1]["spin"] = {"cw": "ccw", "ccw": "cw"}[str(rotors[motor - 1]["spin"])]
    return tomlkit.dumps(document)


def unconfirmed(text: str) -> str:
    """The airframe file ``text`` without anybody's word that it is the vehicle's."""
    document = tomlkit.parse(text)
    document["airframe"].pop("confirmed", None)
    return tomlkit.dumps(document)


def _item(value: float | list[float], note: str) -> tomlkit.items.Item:
    rounded = [float(f"{v:.5g}") for v in value] if isinstance(value, list) else float(f"{value:.5g}")
    return tomlkit.item(rounded).comment(note)
