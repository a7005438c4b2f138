"""How soon a motor's failure can be told at all: the least mean delay of any test that is as rarely wrong.

After Lorden (Annals of Mathematical Statistics 42, 1971) and Lai (IEEE Transactions on Information Theory 44, 1998): a
test with a mean of gamma between false alarms needs, in the mean, until the divergence of what is seen to what would be
seen otherwise has grown to ln gamma. Here what is seen is the residual of the plant's own numbers; it is taken against
no failure, with a mean of 1,000 hours between false alarms, and against the failure of each other motor, of which one
in 1,000 may be misnamed (Nikiforov, IEEE Transactions on Information Theory 41, 1995); the later one counts. The loss
shows through the plant's lag, the autopilot's filter and the residual's; the noise is what a healthy flight in the same
wind leaves of the residual beside its mean over a second, which is learnt. Of the way to the companion there is one
link's delay and half a sample; the way back is none of its delay.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core import vehicle as vehicles
from nff_companion.core.residual import ResidualFilter, ResidualState
from nff_companion.core.vehicle import Vehicle
from sitl import airframe as plant_airframe
from sitl.fleet import Fleet, FleetOptions
from sitl.trials import true_file
from sitl.trials.virtual import sample_of

_FALSE_ALARM_H = 1000.0  # the mean between them
_MISNAMED = 1e-3  # of the failures
_SETTLE_S, _FLY_S, _LEARNT_S = 3.0, 15.0, 1.0
_SHOWN_S = 0.5  # after the failure: by then it has shown, or never will


@dataclass(frozen=True, kw_only=True)
class BoundOptions:
    """What is flown: so many ``vehicles`` of the airframe, off from its file by ``model_error``, each known exactly."""

    airframe: str = "octo-x"
    vehicles: int = 8
    rate_hz: float = 200.0
    link_delay_s: float = 0.01
    wind_m_s: float = 4.0
    turbulence_share: float = 0.25
    model_error: float = 0.1


def measure(options: BoundOptions) -> dict[str, Any]:
    """The document of ``nff bench bound``: seconds from the failure, of each motor the mean over the vehicles."""
    known, noises = _flown(options)
    each = np.array([_bounds(vehicle, noise, options) for vehicle, noise in zip(known, noises, strict=True)])
    return {
        "airframe": options.airframe,
        "vehicles": options.vehicles,
        "false_alarm_h": _FALSE_ALARM_H,
        "misnamed": _MISNAMED,
        "motors_s": [_seconds(bound) for bound in each.mean(axis=0)],
        "median_s": _seconds(np.median(each)),
        "least_s": _seconds(each.min()),
        "most_s": _seconds(each.max()),
    }


def _seconds(bound: float) -> float | None:
    """None: not within the time looked at."""
    return round(float(bound), 4) if math.isfinite(bound) else None


@dataclass(frozen=True, slots=True)
class Noise:
    """Of a residual: its covariance (n, n), and for how long it is like itself."""

    covariance: NDArray[np.float64]
    correlation_s: float


def _flown(options: BoundOptions) -> tuple[list[Vehicle], list[Noise]]:
    """Vehicles as they are, and the noise of their residuals in hover."""
    nominal, n = vehicles.path_of(options.airframe), options.vehicles
    fleet = Fleet(
        plant_airframe.load(nominal, vehicles=n),
        FleetOptions(
            seeds=list(range(1, n + 1)),
            model_error=options.model_error,
            wind_m_s=options.wind_m_s,
            turbulence_m_s=options.turbulence_share * options.wind_m_s,
            height_m=20.0,
        ),
    )
    known = [_known(nominal, fleet, index) for index in range(n)]
    dt_s = 1.0 / options.rate_hz
    filters = [ResidualFilter(vehicle, dt_s) for vehicle in known]
    states: list[ResidualState | None] = [None] * n
    seen: list[list[NDArray[np.float64]]] = [[] for _ in range(n)]
    next_s = _SETTLE_S
    while fleet.time_s < _SETTLE_S + _FLY_S:
        fleet.step()
        if fleet.time_s < next_s:
            continue
        next_s += dt_s
        for index, (vehicle, chain) in enumerate(zip(known, filters, strict=True)):
            sample, state = sample_of(fleet, index), states[index]
            command = vehicle.thrust_fraction(sample.output)
            gyro, force = sample.gyro_rad_s, sample.specific_force_m_s2
            if state is None:
                states[index] = chain.start(gyro, force, command)
                continue
            states[index] = state = chain.step(state, gyro, force, command, dt_s)
            seen[index].append(state.measured - vehicle.acceleration_effectiveness.dot(state.thrust_shown))
    return known, [_noise(np.array(residuals), dt_s) for residuals in seen]


def _known(nominal: Path, fleet: Fleet, index: int) -> Vehicle:
    with tempfile.TemporaryDirectory(prefix="nff-bound-") as folder:
        path = Path(folder) / "true.toml"
        path.write_text(true_file.text(nominal, fleet.parameters, index), encoding="utf-8")
        return vehicles.load(str(path))


def _noise(residuals: NDArray[np.float64], dt_s: float) -> Noise:
    """Of residuals (N, n), beside what is learnt of them."""
    count = round(_LEARNT_S / dt_s)
    kernel = np.ones(count) / count
    slow = np.stack([np.convolve(axis, kernel, "same") for axis in residuals.T], axis=1)
    rest = (residuals - slow)[count:-count]
    covariance = np.cov(rest.T)
    white = rest @ np.linalg.inv(np.linalg.cholesky(covariance)).T
    alike = 1.0
    for lag in range(1, count):
        correlation = float(np.mean(white[:-lag] * white[lag:]))
        if correlation <= 0.0:
            break
        alike += 2.0 * correlation
    return Noise(covariance, alike * dt_s)


def _bounds(vehicle: Vehicle, noise: Noise, options: BoundOptions) -> list[float]:
    """Of each motor, seconds from its failure to when no failure is ``ln gamma`` behind, and each other motor as far as
    its misnaming asks for."""
    dt_s = 1.0 / options.rate_hz
    needed = np.full(vehicle.motors, -math.log(_MISNAMED))  # of no failure, then of the others
    needed[0] = math.log(3600.0 * _FALSE_ALARM_H / noise.correlation_s)
    shown = np.stack([_shown(vehicle, motor, dt_s) for motor in range(vehicle.motors)])  # (m, N, n)
    inverse = np.linalg.inv(noise.covariance)
    out = []
    for motor, mine in enumerate(shown):
        rivals = np.concatenate([np.zeros_like(mine)[None], np.delete(shown, motor, axis=0)])
        apart = mine - rivals
        rate = 0.5 * np.einsum("rti,ij,rtj->rt", apart, inverse, apart) / noise.correlation_s
        divergence = np.cumsum(rate * dt_s, axis=1)
        told = np.flatnonzero((divergence >= needed[:, None]).all(axis=0))
        seconds = math.inf if told.size == 0 else dt_s * (1 + int(told[0]))
        out.append(seconds + options.link_delay_s + 0.5 * dt_s)
    return out


def _shown(vehicle: Vehicle, motor: int, dt_s: float) -> NDArray[np.float64]:
    """(N, n) What the loss of ``motor`` (index) in hover does to the residual."""
    # A rotor that is lost need not hear of it.
    at_once = vehicle.with_telemetry(msgspec.structs.replace(vehicle.telemetry, output_delay_s=0.0))
    chain, steady = ResidualFilter(at_once, dt_s), np.full(vehicle.motors, vehicle.hover)
    gyro, force = np.zeros(3), np.array([0.0, 0.0, -1.0])
    state, lost = chain.start(gyro, force, steady), steady * (np.arange(vehicle.motors) != motor)
    out = []
    for _ in range(round(_SHOWN_S / dt_s)):
        state = chain.step(state, gyro, force, lost, dt_s)
        out.append(vehicle.acceleration_effectiveness.dot(state.thrust_shown - steady))
    return np.array(out)
