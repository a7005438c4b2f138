"""When to solve the allocation again, for which effectiveness, and what to keep where no new matrix may be used."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.allocation import Allocator, allocator
from nff_companion.allocation.partial import Partial, PartialState
from nff_companion.allocation.plan import Plan, Refusal, make_plan, moved
from nff_companion.allocation.probe import Prober, ProbeState
from nff_companion.core import sparse
from nff_companion.core.estimate import Estimate
from nff_companion.core.mates import HALF
from nff_companion.core.tuning import PlannerTuning
from nff_companion.core.vehicle import THRUST, Vehicle


class PlannerState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``plan``: the matrix that should be in force, None: the autopilot's own. Times of the autopilot's clock."""

    planned_for: NDArray[np.float64]  # (m,) effectiveness; NaN: not yet solved
    partial: PartialState  # losses in part that are allocated around
    plan: Plan | None = None
    refusal: Refusal | None = None
    rejected: int = 0
    planned_s: float = -np.inf
    caught_s: float = -np.inf
    declared_s: float = -np.inf
    catching: bool = False
    untouched: bool = True  # all motors healthy, the autopilot's own allocation in force
    probe: ProbeState = ProbeState()
    settled: Plan | None = None  # the plan without the test that runs

    @property
    def degraded(self) -> NDArray[np.bool_]:
        """(m,) bool: allocated around; NaN, not yet planned, is not."""
        return self.planned_for < 1.0

    @property
    def probing(self) -> bool:
        """Motors are being moved to tell which of them are lost."""
        return self.probe.move is not None


Target = Callable[[Estimate], NDArray[np.float64]]


class Planner:
    """Constants of one vehicle. ``target``: another rule for what to allocate for, of research; None: ours."""

    def __init__(
        self,
        vehicle: Vehicle,
        allocate: Allocator,
        tuning: PlannerTuning | None = None,
        target: Target | None = None,
        prober: Prober | None = None,
    ) -> None:
        """``prober`` None: what cannot be told apart is not tested."""
        self._vehicle, self._allocate, self._tuning = vehicle, allocate, tuning or PlannerTuning()
        self._prober, self._partial = prober, Partial(self._tuning)
        self._given_target = target
        whole = np.ones(vehicle.motors)
        healthy = make_plan(allocate, vehicle.effectiveness, whole, vehicle.hover, tuning=self._tuning)
        self.healthy = healthy if isinstance(healthy, Plan) else None
        # About what the autopilots' own mixers do: a test then moves nothing but what it means to.
        stock = make_plan(allocator("pinv"), vehicle.effectiveness, whole, vehicle.hover, tuning=self._tuning)
        self._stock = stock if isinstance(stock, Plan) else None

    def start(self) -> PlannerState:
        """All motors healthy."""
        m = self._vehicle.motors
        return PlannerState(planned_for=np.ones(m), partial=PartialState.start(m))

    def interrupted(self, state: PlannerState) -> PlannerState:
        """Telemetry was interrupted: the plan stays, its times do not."""
        start = self.start()
        return replace(
            start,
            planned_for=state.planned_for,
            partial=state.partial.interrupted(),
            plan=state.settled if state.probing else state.plan,
            refusal=state.refusal,
            rejected=state.rejected,
            untouched=state.untouched,
        )

    def forgotten(self, state: PlannerState) -> PlannerState:
        """The next flight starts with all motors."""
        start = self.start()
        return replace(
            state,
            plan=None,
            settled=None,
            probe=ProbeState(),
            refusal=None,
            planned_for=start.planned_for,
            partial=start.partial,
        )

    def step(
        self,
        state: PlannerState,
        time_s: float,
        estimate: Estimate,
        *,
        trust_partial: bool = True,
        driven: bool = False,
        tests: bool = True,
    ) -> PlannerState:
        """Solve the allocation again when what is believed of the motors has moved; ``trust_partial`` False: what
        begins to look like a partial loss may be an error of the model. ``driven``: the outputs are ours, by
        ``healthy`` where no plan is in force; else the autopilot mixes. ``tests``: what is planned is put in force."""
        o = self._tuning
        if self._prober is not None and (estimate.among or state.probing):
            # Nothing is done about a guess. But what was ordered is, and one of two above each other; and what is left
            # to be done of what was declared.
            caught = state.catching and time_s >= state.caught_s
            settled = not estimate.either and not caught and _planned(state, estimate)
            asked = settled and tests and not estimate.more and state.refusal is None
            mixed = self.healthy if driven else self._stock
            state = self._probed(self._prober, mixed, state, time_s, estimate, asked=asked)
            if estimate.among and settled:
                return state
        full_at = o.shape_full_at if self._given_target is None else 1.0
        clear = float(estimate.effectiveness.min()) >= full_at and not estimate.failed.any() and not estimate.either
        clear = clear and not state.partial.any
        if clear and state.untouched:
            return state
        partial, target = self._target(state, time_s, estimate, trust_partial)
        change = float(np.nan_to_num(np.abs(target - state.planned_for), nan=1.0).max())
        declared_s, caught_s = state.declared_s, state.caught_s
        if estimate.events:
            declared = sum(event.declared for event in estimate.events)
            if declared and (declared > 1 or time_s - declared_s < o.double_within_s):
                caught_s = time_s + o.catch_s
            declared_s = time_s if declared else -np.inf
        catching = time_s < caught_s
        begun = any(state.planned_for[motor] == 1.0 for motor in estimate.either)
        ended = change > 0.0 and float(target.min()) == 1.0
        at_once = bool(estimate.events) or begun or ended or (state.catching and not catching)
        state = replace(
            state,
            partial=partial,
            declared_s=declared_s,
            caught_s=caught_s,
            catching=catching,
            untouched=clear,
        )
        if not at_once and (change < o.resolve_change or time_s - state.planned_s < o.resolve_interval_s):
            return replace(state, untouched=clear and change == 0.0)
        return self._solved(replace(state, planned_s=time_s, planned_for=target), target, estimate)

    def _probed(
        self,
        prober: Prober,
        mixed: Plan | None,
        state: PlannerState,
        time_s: float,
        estimate: Estimate,
        *,
        asked: bool,
    ) -> PlannerState:
        """With the test of which motors are lost that is due, on what is in force without it: a plan, or ``mixed``;
        ``asked`` False: without any."""
        settled = state.settled if state.probing else state.plan
        mixed = settled or mixed
        if mixed is None:
            return state
        effectiveness = np.nan_to_num(state.planned_for, nan=1.0)
        try:
            probe = prober.step(state.probe, time_s, estimate, effectiveness, asked=asked)
        except np.linalg.LinAlgError:  # no movement could be found: a test is never worth a step
            ended = prober.refused(state.probe, time_s)
            return replace(state, probe=ended, plan=settled, settled=None, rejected=state.rejected + 1)
        if probe is state.probe:
            return state
        if probe.move is None:
            return replace(state, probe=probe, plan=settled, settled=None)
        hover = self._vehicle.hover
        thrust = max(float(mixed.effectiveness[THRUST].dot(estimate.thrust_shown)), 0.5 * hover)
        plan, back = (
            moved(mixed, sign * probe.move, thrust, hover, self._tuning) for sign in (probe.sign, -probe.sign)
        )
        if isinstance(plan, Refusal) or isinstance(back, Refusal):  # forth without back would turn the vehicle
            ended = prober.refused(probe, time_s)
            return replace(state, probe=ended, plan=settled, settled=None, rejected=state.rejected + 1)
        return replace(state, probe=probe, plan=plan, settled=settled, untouched=False)

    def _solved(self, state: PlannerState, target: NDArray[np.float64], estimate: Estimate) -> PlannerState:
        """With the matrix for ``target`` (m,), or the reason that there is none."""
        if (target == 1.0).all():
            return replace(state, plan=None, refusal=None)
        nominal, hover = self._vehicle.effectiveness, self._vehicle.hover
        both = bool((target[list(estimate.either)] == HALF).all())
        plan = make_plan(
            self._allocate,
            nominal,
            target,
            hover,
            alike=estimate.either if both else (),
            catching=state.catching,
            tuning=self._tuning,
        )
        if isinstance(plan, Plan):
            return replace(state, plan=plan, refusal=None, untouched=False)
        kept = state.plan
        if kept is not None and kept.matrix[estimate.failed].any():
            kept = None  # it drives a motor that is dead: the autopilot's own reduced mixing is better
        again = np.full_like(target, np.nan)  # tried after the interval
        return replace(state, plan=kept, refusal=plan, rejected=state.rejected + 1, planned_for=again, untouched=False)

    def _target(
        self, state: PlannerState, time_s: float, estimate: Estimate, trust_partial: bool
    ) -> tuple[PartialState, NDArray[np.float64]]:
        """Losses in part, and the effectiveness (m,) to allocate for: declared motors gone, a lasting partial loss
        shaped, the rest whole."""
        o = self._tuning
        if self._given_target is not None:
            return state.partial, self._given_target(estimate)
        partial = self._partial.step(state.partial, time_s, estimate, trusted=trust_partial)
        target = np.ones(self._vehicle.motors)
        if partial.any:
            shaped = sparse.shape(partial.held, o.shape_full_at, o.shape_none_below)
            target = np.where(partial.held < 1.0, np.maximum(shaped, o.partial_min), target)
        target[list(estimate.either)] = HALF
        target[estimate.failed] = 0.0
        return partial, target


def _planned(state: PlannerState, estimate: Estimate) -> bool:
    """Whether what was planned is for the motors that are declared."""
    return bool(((state.planned_for == 0.0) == estimate.failed).all() and not np.isnan(state.planned_for).any())
