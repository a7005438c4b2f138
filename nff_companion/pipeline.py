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
from nff_companion.allocation.adapted import AdaptedMatrix
from nff_companion.allocation.plan import Plan
from nff_companion.allocation.planner import Planner, PlannerOptions
from nff_companion.control.law import Knowledge
from nff_companion.control.override import OverrideLoop
from nff_companion.core import basis_network
from nff_companion.core.decision import Event
from nff_companion.core.estimator import Estimate, Estimator, EstimatorOptions, EstimatorState, Motion
from nff_companion.core.flight_phase import FlightPhase, FlightPhaseOptions
from nff_companion.core.full_matrix import FullMatrixOptions
from nff_companion.core.rotor_speed import RotorSpeedState, RotorSpeedWatch
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import SolverError
from nff_companion.laws import LAWS, LateralFeed, LawName

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
    law: LawName = "nff"
    feed_lateral: LateralFeed = "learning"
    planner: PlannerOptions = PlannerOptions()
    full_matrix: FullMatrixOptions = FullMatrixOptions()  # of the law b
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
        self.law = LAWS[options.law]
        self.network = basis_network.for_vehicle(vehicle, options.estimator.network if self.law.learn else "none")
        self.estimator = self._make_estimator()
        self._phase = FlightPhase(vehicle, options.flight_phase)
        self._planner = Planner(vehicle, allocator(options.allocation), options.planner)
        self._loop = OverrideLoop(vehicle)
        self._adapted = AdaptedMatrix(vehicle, options.full_matrix) if self.law.full_matrix else None
        self._speeds = RotorSpeedWatch(vehicle.motors)
        self._speed_state = RotorSpeedState.start(vehicle.motors)
        m, n = vehicle.motors, vehicle.axes
        self._state: EstimatorState | None = None
        self._failed = np.zeros(m, bool)
        self._last_s: float | None = None
        self._good_since_s: float | None = None
        self._trouble = "waiting for telemetry"
        self._blind = ""  # why override cannot close the loop
        self.blocked = ""  # set from outside: why nothing may be sent
        self.hands_off = ""  # set from outside: why override may not close the loop
        self.fault = ""  # why the estimator itself failed; empty again when it has worked for a while
        self.last: Output | None = None
        self._none = np.zeros(n)
        self._knowledge = self._nothing = Knowledge.none(n)
        self.bad_samples = 0

    def _make_estimator(self) -> Estimator:
        options = self.options.estimator
        if not self.law.identify:
            options = msgspec.structs.replace(options, identify=False)
        return Estimator(self.vehicle, self.dt_s, options, self.network)

    # -- operator -----------------------------------------------------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """The operator's wish; what is in effect also depends on the telemetry."""
        self.mode = mode
        self._loop.release()
        self._blind = ""

    def retune(self, options: EstimatorOptions) -> bool:
        """Other thresholds, from the next flight on; False in flight, when nothing changes."""
        if self._state is not None:
            return False
        self.options = msgspec.structs.replace(self.options, estimator=options)
        self.estimator = self._make_estimator()
        return True

    def describe_telemetry(self, telemetry: TelemetryTable) -> bool:
        """The autopilot's filters, where it says them; False in flight, when nothing changes."""
        if telemetry == self.vehicle.telemetry:
            return True
        if self._state is not None:
            return False
        self.vehicle = self.vehicle.with_telemetry(telemetry)
        self.estimator = self._make_estimator()
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
        if gap is not None and self.last is not None and -_REORDERED_S < gap < 0.2 * self.dt_s:
            self.bad_samples += 1
            return replace(self.last, events=[], override=None, bad_samples=self.bad_samples)
        self._last_s = time_s
        if gap is not None and not 0.0 < gap <= self.options.gap_max_s:
            self._restart()
            return self._bad(time_s, f"time jumped by {gap:+.3f} s")
        if self._good_since_s is None:
            self._good_since_s = time_s
        command = sample.thrust if sample.thrust is not None else self.vehicle.thrust_fraction(sample.output)
        flying = self._phase.step(sample, command)
        if not flying or gap is None:
            self._state = None
            self._loop.release()
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
                self._motion(sample),
                self._allocation_norm,
            )
        except (SolverError, np.linalg.LinAlgError) as error:
            self._restart()
            self.fault = f"estimator: {error}"
            return self._bad(time_s, self.fault)
        self._failed = estimate.failed
        self._trouble = "" if time_s - self._good_since_s >= self.options.recover_s else "recovering"
        if not self._trouble:
            self.fault = ""
        self._knowledge = self._known(estimate)
        if self._adapted is not None:
            self._adapted.step(estimate, gap)
        self._planner.step(time_s, estimate)
        return self._output(time_s, estimate, estimate.events, override)

    def _known(self, estimate: Estimate) -> Knowledge:
        """What is fed forward by the law and the options chosen."""
        feed = self.options.feed_lateral
        lateral = feed == "always" or (feed == "learning" and self.law.learn)
        nothing = self._nothing
        return Knowledge(
            estimate.disturbance if self.law.learn else nothing.residual,
            estimate.push if lateral else nothing.push_m_s2,
        )

    def _stopped(self, sample: Sample, command: np.ndarray) -> np.ndarray | None:
        """(m,) bool: motors that stand still by their rotor speeds; None where no speeds come."""
        speed, read = sample.rotor_speed_rad_s, sample.rotor_speed_time_s
        if speed is None or read is None or speed.shape != command.shape or read.shape != command.shape:
            return None
        return self._speeds.step(self._speed_state, sample.time_s, speed, read, command)

    @staticmethod
    def _motion(sample: Sample) -> Motion | None:
        """What the basis network looks at; None where it is not known: garbage would stay in a for the whole flight."""
        velocity, quaternion = sample.velocity_m_s, sample.quaternion
        if velocity is None or quaternion is None or not sample.moves_plausibly:
            return None
        return Motion(velocity, quaternion)

    @property
    def _allocation_norm(self) -> float:
        """sigma(A) of the matrix in force."""
        plan = self._planner.plan or self._planner.healthy
        return plan.norm if plan is not None else 0.0

    @property
    def attitude_desired(self) -> np.ndarray | None:
        """(3, 3) body to NED that the override's law wanted last; None when it does not close the loop."""
        return None if self._loop.desired is None else np.array(self._loop.desired).T

    @property
    def rejected(self) -> int:
        """Matrices that failed the check so far."""
        return self._planner.rejected

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
        self._loop.release()
        self._last_s = None
        self._speed_state = RotorSpeedState.start(self.vehicle.motors)
        self._planner.restart()
        if self._adapted is not None:
            self._adapted.restart()

    def _forget(self) -> None:
        """After landing and disarming the next flight starts without declarations."""
        self._failed = np.zeros_like(self._failed)
        self._planner.forget()
        self._loop.release()
        if self._adapted is not None:
            self._adapted.restart()

    # -- override -----------------------------------------------------------------------------------------------

    def _close_loop(self, sample: Sample, dt_s: float) -> np.ndarray | None:
        """Motor outputs (m,) by the law, None when the loop cannot be closed."""
        if self.hands_off:
            self._blind = self.hands_off
            self._loop.release()
            return None
        plan = self._planner.plan or self._planner.healthy
        if plan is None:
            self._blind = "override: no matrix for this airframe: allocating instead"
            return None
        matrix = plan.matrix if self._adapted is None else self._adapted.allocation(plan.matrix)
        left = None if self._planner.plan is None else plan.effectiveness
        thrust = self._loop.answer(sample, matrix, left, self._knowledge, dt_s)
        self._blind = self._loop.blind
        if thrust is None:
            return None
        output = self.vehicle.output_for(thrust)
        output[self._failed] = 0.0
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
        plan = self._planner.plan if mode != Mode.OBSERVE else None
        shown = np.ones(m) if estimate is None else estimate.effectiveness
        degraded = (self._planner.planned_for < 1.0) & ~self._failed  # NaN, not yet planned: not degraded
        self.last = Output(
            time_s=time_s,
            mode=mode,
            reason=self._trouble or self.blocked or self._planner.refusal or self._blind or self._doing(),
            flying=estimate is not None,
            failed=self._failed,
            effectiveness=np.where(self._failed & (shown > 0.99), 0.0, shown) if estimate is None else shown,
            deviation=np.ones(m) if estimate is None else estimate.deviation,
            degraded=degraded,
            events=events,
            plan=plan,
            override=override if mode == Mode.OVERRIDE else None,
            estimate=estimate,
            unallocated=self._planner.plan.unallocated if self._planner.plan is not None else self._none,
            rejected=self.rejected,
            bad_samples=self.bad_samples,
        )
        return self.last

    def _doing(self) -> str:
        if self.mode == Mode.OBSERVE:
            return "observing"
        if not self.law.identify:
            return f"law {self.options.law}: no motor is watched"
        if self._planner.plan is None:
            return "all motors healthy"
        failed = [int(i) + 1 for i in np.flatnonzero(self._failed)]
        given_up = ", yaw given up" if self._planner.plan.released else ""
        return f"reallocated without motors {failed}{given_up}" if failed else f"reallocated a partial loss{given_up}"
