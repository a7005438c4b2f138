"""A matrix given over to an autopilot that has already made up for the motor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimates import hovering
from numpy.typing import NDArray

from nff_companion.allocation import allocator
from nff_companion.allocation.handover import Handover, HandoverState
from nff_companion.allocation.plan import Plan, carried, make_plan
from nff_companion.allocation.planner import Planner, PlannerState
from nff_companion.core import vehicle as vehicles
from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import THRUST, Vehicle
from nff_companion.verdict import numbers

DT_S = 0.005


@pytest.fixture(scope="module")
def coax() -> Vehicle:
    return vehicles.load("coax-x8")


class Flight:
    """Motors die; the residual shows it, and some time later they are declared."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle, self.handover = vehicle, Handover(vehicle, Tuning())
        self.planner = Planner(vehicle, allocator("trim"))
        self.state: HandoverState = self.handover.start()
        self.planning: PlannerState = self.planner.start()
        self.failed = np.zeros(vehicle.motors, bool)
        self.time_s = 0.0

    def estimate(self, dead: tuple[int, ...]) -> Estimate:
        effectiveness = np.where(self.failed, 0.0, 1.0)
        lacking = [motor - 1 for motor in dead if not self.failed[motor - 1]]
        carry = self.vehicle.motors - len(set(dead) | set(numbers(self.failed)))
        thrust = np.full(self.vehicle.motors, self.vehicle.hover * self.vehicle.motors / carry)
        if self.state.base is not None:
            thrust[self.planning.planned_for == 0.0] = 0.0  # as the plan in force has it
        estimate = hovering(self.vehicle, effectiveness, thrust_shown=thrust)
        residual = -self.vehicle.acceleration_effectiveness[:, lacking] @ estimate.thrust_shown[lacking]
        return replace(estimate, residual=residual, failed=self.failed)

    def fly(self, seconds: float, dead: tuple[int, ...] = (), *, in_force: bool = True) -> None:
        for _ in range(round(seconds / DT_S)):
            self.time_s += DT_S
            estimate = self.estimate(dead)
            self.planning = self.planner.step(self.planning, self.time_s, estimate)
            self.state = self.handover.step(self.state, self.time_s, DT_S, estimate, self.planning, in_force=in_force)

    def declare(self, *motors: int) -> None:
        self.failed = self.failed.copy()
        self.failed[[motor - 1 for motor in motors]] = True

    @property
    def sent(self) -> Plan:
        plan = self.state.told(self.planning.plan)
        assert plan is not None
        return plan

    def given(self, asked: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) by the motors left, of what is asked."""
        alive = np.where(self.failed, 0.0, 1.0)
        return np.asarray((self.vehicle.effectiveness * alive) @ (self.sent.matrix @ asked))


def asked_when_wound_up(vehicle: Vehicle, dead: tuple[int, ...]) -> NDArray[np.float64]:
    """(n,) What an autopilot asks for in hover once its rate loops' integrators have found the trim without these
    motors, and the height is held by the motors left."""
    lost = [motor - 1 for motor in dead]
    hover = np.array([vehicle.hover, 0.0, 0.0, 0.0])
    each = vehicle.hover * vehicle.motors / (vehicle.motors - len(lost))
    more = vehicle.effectiveness[:, lost] @ np.full(len(lost), each)
    more[THRUST] = 0.0  # the lift is not taken off: whether anybody made up for it is not known
    return np.asarray(hover + more)


@pytest.mark.parametrize("dead", [(3,), (1, 6)])
def test_after_a_late_declaration_the_wrench_in_force_is_kept_and_let_go(octo: Vehicle, dead: tuple[int, ...]) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(2.0, dead)
    flight.declare(*dead)
    flight.fly(DT_S, dead)
    asked, hover = asked_when_wound_up(octo, dead), np.array([octo.hover, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(flight.given(asked), hover, atol=0.03)
    plan = flight.planning.plan
    assert plan is not None
    assert np.abs(plan.effectiveness @ (plan.matrix @ asked) - hover).max() > 0.1  # without it
    flight.fly(Tuning().handover.let_go_s, dead)
    asked = hover + np.exp(-1.0) * (asked - hover)  # they have followed
    np.testing.assert_allclose(flight.given(asked), hover, atol=0.02)
    flight.fly(8.0 * Tuning().handover.let_go_s, dead)
    assert flight.state.plan is None
    assert flight.sent is flight.planning.plan


def test_what_is_declared_at_once_is_given_whole(octo: Vehicle) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(0.05, (3,))
    flight.declare(3)
    flight.fly(DT_S, (3,))
    asked = np.array([octo.hover, 0.05, -0.05, 0.02])
    np.testing.assert_allclose(flight.given(asked), asked, atol=0.03)


def test_what_begins_while_only_watching_is_taken_off_when_it_comes_into_force(octo: Vehicle) -> None:
    flight = Flight(octo)
    flight.fly(3.0, in_force=False)
    flight.fly(0.1, (3,), in_force=False)
    flight.declare(3)
    flight.fly(4.0, (3,), in_force=False)
    assert flight.state.plan is None
    flight.fly(DT_S, (3,))
    hover = np.array([octo.hover, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(flight.given(asked_when_wound_up(octo, (3,))), hover, atol=0.03)
    flight.fly(1.0, (3,), in_force=False)
    assert flight.state.plan is None


def test_after_a_gap_what_is_lacking_is_taken_to_have_been_so_before(octo: Vehicle) -> None:
    flight = Flight(octo)
    flight.fly(0.1, (3,))
    flight.declare(3)
    flight.fly(DT_S, (3,))
    hover = np.array([octo.hover, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(flight.given(asked_when_wound_up(octo, (3,))), hover, atol=0.03)


def test_a_second_loss_is_added_to_what_is_left_of_the_first(octo: Vehicle) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(2.0, (3,))
    flight.declare(3)
    flight.fly(0.5, (3,))
    first = flight.state.wrench * np.exp(-0.5 / Tuning().handover.let_go_s)
    flight.fly(1.0, (3, 6))
    first = first * np.exp(-1.0 / Tuning().handover.let_go_s)
    flight.declare(6)
    flight.fly(DT_S, (3, 6))
    both = octo.effectiveness[:, 5] * octo.hover * octo.motors / (octo.motors - 2)
    both[THRUST] = 0.0
    np.testing.assert_allclose(flight.state.wrench, first + both, atol=0.01)


def test_no_more_is_carried_than_the_motors_can_give(octo: Vehicle, rng: np.random.Generator) -> None:
    effectiveness = np.ones(octo.motors)
    effectiveness[2] = 0.0
    plan = make_plan(allocator("trim"), octo.effectiveness, effectiveness, octo.hover)
    assert isinstance(plan, Plan)
    asked = asked_when_wound_up(octo, (3,))
    sent = carried(plan, asked - [octo.hover, 0.0, 0.0, 0.0], octo.hover, octo.hover)
    thrusts = sent.matrix @ asked
    assert (thrusts >= -1e-9).all()
    assert (thrusts <= 1.0).all()
    np.testing.assert_allclose(thrusts, plan.matrix[:, 0] * octo.hover, atol=1e-9)
    np.testing.assert_array_equal(sent.matrix[:, 1:], plan.matrix[:, 1:])
    for size in (1e6, np.inf, np.nan):
        with np.errstate(invalid="ignore", over="ignore"):
            assert carried(plan, size * rng.uniform(-1.0, 1.0, 4), octo.hover, octo.hover) is plan


def test_what_is_planned_around_a_part_lost_is_not_taken_off_again_and_again(octo: Vehicle) -> None:
    """Each new matrix of a loss that wobbled took the whole of it off once more."""
    flight = Flight(octo)
    flight.fly(3.0)
    seen = set()
    for k in range(1800):
        effectiveness = np.ones(octo.motors)
        effectiveness[2] = 0.5 + 0.04 * np.sign(np.sin(0.03 * k))
        residual = -octo.acceleration_effectiveness[:, 2] * 0.5 * octo.hover
        estimate = replace(hovering(octo, effectiveness), residual=residual)
        flight.time_s += DT_S
        flight.planning = flight.planner.step(flight.planning, flight.time_s, estimate)
        flight.state = flight.handover.step(flight.state, flight.time_s, DT_S, estimate, flight.planning, in_force=True)
        seen.add(id(flight.planning.plan))
        assert not flight.state.wrench.any()
    assert len(seen) > 5


@pytest.mark.parametrize("interrupted", [True, False])
def test_a_moment_without_telling_drops_nothing_and_a_long_one_all(octo: Vehicle, interrupted: bool) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(2.0, (3,))
    flight.declare(3)
    flight.fly(1.0, (3,))
    before = flight.given(asked_when_wound_up(octo, (3,)))
    if interrupted:
        flight.state = flight.handover.interrupted(flight.state)
        flight.planning = flight.planner.interrupted(flight.planning)
    flight.fly(0.3, (3,), in_force=False)
    flight.fly(DT_S, (3,))
    np.testing.assert_allclose(flight.given(asked_when_wound_up(octo, (3,))), before, atol=0.02)
    flight.fly(0.6, (3,), in_force=False)
    assert flight.state.base is None
    assert not flight.state.wrench.any()


def test_a_clock_that_is_set_back_does_not_hold_what_is_let_go(octo: Vehicle) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(2.0, (3,))
    flight.declare(3)
    flight.fly(0.5, (3,))
    flight.time_s -= 3.0
    flight.fly(8.0 * Tuning().handover.let_go_s, (3,))
    assert flight.state.plan is None


def test_of_one_of_two_it_is_what_is_right_for_both(coax: Vehicle) -> None:
    """Half of what the two have given: the same for either, but about yaw."""
    flight, pair = Flight(coax), mates_of_first(coax)
    flight.fly(3.0)
    flight.fly(2.0, (1,))
    thrust, believed = np.full(coax.motors, coax.hover), np.ones(coax.motors)
    believed[list(pair)] = 0.5
    lacking = coax.acceleration_effectiveness @ (thrust * (believed - np.where(np.arange(coax.motors) == 0, 0.0, 1.0)))
    for _ in range(2):
        estimate = replace(hovering(coax), residual=-lacking, either=pair)
        flight.time_s += DT_S
        flight.planning = flight.planner.step(flight.planning, flight.time_s, estimate)
        flight.state = flight.handover.step(flight.state, flight.time_s, DT_S, estimate, flight.planning, in_force=True)
    expected = coax.effectiveness[:, list(pair)].mean(axis=1) * coax.hover
    np.testing.assert_allclose(flight.state.wrench[1:3], expected[1:3], atol=0.02)
    assert flight.state.wrench[THRUST] == 0.0


def mates_of_first(vehicle: Vehicle) -> tuple[int, int]:
    """Indices of motor 1 and the one above or below it."""
    apart = np.linalg.norm(vehicle.position_m - vehicle.position_m[0], axis=1)
    apart[0] = np.inf
    return 0, int(apart.argmin())


def test_without_a_solution_the_matrix_is_sent_as_it_is(octo: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    flight.fly(2.0, (3,))
    flight.declare(3)

    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("no convergence")

    estimate = flight.estimate((3,))
    flight.planning = flight.planner.step(flight.planning, flight.time_s + DT_S, estimate)
    monkeypatch.setattr(np.linalg, "lstsq", fails)
    flight.state = flight.handover.step(
        flight.state, flight.time_s + DT_S, DT_S, estimate, flight.planning, in_force=True
    )
    assert not flight.state.wrench.any()
    assert flight.sent is flight.planning.plan


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_not_kept(octo: Vehicle, bad: float) -> None:
    flight = Flight(octo)
    flight.fly(3.0)
    estimate = replace(hovering(octo), residual=np.full(octo.axes, bad))
    before = flight.state
    flight.state = flight.handover.step(before, flight.time_s + DT_S, DT_S, estimate, flight.planning, in_force=True)
    np.testing.assert_array_equal(flight.state.lag, before.lag)
    assert np.isfinite(flight.state.wrench).all()
