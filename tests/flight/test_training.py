"""Training: the exported network is the trained one, runs are repeatable and can be taken up again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nff_companion.core.basis_network import load
from nff_companion.core.features import NAMES
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import ConfigError, LogError
from nff_companion.training.dataset import Condition, Dataset, record, split
from nff_companion.training.score import score

pytestmark = pytest.mark.train
daiml = pytest.importorskip("nff_companion.training.daiml", reason="NO NETWORK WAS TRAINED", exc_type=ImportError)
torch, Trainer, TrainingOptions = daiml.torch, daiml.Trainer, daiml.TrainingOptions

OPTIONS = TrainingOptions(iterations=200, hidden=(24, 24), functions=4, checkpoint_every=80)


def flights(count: int = 4, seed: int = 3) -> Dataset:
    """Residuals that a network can learn: a nonlinear function of the velocity, scaled differently in each flight."""
    draw = np.random.default_rng(seed)
    conditions = []
    for k in range(count):
        x = draw.standard_normal((600, len(NAMES)))
        scale = 1.0 + 0.5 * draw.standard_normal()
        y = np.stack([np.tanh(x[:, 0]), x[:, 1] * np.abs(x[:, 1]), np.sin(x[:, 2]), 0.3 * x[:, 4]], axis=1)
        conditions.append(Condition(f"flight {k}", x, scale * y + 0.05 * draw.standard_normal((600, 4))))
    return Dataset(conditions)


def test_the_exported_network_is_the_trained_one(tmp_path: Path, rng: np.random.Generator) -> None:
    trainer = Trainer(flights(), OPTIONS, "cpu")
    trainer.run()
    basis = trainer.basis({"airframe": "test", "command": "nff train --airframe test"})
    basis.save(tmp_path / "network.npz")
    flown = load(tmp_path / "network.npz")
    assert max(flown.spectral_norms[:-1]) <= OPTIONS.spectral_cap + 1e-5
    # phi in flight is a linear map of torch's: its map is recovered from some inputs and must hold for all others.
    x = rng.uniform(-2.0, 2.0, (80, len(NAMES)))
    with torch.no_grad():
        theirs = trainer.phi(torch.tensor((x - trainer.mean) / trainer.scale, dtype=torch.float32)).double().numpy()
    ours = np.array([flown(row)[:-1] for row in x])
    known = np.concatenate([theirs, np.ones((80, 1))], axis=1)
    linear, *_ = np.linalg.lstsq(known[:40], ours[:40], rcond=None)
    np.testing.assert_allclose(known[40:] @ linear, ours[40:], atol=1e-5)
    # And the weights as they are, before that map:
    hidden = (x - trainer.mean) / trainer.scale
    layers = [layer for layer in trainer.phi if hasattr(layer, "weight")]
    for index, layer in enumerate(layers):
        hidden = np.maximum(hidden, 0.0) if index else hidden
        hidden = hidden @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
    np.testing.assert_allclose(hidden, theirs, atol=1e-5)


def test_a_trained_basis_foretells_what_a_constant_cannot(octo: Vehicle) -> None:
    trainer = Trainer(flights(), OPTIONS, "cpu")
    trainer.run()
    result = score(octo, trainer.basis({}), flights(2, seed=9))
    assert min(result.explained[:3]) > 0.5, result
    assert max(result.error_over_constant[:3]) < 0.7, result


def test_the_same_seed_gives_the_same_network_and_an_interrupted_run_too(tmp_path: Path) -> None:
    class Stop(Exception):
        pass

    def stop(iteration: int, loss: float) -> None:
        if iteration == 100:
            raise Stop

    whole = Trainer(flights(), OPTIONS, "cpu")
    whole.run()
    broken = Trainer(flights(), OPTIONS, "cpu")
    checkpoint, curves = tmp_path / "c.checkpoint", tmp_path / "c.csv"
    with pytest.raises(Stop):
        broken.run(checkpoint, curves, stop)
    assert checkpoint.exists()
    again = Trainer(flights(), OPTIONS, "cpu")
    again.run(checkpoint, curves)
    assert not checkpoint.exists()
    assert curves.read_text().splitlines()[0] == "iteration,loss,adversary_loss"
    one, other = whole.basis({}), again.basis({})
    for a, b in zip(one.weights, other.weights, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.prior, other.prior)


def test_a_checkpoint_of_other_flights_is_refused(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.checkpoint"
    first = Trainer(flights(), OPTIONS, "cpu")
    first._save(checkpoint)
    with pytest.raises(ConfigError, match="other flights"):
        Trainer(flights(seed=4), OPTIONS, "cpu").run(checkpoint)


def test_one_condition_is_not_enough() -> None:
    with pytest.raises(ConfigError, match="at least 2"):
        Trainer(flights(1), OPTIONS, "cpu")


def test_a_long_flight_is_several_conditions() -> None:
    flight = flights(1).conditions[0]
    parts = split(flight, 4.0)
    assert len(parts) == 1  # too short to be worth splitting
    long = Condition("long", np.tile(flight.features, (3, 1)), np.tile(flight.residual, (3, 1)))
    assert sum(len(p.features) for p in split(long, 8.0)) == 1800
    assert len(split(long, 8.0)) == 4


def test_a_log_without_flight_says_what_it_lacks(octo: Vehicle) -> None:
    with pytest.raises(LogError, match="LOCAL_POSITION_NED"):
        record(octo, 200.0, [], "empty.ulg")


def test_a_checkpoint_that_cannot_be_read_says_so(tmp_path: Path) -> None:
    checkpoint = tmp_path / "c.checkpoint"
    for garbage in (b"", b"not a checkpoint", b"PK\x03\x04 cut"):
        checkpoint.write_bytes(garbage)
        with pytest.raises(ConfigError, match="begin anew"):
            Trainer(flights(), OPTIONS, "cpu").run(checkpoint)


def test_functions_that_hardly_move_are_left_out() -> None:
    trainer = Trainer(flights(), OPTIONS, "cpu")
    with torch.no_grad():
        last = [layer for layer in trainer.phi if hasattr(layer, "weight")][-1]
        last.weight[1:3] = 0.0
    basis = trainer.basis({})
    assert basis.functions <= OPTIONS.functions - 2 + 1
    values = np.array([basis(row)[:-1] for c in flights().conditions for row in c.features])
    np.testing.assert_allclose(np.cov(values.T), np.eye(basis.functions - 1), atol=1e-3)


def test_a_slow_log_is_scored_at_its_own_rate(octo: Vehicle) -> None:
    first = flights(1).conditions[0]
    whole = Condition("25 Hz", first.features, first.residual, 25.0)
    assert Dataset([whole]).minutes == pytest.approx(600 / 25 / 60)
    trainer = Trainer(flights(), OPTIONS, "cpu")
    result = score(octo, trainer.basis({}), Dataset([whole]))
    assert result.minutes == pytest.approx(0.4)
    assert result.fast_constant_follow_s > 0.0
