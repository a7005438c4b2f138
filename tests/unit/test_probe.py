"""Motors moved to tell which of them are lost: nothing that a whole vehicle feels, bounded, and never for long."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from estimates import hovering
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.allocation import allocator
from nff_companion.allocation.planner import Planner, PlannerState
from nff_companion.allocation.probe import Prober, ProbeState
from nff_companion.autopilots import times
from nff_companion.autopilots.schedule import Declare, Load, ScheduleState, steps
from nff_companion.companion import Companion
from nff_companion.condition import Condition, Mode
from nff_companion.core import vehicle as vehicles
from nff_companion.core.decision import Event
from nff_companion.core.estimate import Estimate
from nff_companion.core.mates import HALF
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import PITCH, ROLL, Vehicle
from nff_companion.outcome import Outcome

TUNING = Tuning()
PROBE = TUNING.probe
OPPOSITE = ((0, 1), (6, 7))  # of an octorotor X of ArduPilot
VARIANCE = np.array([0.37, 1.07, 1.07, 0.1]) ** 2
DT_S = 0.005


def seen(vehicle: Vehicle, among: tuple[tuple[int, ...], ...], failed: tuple[int, ...] = ()) -> Estimate:
    return hovering(vehicle, failed=failed, among=among, variance=VARIANCE)


def full(motors: int, *sets: tuple[int, ...]) -> list[NDArray[np.float64]]:
    return [np.isin(np.arange(motors), chosen).astype(float) for chosen in sets]


def largest_angle(vehicle: Vehicle) -> float:
    """To which a movement of 1 rad/s^2 turns a vehicle whose motors lag, in rad."""
    acceleration = rate = angle = largest = 0.0
    step_s = 1e-4
    for k in range(round(8.0 * PROBE.part_s / step_s)):
        part = int(k * step_s / PROBE.part_s)
        asked = (1.0, -1.0, -1.0, 1.0)[part] if part < 4 else 0.0
        acceleration += step_s / vehicle.lag_s[0] * (asked - acceleration)
        rate += step_s * acceleration
        angle += step_s * rate
        largest = max(largest, abs(angle))
    return largest


@pytest.mark.parametrize("name", vehicles.names())
def test_a_whole_vehicle_feels_nothing_and_every_bound_holds(name: str, rng: np.random.Generator) -> None:
    vehicle = vehicles.load(name)
    prober, m = Prober(vehicle, TUNING), vehicle.motors
    pairs = list(combinations(range(m), 2))
    matrix, moved, angle = vehicle.acceleration_effectiveness, 0, largest_angle(vehicle)
    for _ in range(200):
        chosen = rng.choice(len(pairs), size=int(rng.integers(2, 5)), replace=False)
        losses = [rng.uniform(0.4, 1.0) * loss for loss in full(m, *(pairs[k] for k in chosen))]
        effectiveness, thrust = np.ones(m), rng.uniform(0.1, 0.95, m)
        if rng.random() < 0.3:
            effectiveness[int(rng.integers(m))] = 0.0
        move = prober.movement(losses, thrust, rng.uniform(0.3, 3.0, vehicle.axes) * VARIANCE, effectiveness)
        if move is None:
            continue
        moved += 1
        assert np.abs(matrix.dot(move)).max() < 1e-9 * np.abs(matrix).max()
        assert (move[effectiveness == 0.0] == 0.0).all()
        assert np.abs(move).max() <= PROBE.thrust_max + 1e-12
        used = np.abs(move) > 1e-6 * np.abs(move).max()
        for sign in (1.0, -1.0):
            after = (thrust + sign * move)[used]
            assert after.min() >= PROBE.thrust_left - 1e-9
            assert after.max() <= 1.0 - PROBE.thrust_left + 1e-9
        for loss in losses:
            turned = np.linalg.norm((matrix * effectiveness * loss).dot(move)[ROLL : PITCH + 1])
            assert math.degrees(turned * angle) <= 1.01 * PROBE.tilt_max_deg
    assert moved or m <= vehicle.axes + 2  # a hexarotor has two ways to move, of which a pair may share both


def test_what_is_felt_is_another_thing_by_each_explanation(octo: Vehicle) -> None:
    losses = full(octo.motors, *OPPOSITE)
    move = Prober(octo, TUNING).movement(losses, np.full(octo.motors, octo.hover), VARIANCE, np.ones(octo.motors))
    assert move is not None
    one, other = (-(octo.acceleration_effectiveness * loss).dot(move) for loss in losses)
    apart = (one - other) / np.sqrt(VARIANCE)
    assert np.linalg.norm(apart) > 3.0
    # The same motors in another order, and quieter air: no more than is asked for.
    quiet = Prober(octo, TUNING).movement(
        losses, np.full(octo.motors, octo.hover), 1e-4 * VARIANCE, np.ones(octo.motors)
    )
    assert quiet is not None
    assert np.abs(quiet).max() < 0.1 * np.abs(move).max()


@pytest.mark.parametrize(
    ("sets", "changes"),
    [
        ((OPPOSITE[0],), {}),  # nothing to tell apart
        ((OPPOSITE[0], OPPOSITE[0]), {}),  # the same
        (OPPOSITE, {"thrust_max": 0.0}),  # not wanted
    ],
)
def test_nothing_is_moved_where_it_would_say_nothing_or_is_not_wanted(
    octo: Vehicle, sets: tuple[tuple[int, ...], ...], changes: dict[str, float]
) -> None:
    prober = Prober(octo, TUNING.having("probe", **changes))
    thrust = np.full(octo.motors, octo.hover)
    assert prober.movement(full(octo.motors, *sets), thrust, VARIANCE, np.ones(octo.motors)) is None


def test_a_saturated_motor_is_left_alone_and_the_test_made_later(octo: Vehicle) -> None:
    prober, estimate = Prober(octo, TUNING), seen(octo, OPPOSITE)
    estimate.thrust_shown = np.full(octo.motors, 0.99)
    state = prober.step(ProbeState(), 10.0, estimate, np.ones(octo.motors))
    assert state.move is None
    estimate.thrust_shown = np.full(octo.motors, octo.hover)
    later_s = 10.0 + 4.0 * PROBE.part_s
    assert prober.step(state, later_s - DT_S, estimate, np.ones(octo.motors)).move is None
    assert prober.step(state, later_s, estimate, np.ones(octo.motors)).move is not None


def test_rate_and_attitude_are_what_they_were_after_a_test(octo: Vehicle) -> None:
    prober, estimate, state = Prober(octo, TUNING), seen(octo, OPPOSITE), ProbeState()
    rate = angle = most = 0.0
    for k in range(round(4.0 * PROBE.part_s / DT_S)):
        state = prober.step(state, DT_S * k, estimate, np.ones(octo.motors))
        assert state.tests == 1
        angle += DT_S * rate + 0.5 * DT_S**2 * state.sign
        rate += DT_S * state.sign
        most = max(most, abs(angle))
    assert (rate, angle) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert most == pytest.approx(PROBE.part_s**2, rel=0.01)


def test_it_ends_when_the_set_does_and_rests_after_some_in_a_row(octo: Vehicle) -> None:
    prober, whole = Prober(octo, TUNING), np.ones(octo.motors)
    state = prober.step(ProbeState(), 0.0, seen(octo, OPPOSITE), whole)
    assert state.move is not None
    assert prober.step(state, DT_S, seen(octo, ()), whole).move is None
    begun, state, end_s = list[float](), ProbeState(), 3.0 * PROBE.rest_s
    for k in range(round(end_s / DT_S)):
        before, state = state, prober.step(state, DT_S * k, seen(octo, OPPOSITE), whole)
        if state.begun_s != before.begun_s:
            begun.append(DT_S * k)
    gaps = np.diff(begun)
    row = 4.0 * PROBE.part_s
    assert set(np.round(gaps, 3)) == {round(row, 3), round(row + PROBE.rest_s, 3)}
    assert np.flatnonzero(gaps > PROBE.rest_s)[0] == PROBE.tests_max - 1
    assert np.diff(np.flatnonzero(gaps > PROBE.rest_s)).tolist()[:1] in ([], [PROBE.tests_max])


def flown(planner: Planner, octo: Vehicle, seconds: float, estimate: Estimate) -> list[PlannerState]:
    states = [planner.start()]
    for k in range(round(seconds / DT_S)):
        states.append(planner.step(states[-1], DT_S * k, estimate))
    return states[1:]


def test_the_matrix_of_a_test_is_checked_and_goes_when_the_test_ends(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    states = flown(planner, octo, 0.2, seen(octo, OPPOSITE))
    plans = {id(state.plan): state.plan for state in states}
    assert len(plans) == 3  # forth, back, forth: a new one only when the sign changes, each sent at once
    for plan in plans.values():
        assert plan is not None
        assert np.allclose(octo.effectiveness @ plan.matrix, np.eye(octo.axes), atol=1e-9)
        assert not plan.matrix.flags.writeable
    assert states[-1].probing
    assert not states[-1].degraded.any()
    over = planner.step(states[-1], 0.2, seen(octo, ()))
    assert (over.plan, over.probing) == (None, False)
    interrupted = planner.interrupted(states[-1])
    assert (interrupted.plan, interrupted.probing) == (None, False)
    forgotten = planner.forgotten(states[-1])
    assert (forgotten.plan, forgotten.probing, forgotten.settled) == (None, False, None)


@pytest.mark.parametrize(
    ("mode", "takes_matrix", "tested"),
    [
        (Mode.ALLOCATE, True, True),
        (Mode.OVERRIDE, True, True),
        (Mode.ALLOCATE, False, False),
        (Mode.OBSERVE, True, False),
    ],
)
def test_a_test_is_sent_where_a_matrix_is_taken_and_we_may_act(
    octo: Vehicle, mode: Mode, takes_matrix: bool, tested: bool
) -> None:
    planner, estimate = Planner(octo, allocator("trim"), prober=Prober(octo, TUNING)), seen(octo, OPPOSITE)
    planning = planner.step(planner.start(), 0.0, estimate)
    state = replace(Companion(octo, 200.0).start(mode), planning=planning, trouble=None)
    condition = Condition(armed=True, takes_matrix=takes_matrix)
    output = Outcome(octo.motors, octo.axes).output(state, condition, 0.0, estimate, None, ())
    assert output.probing == tested
    _, commands = steps(ScheduleState.start(octo.motors), output, condition, 0.0)
    loaded = [(command.plan, command.timeout_s) for command in commands if isinstance(command, Load)]
    assert loaded == ([(planning.plan, times.PROBE_TIMEOUT_S)] if tested else [])
    assert not any(isinstance(command, Declare) for command in commands)


def test_what_was_allocated_for_an_earlier_failure_stays_under_and_after_a_test(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    lost = seen(octo, (), failed=(2,))
    state = planner.step(planner.start(), 0.0, lost)
    settled = state.plan
    assert settled is not None
    state = planner.step(state, DT_S, seen(octo, OPPOSITE, failed=(2,)))
    assert state.probing
    assert state.plan is not None
    assert state.plan is not settled
    assert (state.plan.matrix[2] == 0.0).all()
    assert (planner.interrupted(state).plan, planner.step(state, 2 * DT_S, lost).plan) == (settled, settled)


def test_a_motor_lifted_in_a_test_is_allocated_again(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    state = planner.step(planner.start(), 0.0, seen(octo, (), failed=(2,)))
    state = planner.step(state, DT_S, seen(octo, OPPOSITE, failed=(2,)))
    for k in range(200):
        state = planner.step(state, 1.0 + DT_S * k, seen(octo, OPPOSITE if k < 100 else ()))
        assert (state.planned_for == 1.0).all()
        assert state.plan is None or state.plan.matrix[2].any()
    assert state.plan is None


def test_a_test_is_made_while_a_double_failure_is_caught_and_the_catch_ends_in_its_time(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    both = seen(octo, (), failed=(2, 5))
    both.events = [Event(0.0, motor, True, 0.0, 1.0) for motor in (3, 6)]
    state = planner.step(planner.start(), 0.0, both)
    assert state.catching
    tested = set()
    for k in range(1, round(1.5 * TUNING.planner.catch_s / DT_S)):
        state = planner.step(state, DT_S * k, seen(octo, OPPOSITE, failed=(2, 5)))
        tested.add(state.probing)
        assert state.catching == (DT_S * k < TUNING.planner.catch_s)
    assert tested == {True, False}


def test_a_motor_taken_back_is_no_double_failure(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    declared, lifted = seen(octo, (), failed=(6,)), seen(octo, ())
    declared.events, lifted.events = [Event(0.0, 7, True, 0.0, 1.0)], [Event(0.07, 7, False, 1.0, 1.0)]
    state = planner.step(planner.step(planner.start(), 0.0, declared), 0.07, lifted)
    assert (state.plan, state.catching) == (None, False)
    assert planner.step(state, 0.2, seen(octo, OPPOSITE)).probing


def test_a_solver_that_fails_costs_the_test_and_not_the_step(octo: Vehicle, monkeypatch: pytest.MonkeyPatch) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))

    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(np.linalg, "svd", fails)
    states = flown(planner, octo, 1.0, seen(octo, OPPOSITE))
    assert not any(state.probing or state.plan for state in states)
    assert states[-1].rejected == 1  # and not tried again at each sample


def coax_either(coax: Vehicle) -> Estimate:
    estimate = seen(coax, ((0, 1), (2, 3)))
    estimate.either = (0, 5)
    estimate.effectiveness = np.where(np.isin(np.arange(8), (0, 5)), HALF, 1.0)
    return estimate


def test_one_of_two_above_each_other_is_allocated_around_at_once_and_nothing_is_tested() -> None:
    coax = vehicles.load("coax-x8")
    planner = Planner(coax, allocator("trim"), TUNING.planner, prober=Prober(coax, TUNING))
    state = planner.step(planner.start(), 0.0, coax_either(coax))
    assert state.planned_for.tolist() == [HALF if motor in (0, 5) else 1.0 for motor in range(8)]
    assert state.plan is not None
    assert not any(planner.step(state, DT_S * k, coax_either(coax)).probing for k in range(1, 300))


def test_nothing_is_tested_beside_a_motor_that_pulls_more(octo: Vehicle) -> None:
    estimate = seen(octo, OPPOSITE)
    estimate.more = (3,)
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    assert not any(state.probing for state in flown(planner, octo, 1.0, estimate))


def test_where_there_is_no_plan_for_what_is_declared_nothing_is_tested() -> None:
    coax, dead = vehicles.load("coax-x8"), (0, 5)  # both of an arm: no matrix carries that
    planner = Planner(coax, allocator("trim"), TUNING.planner, prober=Prober(coax, TUNING))
    state = planner.step(planner.start(), 0.0, seen(coax, (), failed=dead))
    assert state.refusal is not None
    for k in range(1, 300):
        state = planner.step(state, DT_S * k, seen(coax, ((1, 2), (3, 4)), failed=dead))
        assert (state.plan, state.probing) == (None, False)


def test_a_test_is_made_forth_and_back_or_not_at_all() -> None:
    """Where hovering takes much of the thrust one way may be out of bounds and the other not."""
    px4 = vehicles.load("px4-octo-x")
    planner = Planner(px4, allocator("trim"), TUNING.planner, prober=Prober(px4, TUNING))
    state = planner.step(planner.start(), 0.0, seen(px4, (), failed=(0,)))
    signs: dict[float, list[float]] = {}
    for k in range(1, 2400):
        estimate = seen(px4, ((1, 2), (1, 3)), failed=(0,))
        state = planner.step(state, DT_S * k, estimate)
        if state.probing:
            signs.setdefault(state.probe.begun_s, []).append(state.probe.sign)
    whole = [sum(test) for test in list(signs.values())[:-1]]
    assert all(abs(balance) <= 1.0 for balance in whole)
    assert state.rejected <= 4


def test_a_test_that_is_not_in_force_is_not_begun_and_not_joined(octo: Vehicle) -> None:
    planner = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    state = planner.start()
    for k in range(400):  # observing
        state = planner.step(state, DT_S * k, seen(octo, OPPOSITE), tests=False)
        assert not state.probing
    state = planner.step(state, 2.0, seen(octo, OPPOSITE))
    assert (state.probing, state.probe.sign, state.probe.tests) == (True, 1.0, 1)
    state = planner.step(state, 2.1, seen(octo, OPPOSITE), tests=False)
    assert (state.probing, state.plan) == (False, None)


def test_a_matrix_that_does_not_pass_the_check_is_not_sent(octo: Vehicle) -> None:
    """The gain that is allowed is between that of the autopilot's own mixing and that of the test."""
    whole = Planner(octo, allocator("trim"), TUNING.planner, prober=Prober(octo, TUNING))
    plan = whole.step(whole.start(), 0.0, seen(octo, OPPOSITE)).plan
    assert plan is not None
    tight = replace(TUNING.planner, gain_max=0.999 * float(np.abs(plan.matrix).max()))
    planner = Planner(octo, allocator("trim"), tight, prober=Prober(octo, TUNING))
    state = planner.step(planner.start(), 0.0, seen(octo, OPPOSITE))
    assert (state.plan, state.probing, state.rejected) == (None, False, 1)
    assert planner.step(state, DT_S, seen(octo, OPPOSITE)).rejected == 1  # not at every sample
