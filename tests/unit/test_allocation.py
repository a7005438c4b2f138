"""Allocation methods: the published table, verification, ties, and what happens when nothing fits."""

from __future__ import annotations

from collections.abc import Callable

import daqp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from nff_companion.allocation import METHODS, allocator, authority, problem_for
from nff_companion.allocation.plan import Plan, Refusal, make_plan
from nff_companion.allocation.problem import normalised_columns
from nff_companion.allocation.verify import fault_of
from nff_companion.allocation.within_bounds import constrain, desaturate
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import AllocationInfeasible, ConfigError
from sitl.trials.allocation_bench import measure

# Torque without saturation at hover, octo-X, motor 1 dead: hover fraction -> method -> roll, pitch, yaw.
TABLE = {
    0.5: {"pinv": (0.343, 0.396, 0.333), "printed": (0.343, 0.243, 0.272), "trim": (0.414, 0.414, 0.414)},
    0.6: {"pinv": (0.137, 0.181, 0.133), "printed": (0.190, 0.188, 0.167), "trim": (0.297, 0.297, 0.300)},
    0.3: {"pinv": (0.280, 0.237, 0.287), "printed": (0.497, 0.351, 0.394), "trim": (0.497, 0.351, 0.394)},
}


@pytest.mark.parametrize("hover", TABLE)
def test_bench_reproduces_the_published_table(hover: float) -> None:
    document = measure(airframe="octo-x", hover=hover)
    for method, expected in TABLE[hover].items():
        assert document["methods"][method]["torque"]["1"] == pytest.approx(expected, abs=0.002), method


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["octo-x", "octo-plus", "coax-x8", "hexa-x"])
def test_every_method_is_a_right_inverse_on_healthy_airframes(method: str, name: str) -> None:
    model = vehicle.load(name)
    problem = problem_for(model.effectiveness, np.ones(model.motors), model.hover)
    matrix = allocator(method)(problem)
    np.testing.assert_allclose(model.effectiveness @ matrix, np.eye(4), atol=1e-6)
    assert fault_of(matrix, problem) is None


@pytest.mark.parametrize("motor", range(8))
def test_trim_never_has_less_authority_than_the_published_methods(octo: vehicle.Vehicle, motor: int) -> None:
    eta = np.ones(8)
    eta[motor] = 0.0
    problem = problem_for(octo.effectiveness, eta, octo.hover)
    best = authority(allocator("trim")(problem), octo.hover).sum()
    for method in ("pinv", "kim", "printed"):
        assert best >= authority(allocator(method)(problem), octo.hover).sum() - 1e-6


def test_healthy_trim_reproduces_maximum_control_authority(octo: vehicle.Vehicle) -> None:
    problem = problem_for(octo.effectiveness, np.ones(8), 0.4)
    np.testing.assert_allclose(allocator("trim")(problem), allocator("mca")(problem), atol=1e-4)


def test_a_small_change_of_effectiveness_does_not_make_the_matrix_jump(octo: vehicle.Vehicle) -> None:
    solve = allocator("trim")
    before = None
    for eta in np.linspace(1.0, 0.3, 71):
        effectiveness = np.ones(8)
        effectiveness[2] = eta
        matrix = solve(problem_for(octo.effectiveness, effectiveness, octo.hover))
        if before is not None:
            assert np.abs(matrix - before).max() < 0.15
        before = matrix


def test_a_dead_motor_is_a_removed_column_and_stays_idle(octo: vehicle.Vehicle) -> None:
    eta = np.ones(8)
    eta[4] = 0.0
    for method in METHODS:
        matrix = allocator(method)(problem_for(octo.effectiveness, eta, octo.hover))
        assert not matrix[4].any()


def test_kim_is_optimal_against_random_feasible_directions(octo: vehicle.Vehicle, rng: np.random.Generator) -> None:
    eta = np.ones(8)
    eta[0] = 0.0
    problem = problem_for(octo.effectiveness, eta, octo.hover)
    matrix = allocator("kim")(problem)[1:]
    null = np.linalg.svd(problem.reduced)[2][4:]

    def cost(candidate: NDArray[np.float64]) -> float:
        column = candidate[:, 0]
        return float(np.linalg.norm(candidate) + np.abs(column - column.mean()).sum() / len(column))

    for _ in range(200):
        step = np.zeros_like(matrix)
        step[:, 0] = 0.02 * rng.standard_normal(len(null)) @ null
        if (matrix[:, 0] + step[:, 0]).min() >= 0:
            assert cost(matrix + step) >= cost(matrix) - 1e-6


def test_yaw_is_given_up_where_it_costs_the_balance(octo: vehicle.Vehicle) -> None:
    eta = np.ones(8)
    eta[[0, 7]] = 0.0  # 90 degrees apart, the same spin: balanced thrust 0.354 with yaw, 0.552 without
    plan = make_plan(allocator("trim"), octo.effectiveness, eta, 0.4)
    assert isinstance(plan, Plan)
    assert plan.released == (3,)
    assert not plan.matrix[:, 3].any()
    assert abs(plan.unallocated[3]) > 0.01, "the yaw torque that cannot be balanced is reported"


def test_what_cannot_fly_is_refused_with_a_reason(octo: vehicle.Vehicle) -> None:
    eta = np.ones(8)
    eta[[0, 2, 4, 6]] = 0.0  # the whole front
    plan = make_plan(allocator("trim"), octo.effectiveness, eta, 0.4)
    assert isinstance(plan, Refusal)
    assert "motors left" in plan.reason


def test_a_quadrotor_with_a_dead_motor_is_not_given_a_matrix_with_exploding_gains() -> None:
    quad = vehicle.load("h250")
    for eta in (0.0, 0.02, 0.09):
        plan = make_plan(allocator("pinv"), quad.effectiveness, np.array([eta, 1, 1, 1]), quad.hover)
        assert isinstance(plan, Refusal), plan


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda a: a * np.nan, "finite"),
        (lambda a: a * 1.01, "differs"),
        (lambda a: a[:, :3], "shape"),
        (lambda a: a + 50 * np.ones_like(a), "gain"),
    ],
)
def test_verification_names_what_is_wrong(
    octo: vehicle.Vehicle, spoil: Callable[[NDArray[np.float64]], NDArray[np.float64]], word: str
) -> None:
    problem = problem_for(octo.effectiveness, np.ones(8), octo.hover)
    assert word in (fault_of(spoil(allocator("pinv")(problem)), problem) or "")


def test_verification_refuses_a_driven_dead_motor_and_an_infeasible_hover(octo: vehicle.Vehicle) -> None:
    eta = np.ones(8)
    eta[0] = 0.0
    problem = problem_for(octo.effectiveness, eta, octo.hover)
    matrix = allocator("pinv")(problem)
    matrix[0, 1] = 0.1
    assert "removed motor" in (fault_of(matrix, problem) or "")
    heavy = problem_for(octo.effectiveness, eta, 0.95)
    assert "hover" in (fault_of(allocator("pinv")(heavy), heavy) or "")


def test_unknown_method_and_singular_columns_are_clear_errors(octo: vehicle.Vehicle) -> None:
    with pytest.raises(ConfigError, match="choose one of"):
        allocator("best")
    problem = problem_for(octo.effectiveness, np.ones(8), octo.hover)
    with pytest.raises(AllocationInfeasible):
        normalised_columns(problem, np.ones((8, 4)))


def test_constrained_allocation_serves_roll_and_pitch_first_and_yaw_last(
    octo: Vehicle, rng: np.random.Generator
) -> None:
    problem = problem_for(octo.effectiveness, np.array([0.0, 1, 1, 1, 1, 1, 1, 1]), octo.hover)
    matrix, b = allocator("trim")(problem), problem.effectiveness
    small = np.array([0.4, 0.02, -0.02, 0.02])
    thrust, served = constrain(matrix, b, small)
    np.testing.assert_allclose(b @ thrust, small, atol=1e-9)
    assert served is small
    for _ in range(500):
        wild = rng.uniform([0.0, -1, -1, -1], [1.0, 1, 1, 1])
        thrust, served = constrain(matrix, b, wild)
        assert thrust.min() >= 0.0
        assert thrust.max() <= 1.0
        assert thrust[0] == 0.0, "the dead motor is driven"
        np.testing.assert_allclose(b @ thrust, served, atol=1e-9)
    thrust, served = constrain(matrix, b, np.array([0.5, 0.35, 0.2, 1.0]))
    np.testing.assert_allclose(served[1:3], [0.35, 0.2], atol=0.02)
    assert served[0] == pytest.approx(0.5, abs=0.05)
    assert 0.0 < served[3] < 0.9


def test_constrained_allocation_is_the_minimum_of_its_cost(octo: Vehicle, rng: np.random.Generator) -> None:
    problem = problem_for(octo.effectiveness, np.ones(8), octo.hover)
    matrix, b = allocator("trim")(problem), problem.effectiveness
    omega = np.array([0.2, 1.0, 1.0, 0.03])
    for _ in range(20):
        wild = rng.uniform([0.0, -1, -1, -1], [1.0, 1, 1, 1])
        thrust, _ = constrain(matrix, b, wild)
        best = lsq_linear(omega[:, None] * b, omega * wild, bounds=(0.0, 1.0))
        cost = 0.5 * float(((omega * (b @ thrust - wild)) ** 2).sum())
        assert cost <= best.cost + 1e-5


def test_an_axis_given_up_does_not_pull_at_the_others(octo: Vehicle) -> None:
    problem = problem_for(octo.effectiveness, np.array([0.0, 1, 0.0, 1, 1, 1, 1, 1]), octo.hover, released=(3,))
    matrix, b = allocator("trim")(problem), problem.effectiveness
    with_yaw, _ = constrain(matrix, b, np.array([0.7, 0.2, 0.1, 0.9]))
    without, _ = constrain(matrix, b, np.array([0.7, 0.2, 0.1, 0.0]))
    np.testing.assert_allclose(with_yaw, without)


def test_desaturation_cuts_yaw_first_and_stays_within_bounds(octo: Vehicle, rng: np.random.Generator) -> None:
    matrix = allocator("trim")(problem_for(octo.effectiveness, np.ones(8), octo.hover))
    small = np.array([0.4, 0.1, -0.1, 0.1])
    thrust, served = desaturate(matrix, small)
    np.testing.assert_allclose(octo.effectiveness @ thrust, small, atol=1e-9)
    np.testing.assert_allclose(served, small)
    for _ in range(500):
        wild = rng.uniform([0.0, -1, -1, -1], [1.0, 1, 1, 1])
        thrust, served = desaturate(matrix, wild)
        assert thrust.min() >= 0.0
        assert thrust.max() <= 1.0
        assert abs(served[3]) <= abs(wild[3]) + 1e-12
    thrust, served = desaturate(matrix, np.array([0.4, 0.3, 0.0, 1.0]))
    assert served[1] == pytest.approx(0.3)
    assert abs(served[3]) < 0.9
    assert (octo.effectiveness @ thrust)[1] == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize("axis", range(4))
def test_a_demand_that_is_no_number_never_becomes_thrusts_that_look_like_some(octo: Vehicle, axis: int) -> None:
    matrix = allocator("trim")(problem_for(octo.effectiveness, np.ones(8), octo.hover))
    for demand in ([0.4, 0.0, 0.0, 0.0], [0.9, 0.5, -0.4, 0.6]):
        demand[axis] = np.nan
        assert not np.isfinite(desaturate(matrix, np.array(demand))[0].sum())


def test_a_solver_that_fails_leaves_thrusts_within_bounds(
    octo: Vehicle, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    problem = problem_for(octo.effectiveness, np.array([0.0, 1, 1, 1, 1, 1, 1, 1]), octo.hover)
    matrix, b = allocator("trim")(problem), problem.effectiveness
    for answer, flag in ((np.full(7, np.nan), 1), (np.full(7, 9.0), -1)):
        monkeypatch.setattr(daqp, "solve", lambda *_, a=answer, f=flag: (a, 0.0, f, {}))
        for _ in range(50):
            thrust, _ = constrain(matrix, b, rng.uniform(-3, 3, 4))
            assert thrust.min() >= 0.0
            assert thrust.max() <= 1.0
            assert thrust[0] == 0.0
