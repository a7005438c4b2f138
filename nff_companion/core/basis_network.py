"""The basis network phi(x, u): loading with its checks, and the forward pass in numpy.

An ``.npz`` of float32 arrays and a JSON text ``metadata``. ReLU between layers, none after the last; a constant 1 is
appended to the k outputs, so that the basis has k + 1 functions and the constant disturbance is the special case k = 0.
The residual of axis i in SI is  y_i = axis_scale_i * (phi a)_i.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import network_file
from nff_companion.core.features import COMMAND, NAMES
from nff_companion.core.tuning import NetworkTuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NetworkError

FORMAT = network_file.FORMAT


@dataclass(frozen=True)
class Basis:
    """One network, immutable."""

    weights: tuple[NDArray[np.float64], ...]  # (out, in) each
    biases: tuple[NDArray[np.float64], ...]
    mean: NDArray[np.float64]  # (d,) of the inputs
    scale: NDArray[np.float64]  # (d,)
    low: NDArray[np.float64]  # (d,) range of the training flights
    high: NDArray[np.float64]
    axis_scale: NDArray[np.float64]  # (n,) SI
    prior: NDArray[np.float64]  # a0 (k + 1, n)
    metadata: dict[str, Any]
    tuning: NetworkTuning = field(default_factory=NetworkTuning)

    def __call__(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """phi (k + 1,), the last one 1, of an input vector (d,)."""
        first, offset = self._first
        h = first.dot(np.minimum(np.maximum(features, self._lowest), self._highest)) + offset
        for zero, weight, bias in self._further:
            h = weight.dot(np.maximum(h, zero)) + bias
        phi = np.ones(self.functions)
        phi[:-1] = h
        return phi

    @property
    def functions(self) -> int:
        """k + 1."""
        return len(self.prior)

    @property
    def label(self) -> str:
        """Which network this is, for people."""
        m = self.metadata
        if "label" in m:
            return str(m["label"])
        covers = ", ".join(m.get("covers", [])) or "no axis by its score"
        return f"{m.get('airframe', 'unnamed')}, {m.get('minutes', '?')} min, {m.get('data_sha256', '')[:8]}: {covers}"

    @cached_property
    def _first(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """First layer with the normalisation of the inputs folded in."""
        weight = self.weights[0] / self.scale
        return weight, self.biases[0] - weight @ self.mean

    @cached_property
    def _further(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], ...]:
        """The layers after the first one: what their input is cut at (zeros: numpy is slower with a number), weights,
        biases."""
        layers = zip(self.weights[1:], self.biases[1:], strict=True)
        return tuple((np.zeros(weight.shape[1]), weight, bias) for weight, bias in layers)

    @cached_property
    def _lowest(self) -> NDArray[np.float64]:
        if not np.isfinite(self.low).all():
            return self.low
        return self.low - self.tuning.outside_share * (self.high - self.low)

    @cached_property
    def _highest(self) -> NDArray[np.float64]:
        if not np.isfinite(self.high).all():
            return self.high
        return self.high + self.tuning.outside_share * (self.high - self.low)

    @cached_property
    def spectral_norms(self) -> tuple[float, ...]:
        """Largest singular value of each layer."""
        return tuple(float(np.linalg.norm(w, 2)) for w in self.weights)

    @cached_property
    def lipschitz_command(self) -> float:
        """Bound of |d phi| per m/s^2 of commanded thrust: the layers' norms, of the first one only the column that the
        command enters by."""
        first = float(np.linalg.norm(self.weights[0][:, COMMAND]) / self.scale[COMMAND])
        return first * float(np.prod(self.spectral_norms[1:]))

    def lipschitz_u(self, vehicle: Vehicle) -> float:
        """Lip_u(phi): the same per thrust fraction of the motors."""
        return self.lipschitz_command * vehicle.thrust_norm

    def contraction(self, a: NDArray[np.float64], vehicle: Vehicle, allocation_norm: float) -> float:
        """Left side of (6.8), sigma(A) Lip_u(phi) |a|, in the normalised units of A; below 1 the law's fixed point
        (6.7) exists and is reached."""
        unit = vehicle.normalised_per_acceleration * self.axis_scale
        return allocation_norm * self.lipschitz_u(vehicle) * float(np.linalg.norm(a[:-1] * unit, 2))

    def _contraction_bound(self, a: NDArray[np.float64], vehicle: Vehicle, allocation_norm: float) -> float:
        """No less than ``contraction``, for a tenth of its cost: the Frobenius norm is never below the spectral one."""
        scaled = (a[:-1] * (vehicle.normalised_per_acceleration * self.axis_scale)).ravel()
        return allocation_norm * self.lipschitz_u(vehicle) * math.sqrt(float(scaled.dot(scaled)))

    def project(self, a: NDArray[np.float64], vehicle: Vehicle, allocation_norm: float) -> NDArray[np.float64]:
        """a (k + 1, n), its network part shortened until (6.8) holds for A of norm ``allocation_norm``."""
        most = self.tuning.contraction_max
        if self._contraction_bound(a, vehicle, allocation_norm) < most:
            return a
        size = self.contraction(a, vehicle, allocation_norm)
        if size < most:
            return a
        out = a.copy()
        out[:-1] *= self.tuning.contraction_kept * most / size
        return out

    def save(self, path: Path) -> None:
        """Write the file that ``load`` reads; whoever is killed meanwhile leaves the old one."""
        arrays: dict[str, NDArray[np.float64]] = {}
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight_{index}"], arrays[f"bias_{index}"] = weight, bias
        for name in ("mean", "scale", "low", "high", "axis_scale", "prior"):
            arrays[name] = getattr(self, name)
        compact = {name: value.astype(np.float32) for name, value in arrays.items()}
        compact["metadata"] = np.array(json.dumps(self.metadata, sort_keys=True))
        partial = path.with_suffix(".part.npz")
        np.savez(partial, allow_pickle=False, **compact)
        partial.replace(path)


def load(path: Path) -> Basis:
    """Read a network. Raises NetworkError naming file, array, value and what is allowed, for any file whatever."""
    numbers, metadata = network_file.read(path)
    layers = sum(name.startswith("weight_") for name in numbers)
    return Basis(
        weights=tuple(numbers[f"weight_{i}"] for i in range(layers)),
        biases=tuple(numbers[f"bias_{i}"] for i in range(layers)),
        metadata=metadata,
        mean=numbers["mean"],
        scale=numbers["scale"],
        low=numbers["low"],
        high=numbers["high"],
        axis_scale=numbers["axis_scale"],
        prior=numbers["prior"],
    )


def names() -> list[str]:
    """Networks shipped with the package."""
    folder = resources.files("nff_companion") / "networks"
    return sorted(f.name.removesuffix(".npz") for f in folder.iterdir() if f.name.endswith(".npz"))


def path_of(name: str) -> Path:
    """File of a shipped network, or ``name`` itself when it is a path to an .npz file. Raises NetworkError."""
    if name.endswith(".npz"):
        return Path(name)
    if name not in names():
        raise NetworkError(f"network {name!r} is unknown: give a path to an .npz file or one of {', '.join(names())}")
    return Path(str(resources.files("nff_companion") / "networks" / f"{name}.npz"))


def left_out(vehicle: Vehicle, choice: str) -> str:
    """Why the network that the file of ``vehicle`` names is not used: it was trained on another airframe, whose file
    this one may be a copy of. Empty: it is used, or none was to be. Raises NetworkError."""
    if choice != "airframe" or not vehicle.network:
        return ""
    trained = load(path_of(vehicle.network)).metadata
    if trained.get("fingerprint") == vehicle.fingerprint:
        return ""
    whose = "with numbers that are not this file's" if trained.get("fingerprint") else "nobody knows with which numbers"
    return (
        f"{vehicle.network} is left out: trained on {trained.get('airframe', 'unnamed')}, {whose}; train one for this"
        " airframe, or ask for it by name in [vehicle] network"
    )


def for_vehicle(vehicle: Vehicle, choice: str, tuning: NetworkTuning | None = None) -> Basis | None:
    """What ``choice`` means for ``vehicle``: ``airframe`` the network that its file names, where it was trained on this
    very airframe (``left_out``), else as ``drag``; ``drag`` (below); ``none`` a constant basis, None; a shipped name or
    a path. Raises NetworkError, also when the network breaks (6.8) with the nominal allocation."""
    if choice == "none":
        return None
    name = vehicle.network if choice == "airframe" else choice
    if not name or choice == "drag" or left_out(vehicle, choice):
        return drag(vehicle, tuning)
    basis = replace(load(path_of(name)), tuning=tuning or NetworkTuning())
    check(basis, vehicle, name)
    return basis


def drag(vehicle: Vehicle, tuning: NetworkTuning | None = None) -> Basis:
    """Where no network was trained: what air does to each axis goes with the lateral specific force, which is the drag,
    beside the constant. By how much is what a flight teaches; before it, nothing (a0 = 0)."""
    inputs, loss = len(NAMES), vehicle.acceleration_effectiveness * vehicle.hover
    tuning = tuning or NetworkTuning()
    weights = np.zeros((2, inputs))
    weights[0, NAMES.index("force_x")] = weights[1, NAMES.index("force_y")] = 1.0 / tuning.drag_m_s2
    return Basis(
        weights=(weights,),
        biases=(np.zeros(2),),
        mean=np.zeros(inputs),
        scale=np.ones(inputs),
        low=np.full(inputs, -np.inf),
        high=np.full(inputs, np.inf),
        axis_scale=np.sqrt((loss**2).mean(axis=1)),
        prior=np.zeros((3, vehicle.axes)),
        metadata={"label": "none trained: what goes with the drag"},
        tuning=tuning,
    )


def check(basis: Basis, vehicle: Vehicle, name: str) -> None:
    """Raises NetworkError when ``basis`` has other axes than ``vehicle``, or breaks (6.8) with the nominal A."""
    if len(basis.axis_scale) != vehicle.axes:
        raise NetworkError(f"network {name} covers {len(basis.axis_scale)} axes, {vehicle.name} has {vehicle.axes}")
    nominal = float(np.linalg.norm(np.linalg.pinv(vehicle.effectiveness), 2))
    size, most = basis.contraction(basis.prior, vehicle, nominal), basis.tuning.contraction_max
    if not size < most:
        raise NetworkError(
            f"network {name} breaks (6.8) on {vehicle.name}: sigma(A) Lip_u(phi) |a| = {size:.2f}, below"
            f" {most} is needed: its answer to its own command would not settle; train it with a lower cap"
        )
