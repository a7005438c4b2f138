"""The basis network in flight: its file is checked, its Lipschitz bound holds, a is kept within (6.8)."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import convert

from nff_companion.core import basis_network
from nff_companion.core import vehicle as vehicle_model
from nff_companion.core.adaptation import Adaptation
from nff_companion.core.basis_network import Basis
from nff_companion.core.disturbance import Disturbance
from nff_companion.core.features import COMMAND, NAMES, features
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import NetworkError
from nff_companion.training.score import Score


@pytest.fixture
def basis(rng: np.random.Generator) -> basis_network.Basis:
    width = [len(NAMES), 12, 9, 5]
    pairs = list(itertools.pairwise(width))
    return basis_network.Basis(
        weights=tuple(rng.standard_normal((b, a)) / np.sqrt(a + b) for a, b in pairs),
        biases=tuple(rng.standard_normal(b) for _, b in pairs),
        mean=rng.standard_normal(len(NAMES)),
        scale=rng.uniform(0.5, 3.0, len(NAMES)),
        low=np.full(len(NAMES), -5.0),
        high=np.full(len(NAMES), 5.0),
        axis_scale=np.array([1.0, 5.0, 5.0, 0.3]),
        prior=0.1 * rng.standard_normal((6, 4)),
        metadata={"format": basis_network.FORMAT, "inputs": list(NAMES)},
    )


@pytest.mark.parametrize("name", basis_network.names())
def test_shipped_networks_load_and_say_where_they_come_from(name: str) -> None:
    basis = basis_network.load(basis_network.path_of(name))
    metadata = basis.metadata
    assert metadata["command"].startswith("nff train --airframe")
    assert len(metadata["data_sha256"]) == 64
    assert metadata["spectral_norms"] == pytest.approx(basis.spectral_norms, abs=1e-3)
    assert metadata["lipschitz_command"] == pytest.approx(basis.lipschitz_command, abs=1e-3)
    score = convert(metadata["score"], Score)
    assert metadata["covers"] == score.covered
    assert {"thrust", "roll", "pitch"} <= set(score.covered), score


@pytest.mark.parametrize("airframe", vehicle_model.names())
def test_networks_that_airframes_name_hold_the_contraction(airframe: str) -> None:
    vehicle = vehicle_model.load(airframe)
    basis = basis_network.for_vehicle(vehicle, "airframe")
    left_out = basis_network.left_out(vehicle, "airframe")
    assert basis is not None
    untrained = basis.label == "none trained: what goes with the drag"
    assert untrained == (vehicle.network == "" or left_out != "")
    assert (left_out != "") == (airframe == "px4-octo-x"), left_out  # octo-x with weaker motors
    norm = float(np.linalg.norm(np.linalg.pinv(vehicle.effectiveness), 2))
    assert basis.contraction(basis.prior, vehicle, norm) < 1.0
    assert basis_network.for_vehicle(vehicle, "none") is None


def test_a_network_is_used_on_the_airframe_that_it_was_trained_on_or_where_it_is_asked_for(tmp_path: Path) -> None:
    """A copied airframe file brings the network of the vehicle that it was copied from."""
    text = vehicle_model.path_of("octo-x").read_text(encoding="utf-8")
    copied = tmp_path / "mine.toml"
    copied.write_text(text.replace("max_thrust_n = 18.387", "max_thrust_n = 17.0"), encoding="utf-8")
    mine = vehicle_model.load(str(copied))
    assert mine.network == "octo-x"
    untrained = basis_network.for_vehicle(mine, "airframe")
    assert untrained is not None
    assert untrained.label == "none trained: what goes with the drag"
    force = np.array([0.0, 0.0, 0.0, 2.0, -3.0, *np.zeros(6)])
    np.testing.assert_array_equal(untrained(force), [2.0, -3.0, 1.0])
    assert "octo-x is left out" in basis_network.left_out(mine, "airframe")
    assert basis_network.for_vehicle(mine, "octo-x") is not None
    assert basis_network.left_out(mine, "octo-x") == ""
    copied.write_text(text.replace('name = "octo-x"', 'name = "renamed"'), encoding="utf-8")
    assert basis_network.for_vehicle(vehicle_model.load(str(copied)), "airframe") is not None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("mass_kg = 6.0", "mass_kg = 6.1"),
        ("time_constant_up_s = 0.045", "time_constant_up_s = 0.046"),
        ("thrust_expo = 0.65", "thrust_expo = 0.66"),
        ("spin_min = 0.15", "spin_min = 0.16"),
        ('spin = "cw"', 'spin = "ccw"'),
        ("arm_m = 0.5", "arm_m = 0.51"),
    ],
)
def test_another_number_is_another_fingerprint_but_another_filter_is_not(old: str, new: str, tmp_path: Path) -> None:
    text = vehicle_model.path_of("octo-x").read_text(encoding="utf-8")
    path = tmp_path / "other.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    octo = vehicle_model.load("octo-x")
    assert vehicle_model.load(str(path)).fingerprint != octo.fingerprint
    path.write_text(text.replace("gyro_filter_hz = 20 ", "gyro_filter_hz = 30 "), encoding="utf-8")
    assert vehicle_model.load(str(path)).fingerprint == octo.fingerprint


def test_a_network_comes_back_from_its_file_as_it_was(basis: Basis, tmp_path: Path, rng: np.random.Generator) -> None:
    basis.save(tmp_path / "network.npz")
    back = basis_network.load(tmp_path / "network.npz")
    x = rng.standard_normal(len(NAMES))
    np.testing.assert_allclose(back(x), basis(x), atol=1e-5)
    assert back.metadata == basis.metadata


def test_the_forward_pass_is_the_plain_one(basis: Basis, rng: np.random.Generator) -> None:
    x = rng.uniform(-4, 4, len(NAMES))
    h = (x - basis.mean) / basis.scale
    for index, (weight, bias) in enumerate(zip(basis.weights, basis.biases, strict=True)):
        h = weight @ (np.maximum(h, 0.0) if index else h) + bias
    np.testing.assert_allclose(basis(x), [*h, 1.0], atol=1e-12)


def test_inputs_outside_the_training_flights_change_nothing_more(basis: Basis) -> None:
    edge = np.full(len(NAMES), 6.5)
    np.testing.assert_allclose(basis(edge), basis(np.full(len(NAMES), 1e6)))
    assert np.isfinite(basis(np.full(len(NAMES), np.inf))).all()


def test_the_lipschitz_bound_holds(basis: Basis, octo: Vehicle, rng: np.random.Generator) -> None:
    row = octo.acceleration_effectiveness[0]
    for _ in range(300):
        x = rng.uniform(-5, 5, len(NAMES))
        u, v = rng.uniform(0, 1, (2, octo.motors))
        one, other = x.copy(), x.copy()
        one[COMMAND], other[COMMAND] = row @ u, row @ v
        change = np.linalg.norm(basis(one) - basis(other))
        assert change <= basis.lipschitz_u(octo) * np.linalg.norm(u - v) + 1e-12


def test_a_is_projected_until_the_fixed_point_exists(basis: Basis, octo: Vehicle) -> None:
    a = 500.0 * np.ones_like(basis.prior)
    kept = basis.project(a, octo, 3.0)
    assert basis.contraction(kept, octo, 3.0) == pytest.approx(0.999)
    np.testing.assert_array_equal(kept[-1], a[-1])  # the constant does not depend on u
    small = 1e-4 * a
    assert basis.project(small, octo, 3.0) is small


def test_the_cheap_bound_of_the_contraction_is_never_below_it(
    basis: Basis, octo: Vehicle, rng: np.random.Generator
) -> None:
    for _ in range(100):
        a = rng.standard_normal(basis.prior.shape) * rng.uniform(0.0, 2.0, basis.prior.shape)
        assert basis._contraction_bound(a, octo, 2.0) >= basis.contraction(a, octo, 2.0) * (1.0 - 1e-12)


def test_a_network_that_breaks_the_contraction_is_refused(basis: Basis, octo: Vehicle, tmp_path: Path) -> None:
    dataclasses.replace(basis, prior=1000.0 * np.ones_like(basis.prior)).save(tmp_path / "wild.npz")
    with pytest.raises(NetworkError, match=r"\(6\.8\)"):
        basis_network.for_vehicle(octo, str(tmp_path / "wild.npz"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": np.zeros(len(NAMES))}, "scale"),
        ({"mean": np.zeros(3)}, "shape"),
        ({"prior": np.zeros((3, 4))}, "prior"),
        ({"axis_scale": np.array([1.0, math.nan, 1.0, 1.0])}, "finite"),
        ({"metadata": {"format": 99, "inputs": list(NAMES)}}, "format"),
        ({"metadata": {"format": basis_network.FORMAT, "inputs": ["rpm"]}}, "inputs"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(
    basis: Basis, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    dataclasses.replace(basis, **change).save(tmp_path / "bad.npz")
    with pytest.raises(NetworkError, match=message):
        basis_network.load(tmp_path / "bad.npz")


def test_garbage_and_unknown_names_are_refused_with_a_hint(tmp_path: Path) -> None:
    (tmp_path / "junk.npz").write_bytes(b"not a network")
    for choice in (str(tmp_path / "junk.npz"), str(tmp_path / "missing.npz"), "no-such-network"):
        with pytest.raises(NetworkError, match=r"nff train|one of"):
            basis_network.load(basis_network.path_of(choice))


def test_a_file_cut_short_is_refused_and_saving_leaves_nothing_else(basis: Basis, tmp_path: Path) -> None:
    path = tmp_path / "network.npz"
    basis.save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["network.npz"]
    whole = path.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:size])
        with pytest.raises(NetworkError, match="train it again"):
            basis_network.load(path)


def test_features_are_the_same_whatever_the_heading(rng: np.random.Generator) -> None:
    velocity, lateral, rate = rng.standard_normal(3), rng.standard_normal(2), rng.standard_normal(3)
    tilt = np.array([math.cos(0.1), math.sin(0.1), 0.0, 0.0])
    seen = []
    for yaw in (0.0, 1.0, 2.5):
        turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
        w, z, c, s = turn[0], turn[3], tilt[0], tilt[1]
        quaternion = np.array([w * c, w * s, z * s, z * c])
        flown = np.array(
            [
                math.cos(yaw) * velocity[0] - math.sin(yaw) * velocity[1],
                math.sin(yaw) * velocity[0] + math.cos(yaw) * velocity[1],
                velocity[2],
            ]
        )
        seen.append(features(flown, quaternion, lateral, rate, np.array([9.8, 0, 0, 0])))
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-12)
    np.testing.assert_allclose(seen[2], seen[0], atol=1e-12)
    assert len(seen[0]) == len(NAMES)
    assert seen[0][6] > 0.1, "rolled right: gravity points to the right"


def test_without_attitude_or_velocity_phi_fades_into_the_constant(
    basis: Basis, octo: Vehicle, rng: np.random.Generator
) -> None:
    disturbance = Disturbance(octo, basis)
    state = disturbance.start()
    known = disturbance.basis(state, rng.uniform(-2, 2, len(NAMES)), 0.005)
    state = dataclasses.replace(state, basis=known)
    for _ in range(2000):
        faded = disturbance.basis(state, None, 0.005)
        assert float(np.abs(faded - state.basis).max()) <= 0.003 * float(np.abs(known - np.eye(6)[-1]).max())
        state = dataclasses.replace(state, basis=faded)
    np.testing.assert_allclose(state.basis, np.eye(6)[-1], atol=0.01 * float(np.abs(known).max()))


def test_a_is_within_the_bound_even_while_nothing_is_learnt(basis: Basis, octo: Vehicle) -> None:
    """The bound falls when motors are declared, which is when learning rests."""
    disturbance = Disturbance(octo, basis)
    state = disturbance.start()
    norm = 5.0 / basis.contraction(basis.prior, octo, 1.0)
    after = disturbance.step(state, state.basis, np.zeros(4), 0.005, 0.0, norm)
    assert basis.contraction(state.adaptation.a, octo, norm) > 1.0 > basis.contraction(after.adaptation.a, octo, norm)


def test_no_rounding_error_holds_learning_back(octo: Vehicle, rng: np.random.Generator) -> None:
    """Where what was learnt is within its limit nothing of it is in excess, on any machine, whatever was summed."""
    network = basis_network.for_vehicle(octo, "airframe")
    assert network is not None
    disturbance, adaptation = Disturbance(octo, network), Adaptation(network.prior, Tuning().adaptation)
    for _ in range(300):
        state = disturbance.start()
        state.adaptation.a[-1] += 0.1 * rng.uniform(-1, 1, 4) * disturbance.loss_scale / network.axis_scale
        phi = disturbance.basis(state, rng.uniform(-0.3, 0.3, len(NAMES)), 0.005)
        expected = disturbance.expect(state, phi)
        residual = expected.learnt + 0.1 * disturbance.loss_scale * rng.standard_normal(4)
        learnt = adaptation.step(state.adaptation, phi, residual / network.axis_scale, 0.005)
        after = disturbance.learn(state, expected, residual, 0.005)
        np.testing.assert_array_equal(after.adaptation.a, learnt.a)
        assert not expected.excess.any()
