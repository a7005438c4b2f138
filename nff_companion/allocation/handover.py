"""Giving a matrix over to an autopilot whose integrators have found the trim of a failed motor by themselves.

What a dead motor does not give, the autopilot's rate and height loops make up for within a second: they ask for more.
Another matrix gives all that is asked for, and so throws the vehicle the other way. So the wrench that is asked for on
the dead motors' account is taken off again, through the column of thrust, and let go at the pace at which integrators
follow. How much it is, is what those motors have lacked until now, through the integrators' lag: of a motor that is
declared within a tenth of a second it is nothing.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.allocation.plan import Plan, carried
from nff_companion.allocation.planner import PlannerState
from nff_companion.condition import read_only
from nff_companion.core.estimate import Estimate
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import THRUST, Vehicle


class HandoverState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``lag`` (2, n) what the motors lack, m/s^2 and rad/s^2, once and twice through the integrators' lag, for
    ``heard_s``; ``base`` the plan in force, None: the autopilot's own, or none of ours; ``wrench`` (n,) that was taken
    off at ``begun_s``; ``plan`` with what of it is left, made at ``made_s``; None: ``base`` as it is."""

    lag: NDArray[np.float64]
    heard_s: float = 0.0
    base: Plan | None = None
    wrench: NDArray[np.float64]
    begun_s: float = -math.inf
    plan: Plan | None = None
    made_s: float = -math.inf


class Handover:
    """Constants of one vehicle."""

    def __init__(self, vehicle: Vehicle, tuning: Tuning) -> None:
        self._vehicle, self._tuning, self._planner = vehicle, tuning.handover, tuning.planner
        self._accelerations, self._nominal = vehicle.acceleration_effectiveness, vehicle.effectiveness

    def start(self) -> HandoverState:
        """Nothing heard."""
        n = self._vehicle.axes
        return HandoverState(lag=np.zeros((2, n)), wrench=read_only(np.zeros(n)))

    def step(
        self,
        state: HandoverState,
        time_s: float,
        dt_s: float,
        estimate: Estimate,
        planning: PlannerState,
        *,
        in_force: bool,
    ) -> HandoverState:
        """One sample; ``in_force``: the autopilot mixes by our plans, where there is one."""
        state = self._heard(state, dt_s, estimate)
        base = planning.plan if in_force and not planning.probing else None
        if base is None:
            return state if state.base is None else replace(state, base=None, plan=None, begun_s=-math.inf)
        if base is not state.base:
            return self._made(self._taken_off(state, base, time_s, estimate, planning), base, time_s, estimate)
        if state.plan is not None and not 0.0 <= time_s - state.made_s < self._tuning.refresh_s:
            return self._made(state, base, time_s, estimate)
        return state

    def _heard(self, state: HandoverState, dt_s: float, estimate: Estimate) -> HandoverState:
        lacking = -estimate.residual
        if True in estimate.failed.tolist():  # which the residual leaves out
            lacking = lacking + self._accelerations @ (estimate.thrust_shown * estimate.failed)
        if not math.isfinite(float(lacking.sum())):
            return state  # it would stay for the whole flight
        share = -math.expm1(-dt_s / self._tuning.wind_up_s)
        first = state.lag[0] + share * (lacking - state.lag[0])
        second = state.lag[1] + share * (first - state.lag[1])
        return replace(state, lag=np.array((first, second)), heard_s=state.heard_s + dt_s)

    def _left(self, state: HandoverState, time_s: float) -> NDArray[np.float64]:
        """(n,) of the wrench that was taken off."""
        return np.asarray(state.wrench * math.exp(-max(time_s - state.begun_s, 0.0) / self._tuning.let_go_s))

    def _taken_off(
        self, state: HandoverState, base: Plan, time_s: float, estimate: Estimate, planning: PlannerState
    ) -> HandoverState:
        """With what is asked for on account of the motors that ``base`` no longer counts on."""
        lost = np.flatnonzero(planning.planned_for < 1.0)
        heard = state.heard_s / self._tuning.wind_up_s
        # What came before the first sample is taken to have been as it was then.
        known = 1.0 if math.isinf(heard) else 1.0 - math.exp(-heard) * (1.0 + heard)
        lag = state.lag[1] / max(known, self._tuning.known_min)
        columns = self._accelerations[:, lost]
        scale = np.linalg.norm(self._accelerations, axis=1)
        share = np.linalg.lstsq(columns / scale[:, None], lag / scale, rcond=None)[0]
        most = estimate.thrust_shown[lost] * (1.0 - np.nan_to_num(planning.planned_for[lost]))
        wrench = self._left(state, time_s) + self._nominal[:, lost] @ np.clip(share, 0.0, np.maximum(most, 0.0))
        # From here on the dead lack nothing that is asked of them.
        return replace(
            state,
            base=base,
            wrench=read_only(wrench),
            begun_s=time_s,
            lag=np.zeros_like(state.lag),
            heard_s=math.inf,
        )

    def _made(self, state: HandoverState, base: Plan, time_s: float, estimate: Estimate) -> HandoverState:
        """With the plan for what is left of the wrench."""
        left = self._left(state, time_s)
        if float(np.abs(left).max()) < self._tuning.least:
            return replace(state, plan=None)
        given = float(base.effectiveness[THRUST] @ estimate.thrust_shown) + float(left[THRUST])
        thrust = max(given, 0.5 * self._vehicle.hover)
        plan = carried(base, left, thrust, self._vehicle.hover, self._planner)
        return replace(state, plan=plan, made_s=time_s)
