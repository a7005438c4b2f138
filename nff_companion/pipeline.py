"""One step of the companion: telemetry sample in; estimate, allocation and outputs out.

Knows no socket and no clock: time is the autopilot's, in the samples. The same code runs in flight, on logs and in
virtual time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import msgspec
import numpy as np

from nff_companion.allocation import allocator
from nff_companion.allocation.plan import Plan, Refusal, make_plan
from nff_companion.control.law import ControlLaw, Reference, State, saturate, steady_push
from nff_companion.errors import SolverError
from nff_companion.estimation import sparse
from nff_companion.estimation.decision import Event
from nff_companion.estimation.estimator import Estimate, Estimator, EstimatorOptions, EstimatorState
from nff_companion.estimation.rotor_speed import RotorSpeedState, RotorSpeedWatch
from nff_companion.flight_phase import FlightPhase, FlightPhaseOptions
from nff_companion.telemetry import Sample
from nff_companion.vehicle import TelemetryTable, Vehicle

# Beyond what any vehicle survives: such a sample is a fault of the sensor or of the link.
_GYRO_MAX_RAD_S, _FORCE_MAX_M_S2, _TIME_MAX_S = 60.0, 400.0, 1e8
_REORDERED_S = 0.1  # a sample this much older than the last one is a duplicate or came late: ignored


class Mode(IntEnum):
    """What the companion may do."""

    OBSERVE = 0
    ALLOCATE = 1
    OVERRIDE = 2


class PipelineOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tuning of one pipeline."""

    mode: Mode = Mode.ALLOCATE
    allocation: str = "trim"
    estimator: EstimatorOptions = EstimatorOptions()
    flight_phase: FlightPhaseOptions = FlightPhaseOptions()
    shape_full_at: float = 0.75  # zeta of (24)
    shape_none_below: float = 0.30  # xi
    degraded_for_s: float = 0.2  # a partial loss is allocated around after this long
    resolve_change: float = 0.08  # of a motor's effectiveness, to compute a new matrix
    resolve_interval_s: float = 0.1  # [L] runs its allocation at 10 Hz
    catch_s: float = 2.0  # after a double failure roll and pitch have more right to torque than yaw
    double_within_s: float = 0.5  # two declarations within this time are a double failure
    gap_max_s: float = 0.1  # without a sample: the estimate starts anew
    recover_s: float = 0.3  # of good samples, to act again


@dataclass(slots=True)
class Output:
    """Result of one step. ``matrix`` is what should be in force: None, the autopilot's own."""

    time_s: float
    mode: Mode
    reason: str
    flying: bool
    failed: np.ndarray  # (m,) bool
    effectiveness: np.ndarray  # (m,)
    deviation: np.ndarray  # (m,)
    degraded: np.ndarray  # (m,) bool: allocated around, not declared
    events: list[Event]
    plan: Plan | None
    override: np.ndarray | None  # (m,) motor outputs 0..1
    estimate: Estimate | None
    unallocated: np.ndarray  # (n,)
    rejected: int  # matrices that failed the check so far
    bad_samples: int


class Pipeline:
    """Holds the state of one vehicle's companion; ``step`` never raises on bad input."""

    def __init__(self, vehicle: Vehicle, rate_hz: float, options: PipelineOptions) -> None:
        self.vehicle, self.options = vehicle, options
        self.dt_s = 1.0 / rate_hz
        self.mode = options.mode
        self.estimator = Estimator(vehicle, self.dt_s, options.estimator)
        self._phase = FlightPhase(vehicle, options.flight_phase)
        self._allocate = allocator(options.allocation)
        self._law = ControlLaw(vehicle)
        self._speeds = RotorSpeedWatch(vehicle.motors)
        self._speed_state = RotorSpeedState.start(vehicle.motors)
        m, n = vehicle.motors, vehicle.axes
        self._state: EstimatorState | None = None
        self._failed = np.zeros(m, bool)
        self._last_s: float | None = None
        self._good_since_s: float | None = None
        self._trouble = "waiting for telemetry"
        self._plan: Plan | None = None
        self._planned_for = np.ones(m)
        self._planned_s = -np.inf
        self._caught_s = self._declared_s = -np.inf
        self._catching = False
        self._low_since_s = np.full(m, np.nan)
        self._untouched = True  # all motors healthy, the autopilot's own allocation in force
        self._refusal = ""
        self._blind = ""  # why override cannot close the loop
        self.blocked = ""  # set from outside: why nothing may be sent
        self.hands_off = ""  # set from outside: why override may not close the loop
        self.fault = ""  # why the estimator itself failed; empty again when it has worked for a while
        self._last_output: Output | None = None
        self._hold: Reference | None = None
        self._integral = np.zeros(3)
        self._healthy = make_plan(self._allocate, vehicle.effectiveness, np.ones(m), vehicle.hover)
        self._none = np.zeros(n)
        self._disturbance = np.zeros(n)
        self.bad_samples = 0
        self.rejected = 0

    # -- operator -----------------------------------------------------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """The operator's wish; what is in effect also depends on the telemetry."""
        self.mode = mode
        self._hold, self._blind = None, ""

    def retune(self, options: EstimatorOptions) -> bool:
        """Other thresholds, from the next flight on; False in flight, when nothing changes."""
        if self._state is not None:
            return False
        self.options = msgspec.structs.replace(self.options, estimator=options)
        self.estimator = Estimator(self.vehicle, self.dt_s, options)
        return True

    def describe_telemetry(self, telemetry: TelemetryTable) -> bool:
        """The autopilot's filters, where it says them; False in flight, when nothing changes."""
        if telemetry == self.vehicle.telemetry:
            return True
        if self._state is not None:
            return False
        self.vehicle = self.vehicle.with_telemetry(telemetry)
        self.estimator = Estimator(self.vehicle, self.dt_s, self.options.estimator)
        return True

    def adopt(self, failed: np.ndarray) -> None:
        """Take over declarations (m,) bool that the autopilot already holds (after a restart)."""
        self._failed = self._failed | failed
        if self._state is not None:
            self._state.decision.failed = self._state.decision.failed | failed

    @property
    def failed(self) -> np.ndarray:
        """(m,) bool: motors declared failed."""
        return self._failed.copy()

    def lift(self, motor: int) -> None:
        """The operator declares ``motor`` (from 1) healthy."""
        self._failed[motor - 1] = False
        if self._state is not None:
            self._state.decision.failed = self._failed.copy()

    # -- samples ------------------------------------------------------------------------------------------------

    def _refuse(self, sample: Sample) -> str | None:
        """Why the sample cannot be used; None when it can."""
        command = sample.thrust if sample.thrust is not None else sample.output
        if command.shape != (self.vehicle.motors,):
            return f"telemetry has {command.size} motor outputs, the airframe {self.vehicle.motors}: check the airframe"
        # A sum is finite only if all its terms are.
        if not math.isfinite(float(command.sum())):
            return "motor outputs missing in telemetry"
        if not math.isfinite(float(sample.gyro_rad_s.sum()) + float(sample.specific_force_m_s2.sum())):
            return "gyro or accelerometer not finite"
        if not 0.0 <= sample.time_s < _TIME_MAX_S:
            return f"time of the sample is {sample.time_s}"
        if abs(sample.gyro_rad_s).max() > _GYRO_MAX_RAD_S or abs(sample.specific_force_m_s2).max() > _FORCE_MAX_M_S2:
            return "gyro or accelerometer beyond what a vehicle survives"
        return None

    def _bad(self, time_s: float, reason: str) -> Output:
        self.bad_samples += 1
        self._good_since_s = None
        self._trouble = reason
        return self._output(time_s, None, [], None)

    def respond(self, sample: Sample) -> np.ndarray | None:
        """Motor outputs (m,) that answer ``sample`` in override mode, None in every other.

        To be called before ``step`` with the same sample: the answer rests on what was believed up to the sample
        before (u_k on g(x, u_(k-1)), equation (6.7)), so that no estimation stands between a sample and its outputs.
        """
        if self._acting() != Mode.OVERRIDE or self._state is None or self._last_s is None:
            return None
        gap = sample.time_s - self._last_s
        if not 0.0 < gap <= self.options.gap_max_s or self._refuse(sample) is not None:
            return None
        return self._close_loop(sample, gap)

    def step(self, sample: Sample, override: np.ndarray | None = None) -> Output:
        """One sample; ``override``: what ``respond`` answered to it."""
        reason = self._refuse(sample)
        if reason is not None:
            return self._bad(self._last_s or 0.0, reason)
        time_s = sample.time_s
        gap = None if self._last_s is None else time_s - self._last_s
        if gap is not None and self._last_output is not None and -_REORDERED_S < gap < 0.2 * self.dt_s:
            self.bad_samples += 1
            return replace(self._last_output, events=[], override=None, bad_samples=self.bad_samples)
        self._last_s = time_s
        if gap is not None and not 0.0 < gap <= self.options.gap_max_s:
            self._restart()
            return self._bad(time_s, f"time jumped by {gap:+.3f} s")
        if self._good_since_s is None:
            self._good_since_s = time_s
        command = sample.thrust if sample.thrust is not None else self.vehicle.thrust_fraction(sample.output)
        flying = self._phase.step(sample, command)
        if not flying or gap is None:
            self._state = self._hold = None
            if self._phase.disarmed_after_flight:
                self._forget()
            self._trouble = "not flying" if not flying else "starting"
            return self._output(time_s, None, [], None)
        if self._state is None:
            self._state = self.estimator.start(
                time_s, sample.gyro_rad_s, sample.specific_force_m_s2, command, self._failed
            )
        try:
            self._state, estimate = self.estimator.step(
                self._state,
                time_s,
                sample.gyro_rad_s,
                sample.specific_force_m_s2,
                command,
                gap,
                self._stopped(sample, command),
            )
        except (SolverError, np.linalg.LinAlgError) as error:
            self._restart()
            self.fault = f"estimator: {error}"
            return self._bad(time_s, self.fault)
        self._failed = estimate.failed
        self._trouble = "" if time_s - self._good_since_s >= self.options.recover_s else "recovering"
        if not self._trouble:
            self.fault = ""
        self._disturbance = estimate.disturbance
        self._replan(time_s, estimate)
        return self._output(time_s, estimate, estimate.events, override)

    def _stopped(self, sample: Sample, command: np.ndarray) -> np.ndarray | None:
        """(m,) bool: motors that stand still by their rotor speeds; None where no speeds come."""
        speed, read = sample.rotor_speed_rad_s, sample.rotor_speed_time_s
        if speed is None or read is None or speed.shape != command.shape or read.shape != command.shape:
            return None
        return self._speeds.step(self._speed_state, sample.time_s, speed, read, command)

    @property
    def speed_faults(self) -> list[int]:
        """Motors (from 1) whose speed reads zero while they pull: a fault of the speed sensor."""
        return [int(i) + 1 for i in np.flatnonzero(self._speeds.faults(self._speed_state, self._failed))]

    def stream_lost(self, reason: str) -> Output:
        """To be called when telemetry stops: the state is dropped, the mode falls to observe."""
        self._restart()
        return self._bad(self._last_s or 0.0, reason)

    def _restart(self) -> None:
        self._state = None
        self._hold = None
        self._last_s = None
        self._speed_state = RotorSpeedState.start(self.vehicle.motors)
        self._planned_s = self._caught_s = self._declared_s = -np.inf
        self._low_since_s[:] = np.nan

    def _forget(self) -> None:
        """After landing and disarming the next flight starts without declarations."""
        self._failed = np.zeros_like(self._failed)
        self._plan, self._planned_for, self._hold = None, np.ones_like(self._planned_for), None
        self._refusal = ""

    # -- allocation ---------------------------------------------------------------------------------------------

    def _replan(self, time_s: float, estimate: Estimate) -> None:
        """Solve the allocation again when what is believed of the motors has moved."""
        o = self.options
        clear = float(estimate.effectiveness.min()) >= o.shape_full_at and not estimate.failed.any()
        if clear and self._untouched:
            return
        low = (estimate.effectiveness < o.shape_full_at) & (estimate.deviation < 0.2) & ~estimate.failed
        self._untouched = clear
        if int(low.sum()) > 1:
            low[:] = False  # several partial losses at once have look-alikes: nothing is done on a guess
        if low.any():
            self._low_since_s = np.where(low, np.fmin(self._low_since_s, time_s), np.nan)
            degraded = low & (time_s - np.nan_to_num(self._low_since_s, nan=np.inf) >= o.degraded_for_s)
        else:
            self._low_since_s[:] = np.nan
            degraded = low
        target = np.ones_like(self._planned_for)
        if degraded.any():
            shaped = sparse.shape(estimate.effectiveness, o.shape_full_at, o.shape_none_below)
            target = np.where(degraded, np.maximum(shaped, 0.1), 1.0)
        target[estimate.failed] = 0.0
        change = float(np.nan_to_num(np.abs(target - self._planned_for), nan=1.0).max())
        declared = bool(estimate.events)
        if declared:
            if len(estimate.events) > 1 or time_s - self._declared_s < o.double_within_s:
                self._caught_s = time_s + o.catch_s
            self._declared_s = time_s
        catching = time_s < self._caught_s
        caught = self._catching and not catching
        self._catching = catching
        if not (declared or caught) and (change < o.resolve_change or time_s - self._planned_s < o.resolve_interval_s):
            self._untouched = self._untouched and change == 0.0
            return
        self._planned_s, self._planned_for = time_s, target
        if (target == 1.0).all():
            self._plan, self._refusal = None, ""
            return
        self._untouched = False
        plan = make_plan(self._allocate, self.vehicle.effectiveness, target, self.vehicle.hover, catching=catching)
        if isinstance(plan, Refusal):
            self.rejected += 1
            self._refusal = f"no new matrix: {plan.reason}"
            self._planned_for = np.full_like(target, np.nan)  # try again after the interval
            if self._plan is not None and self._plan.matrix[estimate.failed].any():
                self._plan = None  # it drives a motor that is dead: the autopilot's own reduced mixing is better
        else:
            self._plan, self._refusal = plan, ""

    # -- override -----------------------------------------------------------------------------------------------

    def _close_loop(self, sample: Sample, dt_s: float) -> np.ndarray | None:
        """Motor outputs (m,) by (6.18), None when the state is not known."""
        plan = self._plan or (self._healthy if isinstance(self._healthy, Plan) else None)
        if self.hands_off:
            self._blind, self._hold = self.hands_off, None
            return None
        if plan is None or sample.quaternion is None or sample.position_m is None or sample.velocity_m_s is None:
            self._blind = "override needs fresh attitude, position and velocity: allocating instead"
            return None
        known = float(sample.quaternion.sum() + sample.position_m.sum() + sample.velocity_m_s.sum())
        if not math.isfinite(known):
            self._blind = "override: attitude or position not finite: allocating instead"
            return None
        if self._hold is None:
            q = sample.quaternion
            yaw = float(np.arctan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] ** 2 + q[3] ** 2)))
            self._hold = Reference(sample.position_m.copy(), np.zeros(3), yaw)
            self._integral = steady_push(q, sample.specific_force_m_s2)
        reference = self._hold
        if sample.target_position_m is not None and np.isfinite(sample.target_position_m).all():
            wanted = sample.target_yaw_rad
            yaw = reference.yaw_rad if wanted is None or not math.isfinite(wanted) else wanted
            # Held when the autopilot's targets stop: where it last wanted to be, not where we began.
            reference = self._hold = Reference(sample.target_position_m, np.zeros(3), yaw)
        state = State(sample.position_m, sample.velocity_m_s, sample.quaternion, sample.gyro_rad_s)
        demand, self._integral = self._law.demand(state, reference, self._integral, self._disturbance, dt_s)
        thrust, _ = saturate(plan.matrix, demand)
        output = self.vehicle.output_for(thrust)
        output[self._failed] = 0.0
        if not math.isfinite(float(output.sum())):
            self._blind = "override: outputs not finite: allocating instead"
            return None
        self._blind = ""
        return output

    # -- result -------------------------------------------------------------------------------------------------

    def _acting(self) -> Mode:
        return Mode.OBSERVE if self._trouble or self.blocked else self.mode

    def _output(
        self, time_s: float, estimate: Estimate | None, events: list[Event], override: np.ndarray | None
    ) -> Output:
        mode = self._acting()
        m = self.vehicle.motors
        if mode == Mode.OVERRIDE and override is None:
            mode = Mode.ALLOCATE
        plan = self._plan if mode != Mode.OBSERVE else None
        shown = np.ones(m) if estimate is None else estimate.effectiveness
        degraded = (self._planned_for < 1.0) & ~self._failed  # NaN, not yet planned: not degraded
        self._last_output = Output(
            time_s=time_s,
            mode=mode,
            reason=self._trouble or self.blocked or self._refusal or self._blind or self._doing(),
            flying=estimate is not None,
            failed=self._failed,
            effectiveness=np.where(self._failed & (shown > 0.99), 0.0, shown) if estimate is None else shown,
            deviation=np.ones(m) if estimate is None else estimate.deviation,
            degraded=degraded,
            events=events,
            plan=plan,
            override=override if mode == Mode.OVERRIDE else None,
            estimate=estimate,
            unallocated=self._plan.unallocated if self._plan is not None else self._none,
            rejected=self.rejected,
            bad_samples=self.bad_samples,
        )
        return self._last_output

    def _doing(self) -> str:
        if self.mode == Mode.OBSERVE:
            return "observing"
        if self._plan is None:
            return "all motors healthy"
        failed = [int(i) + 1 for i in np.flatnonzero(self._failed)]
        given_up = ", yaw given up" if self._plan.released else ""
        return f"reallocated without motors {failed}{given_up}" if failed else f"reallocated a partial loss{given_up}"
