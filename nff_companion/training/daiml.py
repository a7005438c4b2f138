"""Domain-adversarially invariant meta-learning of the basis (Science Robotics 2022): needs torch, the extra ``train``.

Each step takes some conditions. On one batch of a condition its coefficients a come by regularised least squares, on
another phi a is compared with the residual. An adversary h tries to tell the condition from phi, and phi is rewarded
when it cannot: what differs between conditions belongs into a. Each layer's spectral norm is capped while training,
the column that the command enters by once more, so that (6.8) holds; the scaling of the last layer to functions of unit
variance comes after it, and is counted in the bound.
"""

from __future__ import annotations

import csv
import itertools
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.basis_network import FORMAT, Basis
from nff_companion.core.features import COMMAND, NAMES
from nff_companion.errors import ConfigError, MissingExtra
from nff_companion.training.dataset import Dataset

try:
    import torch
    from torch import nn
except ImportError as missing:
    raise MissingExtra("training needs torch: pip install nff-companion[train]") from missing

_WEAKEST = 0.05  # a direction of phi with less variance than this share of the strongest is left out


class TrainingOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Hyperparameters; they are written into the network."""

    functions: int = 6  # k
    hidden: tuple[int, ...] = (50, 60, 50)
    spectral_cap: float = 1.0
    command_cap: float = 0.06  # norm of the first layer's column of the commanded thrust
    adversary: float = 0.02  # alpha; 0: none
    iterations: int = 3000
    conditions: int = 8  # a step
    adaptation_batch: int = 128
    batch: int = 256
    learning_rate: float = 1e-3
    ridge: float = 1.0  # of the least squares for a
    seed: int = 1
    checkpoint_every: int = 1000


def network(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """ReLU between the layers."""
    width = [inputs, *hidden, outputs]
    layers: list[nn.Module] = []
    for a, b in itertools.pairwise(width):
        layers += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class Trainer:
    """One training run; ``run`` may be interrupted and taken up again from its checkpoint."""

    def __init__(self, data: Dataset, options: TrainingOptions, device: str | None = None) -> None:
        if len(data.conditions) < 2:
            raise ConfigError(
                f"{len(data.conditions)} conditions to train on: at least 2 are needed, of different winds or payloads"
            )
        torch.use_deterministic_algorithms(True)
        torch.manual_seed(options.seed)
        self._data, self._options = data, options
        self._device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        features = np.concatenate([c.features for c in data.conditions])
        residual = np.concatenate([c.residual for c in data.conditions])
        self.mean, self.scale = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
        self.low, self.high = features.min(axis=0), features.max(axis=0)
        self.axis_scale = np.maximum(residual.std(axis=0), 1e-3)
        self._inputs = [self._tensor((c.features - self.mean) / self.scale) for c in data.conditions]
        self._targets = [self._tensor(c.residual / self.axis_scale) for c in data.conditions]
        self.phi = network(len(NAMES), options.hidden, options.functions).to(self._device)
        self._adversary = network(options.functions, (64,), len(data.conditions)).to(self._device)
        self._phi_optimiser = torch.optim.Adam(self.phi.parameters(), lr=options.learning_rate)
        self._adversary_optimiser = torch.optim.Adam(self._adversary.parameters(), lr=options.learning_rate)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._phi_optimiser, options.iterations)
        self._generator = torch.Generator().manual_seed(options.seed)
        self._iteration = 0
        self._cap()

    def _tensor(self, values: NDArray[np.float64]) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def run(
        self,
        checkpoint: Path | None = None,
        curves: Path | None = None,
        progress: Callable[[int, float], None] = lambda iteration, loss: None,
    ) -> None:
        """Train to the end. ``checkpoint`` is taken up when it is there, and removed at the end; ``curves``: CSV."""
        o = self._options
        if checkpoint is not None and checkpoint.exists():
            self._restore(checkpoint)
        elif curves is not None:
            curves.write_text("iteration,loss,adversary_loss\n", encoding="utf-8")
        total = other = 0.0
        every = 100
        while self._iteration < o.iterations:
            loss, adversary = self._step()
            total, other = total + loss, other + adversary
            self._iteration += 1
            if self._iteration % every == 0:
                progress(self._iteration, total / every)
                if curves is not None:
                    with curves.open("a", newline="", encoding="utf-8") as file:
                        csv.writer(file).writerow([self._iteration, f"{total / every:.6f}", f"{other / every:.6f}"])
                total = other = 0.0
            if checkpoint is not None and self._iteration % o.checkpoint_every == 0:
                self._save(checkpoint)
        if checkpoint is not None:
            checkpoint.unlink(missing_ok=True)

    def _batch(self, condition: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        inputs, targets = self._inputs[condition], self._targets[condition]
        rows = torch.randint(len(inputs), (size,), generator=self._generator).to(self._device)
        return inputs[rows], targets[rows]

    def _step(self) -> tuple[float, float]:
        o = self._options
        chosen = torch.randint(len(self._inputs), (o.conditions,), generator=self._generator).tolist()
        fit = [self._batch(c, o.adaptation_batch) for c in chosen]
        check = [self._batch(c, o.batch) for c in chosen]
        a = self._solve(torch.stack([x for x, _ in fit]), torch.stack([y for _, y in fit]))
        phi = self.phi(torch.stack([x for x, _ in check]))
        error = _with_constant(phi) @ a - torch.stack([y for _, y in check])
        loss = (error**2).mean()
        label = torch.tensor(chosen, device=self._device).repeat_interleave(o.batch)
        rewarded = loss
        if o.adversary:
            told = nn.functional.cross_entropy(self._adversary(phi).reshape(-1, len(self._inputs)), label)
            rewarded = loss - o.adversary * told
        self._phi_optimiser.zero_grad()
        rewarded.backward()
        self._phi_optimiser.step()
        self._schedule.step()
        self._cap()
        if not o.adversary:
            return loss.item(), 0.0
        told = nn.functional.cross_entropy(self._adversary(phi.detach()).reshape(-1, len(self._inputs)), label)
        self._adversary_optimiser.zero_grad()
        told.backward()
        self._adversary_optimiser.step()
        return loss.item(), told.item()

    def _solve(self, inputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """a (..., k + 1, n) by least squares with a ridge."""
        phi = _with_constant(self.phi(inputs))
        gram = phi.transpose(-1, -2) @ phi + self._options.ridge * torch.eye(phi.shape[-1], device=self._device)
        return torch.linalg.solve(gram, phi.transpose(-1, -2) @ targets)

    @torch.no_grad()
    def _cap(self) -> None:
        """Spectral normalisation: layers above the cap are scaled down to it."""
        layers = [layer for layer in self.phi if isinstance(layer, nn.Linear)]
        column = layers[0].weight[:, COMMAND]
        column *= min(1.0, self._options.command_cap / max(float(column.norm()), 1e-9))
        for layer in layers:
            norm = float(torch.linalg.matrix_norm(layer.weight, 2))
            if norm > self._options.spectral_cap:
                layer.weight *= self._options.spectral_cap / norm

    # -- checkpoint ---------------------------------------------------------------------------------------------

    def _save(self, path: Path) -> None:
        state = {
            "data": self._data.sha256,
            "options": msgspec.json.encode(self._options).decode(),
            "iteration": self._iteration,
            "generator": self._generator.get_state(),
            **{name: getattr(self, name).state_dict() for name in _STATEFUL},
        }
        partial = path.with_suffix(path.suffix + ".part")
        torch.save(state, partial)
        partial.replace(path)

    def _restore(self, path: Path) -> None:
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except (RuntimeError, EOFError, OSError, KeyError, pickle.UnpicklingError) as error:
            raise ConfigError(f"checkpoint {path} cannot be read: {error}; delete it to begin anew") from error
        if state["data"] != self._data.sha256 or state["options"] != msgspec.json.encode(self._options).decode():
            raise ConfigError(f"checkpoint {path} is of other flights or options: delete it, or train with the same")
        for name in _STATEFUL:
            getattr(self, name).load_state_dict(state[name])
        self._generator.set_state(state["generator"])
        self._iteration = state["iteration"]

    # -- result -------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def basis(self, metadata: dict[str, Any]) -> Basis:
        """The trained network for flight.

        Its functions are made uncorrelated, of zero mean and unit variance over the training flights, so that the
        adaptation's time constant means the same for each; those that hardly move are left out. a0 is the mean of the
        conditions' a in these functions.
        """
        layers = [layer for layer in self.phi if isinstance(layer, nn.Linear)]
        weights = [layer.weight.cpu().numpy().astype(float) for layer in layers]
        biases = [layer.bias.cpu().numpy().astype(float) for layer in layers]
        phi = torch.cat([self.phi(x) for x in self._inputs]).cpu().numpy().astype(float)
        values, vectors = np.linalg.eigh(np.cov(phi.T))
        moving = values >= _WEAKEST * values.max()
        even = vectors.T[moving] / np.sqrt(values[moving])[:, None]
        biases[-1] = even @ (biases[-1] - phi.mean(axis=0))
        weights[-1] = even @ weights[-1]
        whole = Basis(
            weights=tuple(weights),
            biases=tuple(biases),
            mean=self.mean,
            scale=self.scale,
            low=self.low,
            high=self.high,
            axis_scale=self.axis_scale,
            prior=np.zeros((len(even) + 1, len(self.axis_scale))),
            metadata={},
        )
        prior = self._prior(even, phi.mean(axis=0))
        described = {
            "format": FORMAT,
            "inputs": list(NAMES),
            "architecture": [len(NAMES), *self._options.hidden, len(even)],
            "options": msgspec.to_builtins(self._options),
            "data_sha256": self._data.sha256,
            "conditions": len(self._data.conditions),
            "minutes": round(self._data.minutes, 1),
            "spectral_norms": [round(n, 4) for n in whole.spectral_norms],
            "lipschitz_command": round(whole.lipschitz_command, 4),
            **metadata,
        }
        return replace(whole, prior=prior, metadata=described)

    def _prior(self, even: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean over the conditions of their least squares coefficients."""
        solved = []
        for inputs, targets in zip(self._inputs, self._targets, strict=True):
            phi = (self.phi(inputs).cpu().numpy() - centre) @ even.T
            phi = np.concatenate([phi, np.ones((len(phi), 1))], axis=1)
            gram = phi.T @ phi + self._options.ridge * np.eye(phi.shape[1])
            solved.append(np.linalg.solve(gram, phi.T @ targets.cpu().numpy()))
        return np.mean(solved, axis=0)


_STATEFUL = ("phi", "_adversary", "_phi_optimiser", "_adversary_optimiser", "_schedule")


def _with_constant(phi: torch.Tensor) -> torch.Tensor:
    return torch.cat([phi, torch.ones_like(phi[..., :1])], dim=-1)
