"""Giving a matrix over to an autopilot whose integrators have found the trim of a failed motor by themselves.

What a dead motor does not turn, the autopilot's rate loops make up for within a second: they ask for more. Another
matrix gives all that is asked for, and so throws the vehicle the other way. So the torque that is asked for on the dead
motors' account is taken off again, through the column of thrust, and let go at the pace at which integrators follow.
How much it is, is what those motors have lacked until now, through the integrators' lag: of a motor that is declared
within a tenth of a second it is little.
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
from nff_companion.core.mates import HALF
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import THRUST, Vehicle


class HandoverState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``lag`` (2, n) what the motors lack of what the mixing in force counts on, m/s^2 and rad/s^2, once and twice
    through the integrators' lag, for ``heard_s``; ``base`` the plan in force, None: the autopilot's own mixing;
    ``counts`` (m,) on how much of each motor that counts; ``wrench`` (n,) that was taken off at ``begun_s``; ``plan``
    with what of it is left, made of ``made_of`` at ``made_s``; None: the plan as it is. ``away_s``: since when no plan
    of ours is told, NaN: one is."""

    lag: NDArray[np.float64]
    heard_s: float = 0.0
    base: Plan | None = None
    counts: NDArray[np.float64]
    wrench: NDArray[np.float64]
    begun_s: float = -math.inf
    plan: Plan | None = None
    made_of: Plan | None = None
    made_s: float = -math.inf
    away_s: float = math.nan

    def told(self, planned: Plan | None) -> Plan | None:
        """What to tell the autopilot where ``planned`` is the plan."""
        return planned if self.plan is None or self.made_of is not planned else self.plan


class Handover:
    """Constants of one vehicle."""

    def __init__(self, vehicle: Vehicle, tuning: Tuning) -> None:
        self._vehicle, self._tuning, self._planner = vehicle, tuning.handover, tuning.planner
        self._accelerations, self._nominal = vehicle.acceleration_effectiveness, vehicle.effectiveness
        self._scale = np.linalg.norm(self._accelerations, axis=1)
        self._ones = read_only(np.ones(vehicle.motors))

    def start(self) -> HandoverState:
        """Nothing heard."""
        n = self._vehicle.axes
        return HandoverState(lag=np.zeros((2, n)), counts=self._ones, wrench=read_only(np.zeros(n)))

    def interrupted(self, state: HandoverState) -> HandoverState:
        """Telemetry was interrupted: what the autopilot mixes by stays, what was heard does not."""
        return replace(state, lag=np.zeros_like(state.lag), heard_s=0.0)

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
        base = planning.settled if planning.probing else planning.plan
        if base is None or not in_force:
            return self._away(state, time_s, gone=base is None)
        if not math.isnan(state.away_s) or time_s < state.begun_s:
            state = replace(state, away_s=math.nan, begun_s=min(state.begun_s, time_s))
        if base is not state.base:
            state = self._taken_off(state, base, time_s, estimate)
        sent = planning.plan or base
        due = not 0.0 <= time_s - state.made_s < self._tuning.refresh_s
        if sent is not state.made_of or (state.plan is not None and due):
            return self._made(state, sent, time_s, estimate)
        return state

    def _away(self, state: HandoverState, time_s: float, *, gone: bool) -> HandoverState:
        """Nothing of ours is told; what was told holds in the autopilot for a while. ``gone``: there is no plan."""
        if state.base is None:
            return state
        if gone or time_s - state.away_s >= self._tuning.holds_s:
            kept = self.start()
            return replace(kept, lag=state.lag, heard_s=state.heard_s)
        return replace(state, away_s=time_s) if math.isnan(state.away_s) else state

    def _heard(self, state: HandoverState, dt_s: float, estimate: Estimate) -> HandoverState:
        lacking = -estimate.residual
        believed = self._believed(estimate)
        if believed is not None or state.base is not None:
            # The residual counts on what is believed, the mixing in force on what was planned.
            more = state.counts - (self._ones if believed is None else believed)
            lacking = lacking + self._accelerations @ (estimate.thrust_shown * more)
        if not math.isfinite(float(lacking.sum())):
            return state  # it would stay for the whole flight
        share = -math.expm1(-dt_s / self._tuning.wind_up_s)
        first = state.lag[0] + share * (lacking - state.lag[0])
        second = state.lag[1] + share * (first - state.lag[1])
        return replace(state, lag=np.array((first, second)), heard_s=state.heard_s + dt_s)

    def _believed(self, estimate: Estimate) -> NDArray[np.float64] | None:
        """(m,) effectiveness that the residual counts on; None: all whole."""
        if True not in estimate.failed.tolist() and not estimate.either:
            return None
        believed = np.where(estimate.failed, 0.0, 1.0)
        believed[list(estimate.either)] *= HALF
        return believed

    def _left(self, state: HandoverState, time_s: float) -> NDArray[np.float64]:
        """(n,) of the wrench that was taken off."""
        return np.asarray(state.wrench * math.exp(-max(time_s - state.begun_s, 0.0) / self._tuning.let_go_s))

    def _taken_off(self, state: HandoverState, base: Plan, time_s: float, estimate: Estimate) -> HandoverState:
        """With what is asked for on account of what is believed lost, and that ``base`` first does not count on.

        Torque alone: whether anybody has made up for the lift is not known, and too much of it does no harm.
        """
        heard = state.heard_s / self._tuning.wind_up_s
        # What came before the first sample is taken to have been as it was then.
        known = 1.0 - math.exp(-heard) * (1.0 + heard)
        lag = state.lag[1] / max(known, self._tuning.known_min)
        lost = self._lost(state, estimate)
        columns = self._accelerations @ lost / self._scale[:, None]
        try:
            share = np.linalg.lstsq(columns, lag / self._scale, rcond=None)[0]
        except np.linalg.LinAlgError:  # the matrix as it is: this is never worth a step
            share = np.zeros(lost.shape[1])
        most = np.maximum(estimate.thrust_shown, 0.0) @ lost
        wrench = self._left(state, time_s) + self._nominal @ (lost @ np.clip(share, 0.0, most))
        wrench[THRUST] = 0.0
        return replace(
            state,
            base=base,
            counts=read_only(base.effectiveness[THRUST] / self._nominal[THRUST]),
            wrench=read_only(wrench),
            begun_s=time_s,
            lag=np.zeros_like(state.lag),
        )

    def _lost(self, state: HandoverState, estimate: Estimate) -> NDArray[np.float64]:
        """(m, k) Shares of the motors in each loss that the mixing in force still counts on: a declared motor, or one
        of two of which it is not known which; once it is, half of both has been taken off, and that is as much."""
        m = len(state.counts)
        losses = [np.eye(m)[motor] for motor in np.flatnonzero(estimate.failed & (state.counts > HALF))]
        pair = list(estimate.either)
        if pair and (state.counts[pair] > HALF).all():
            losses.append(np.where(np.isin(np.arange(m), pair), HALF, 0.0))
        return np.stack(losses, axis=1) if losses else np.zeros((m, 0))

    def _made(self, state: HandoverState, sent: Plan, time_s: float, estimate: Estimate) -> HandoverState:
        """With the plan for what is left of the wrench, of ``sent``."""
        left = self._left(state, time_s)
        if float(np.abs(left).max()) < self._tuning.least:
            return replace(state, plan=None, made_of=sent)
        hover = self._vehicle.hover
        thrust = max(float(sent.effectiveness[THRUST] @ estimate.thrust_shown), 0.5 * hover)
        plan = carried(sent, left, thrust, hover, self._planner)
        return replace(state, plan=plan, made_of=sent, made_s=time_s)
