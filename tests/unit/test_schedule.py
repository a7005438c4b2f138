"""What is told, and when: pure, the same for every autopilot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from stepping import Stepped

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, make_plan
from nff_companion.autopilots import schedule, times
from nff_companion.autopilots.schedule import Command, Declare, Load, Release, ScheduleState
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, InForce, Mode, Source
from nff_companion.core.vehicle import Vehicle

NOBODY = InForce(failed=np.zeros(8, bool))


@pytest.fixture
def plan(octo: Vehicle) -> Plan:
    found = make_plan(allocator("trim"), octo.effectiveness, np.r_[1.0, 1.0, 0.0, np.ones(5)], octo.hover)
    assert isinstance(found, Plan)
    return found


def output(failed: list[int], plan: Plan | None = None, mode: Mode = Mode.ALLOCATE, **change: Any) -> Output:
    mask = np.zeros(8, bool)
    mask[[m - 1 for m in failed]] = True
    return replace(Stepped().state.last, mode=mode, failed=mask, plan=plan, flying=True, **change)


def told(
    state: ScheduleState, out: Output, condition: Condition, start: float, cycles: int
) -> tuple[ScheduleState, list[tuple[int, Command]]]:
    """Commands with the cycle in which they come, at 200 Hz."""
    commands: list[tuple[int, Command]] = []
    for k in range(cycles):
        state, new = schedule.steps(state, out, condition, start + 0.005 * k)
        commands += [(k, command) for command in new]
    return state, commands


def declared(commands: list[tuple[int, Command]]) -> list[Declare]:
    """The declarations; there must be nothing else."""
    found = [command for _, command in commands if isinstance(command, Declare)]
    assert len(found) == len(commands)
    return found


def test_a_declaration_is_repeated_until_confirmed_and_the_matrix_streams(plan: Plan) -> None:
    out = output([3], plan)
    state, before = told(ScheduleState.start(8), out, Condition(takes_matrix=True, in_force=NOBODY), 10.0, 40)
    confirmed = Condition(takes_matrix=True, in_force=InForce(Source.MATRIX, out.failed))
    _, after = told(state, out, confirmed, 10.2, 40)
    declared = [k for k, command in before if isinstance(command, Declare)]
    assert declared == [0, 10, 20, 30]
    assert not [k for k, command in after if isinstance(command, Declare)]
    streamed = [k for k, command in before if isinstance(command, Load)]
    streamed += [40 + k for k, command in after if isinstance(command, Load)]
    assert streamed[0] == 0
    assert 0.005 * max(np.diff(streamed)) < 0.2 * times.MATRIX_TIMEOUT_S, "fresh well within its time-out"


def test_a_plan_that_is_gone_is_released_once(plan: Plan) -> None:
    condition = Condition(takes_matrix=True, in_force=NOBODY)
    state, _ = told(ScheduleState.start(8), output([], plan), condition, 10.0, 1)
    _, commands = told(state, output([]), condition, 10.005, 20)
    assert [type(command) for _, command in commands] == [Release]


def test_observe_tells_nothing_unless_the_operator_has_spoken(plan: Plan) -> None:
    condition = Condition(takes_matrix=True, in_force=InForce(Source.DECLARATION, np.eye(8, dtype=bool)[0]))
    state, commands = told(ScheduleState.start(8), output([1], None, Mode.OBSERVE), condition, 10.0, 100)
    assert commands == []
    state = schedule.lifted(state, [1], 11.0)
    out = output([], None, Mode.OBSERVE)
    state, commands = told(state, out, condition, 11.0, 30)
    assert [k for k, _ in commands] == [0, 10, 20]
    assert not declared(commands)[0].failed.any()
    _, commands = told(state, out, Condition(takes_matrix=True, in_force=NOBODY), 11.2, 30)
    assert commands == []


def test_a_lift_while_observing_adds_nothing_that_is_only_believed() -> None:
    """The autopilot holds motor 3; the companion believes 3 and 5: motor 5 goes on turning."""
    held = Condition(takes_matrix=True, in_force=InForce(Source.DECLARATION, np.eye(8, dtype=bool)[2]))
    state = schedule.lifted(ScheduleState.start(8), [3], 10.0)
    _, commands = told(state, output([5], None, Mode.OBSERVE), held, 10.0, 20)
    assert [command.failed.any() for command in declared(commands)] == [False, False]
    for nothing in (NOBODY, InForce()):
        _, commands = told(state, output([5], None, Mode.OBSERVE), Condition(in_force=nothing), 10.0, 20)
        assert commands == []


def test_a_lift_waits_while_it_is_not_known_what_the_autopilot_holds() -> None:
    """Nothing is heard of it for a while: the order is told when it is, unless it is old by then."""
    held = Condition(takes_matrix=True, in_force=InForce(Source.DECLARATION, np.eye(8, dtype=bool)[2]))
    unknown = Condition(takes_matrix=True)
    out = output([], None, Mode.OBSERVE)
    for waited_s, told_then in ((2.0, 1), (times.ORDER_MAX_S, 0)):
        state = schedule.lifted(ScheduleState.start(8), [3], 10.0)
        state, commands = told(state, out, unknown, 10.0, round(200 * waited_s))
        assert commands == []
        _, commands = told(state, out, held, 10.0 + waited_s, 5)
        assert len(declared(commands)) == told_then


def test_a_lift_that_could_not_be_told_is_not_told_much_later() -> None:
    held = Condition(takes_matrix=True, in_force=InForce(Source.DECLARATION, np.eye(8, dtype=bool)[2]))
    state = schedule.lifted(ScheduleState.start(8), [3], 10.0)
    _, commands = told(state, output([], None, Mode.OBSERVE), held, 10.0 + times.ORDER_MAX_S, 20)
    assert commands == []


def test_a_healthy_vehicle_that_holds_nobody_failed_is_told_nothing() -> None:
    _, commands = told(ScheduleState.start(8), output([]), Condition(takes_matrix=True, in_force=NOBODY), 10.0, 200)
    assert commands == []


def test_a_partial_loss_is_told_by_declaration_where_no_matrix_is_taken_and_not_often() -> None:
    condition = Condition(in_force=NOBODY)
    weak = np.r_[0.5, np.ones(7)]
    out = output([], degraded=weak < 1.0, effectiveness=weak)
    state, commands = told(ScheduleState.start(8), out, condition, 10.0, 300)
    assert [k for k, _ in commands] == [0]
    np.testing.assert_array_equal(declared(commands)[0].effectiveness, weak)
    weaker = output([], degraded=weak < 1.0, effectiveness=np.r_[0.3, np.ones(7)])
    _, commands = told(state, weaker, condition, 11.5, 300)
    assert len(commands) == 1


def test_how_long_something_has_not_been_confirmed(plan: Plan) -> None:
    condition = Condition(takes_matrix=True, in_force=NOBODY)
    state, _ = told(ScheduleState.start(8), output([3], plan), condition, 10.0, 60)
    assert state.unconfirmed_s(condition, 10.3) == pytest.approx(0.3)
    held = Condition(takes_matrix=True, in_force=InForce(Source.MATRIX, np.eye(8, dtype=bool)[2]))
    assert state.unconfirmed_s(held, 10.3) == 0.0
