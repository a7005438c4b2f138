"""One step of the companion: sample, condition and orders in; what is believed and what should be in force out.

Knows no socket and no clock: time is the autopilot's, in the samples. The same code runs in flight, on logs and in
virtual time. ``step`` is the only owner of what is believed; states are passed in and returned.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.admission import again, follows, refusal
from nff_companion.allocation import allocator
from nff_companion.allocation.handover import Handover
from nff_companion.allocation.planner import Planner
from nff_companion.allocation.probe import Prober
from nff_companion.companion_state import NO_ORDERS, CompanionState, Orders, Output, trusts
from nff_companion.condition import Condition, Mode, Reason, Statement, first, read_only
from nff_companion.control.law import Knowledge
from nff_companion.control.override import OverrideLoop, OverrideState
from nff_companion.core import partial_loss
from nff_companion.core.basis_network import Basis
from nff_companion.core.estimate import Estimate, EstimatorState, Measurement, Motion
from nff_companion.core.estimator import Estimator
from nff_companion.core.fit_monitor import FitMonitor, FitState
from nff_companion.core.flight_phase import FlightPhase
from nff_companion.core.parts import FLOWN, Parts
from nff_companion.core.rotor_speed import RotorSpeedState, RotorSpeedWatch
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.core.wear import Wear, WearState
from nff_companion.errors import SolverError
from nff_companion.outcome import Outcome, acting


class Companion:
    """Constants of one vehicle at one sample rate."""

    def __init__(
        self,
        vehicle: Vehicle,
        rate_hz: float,
        tuning: Tuning | None = None,
        *,
        allocation: str = "trim",
        network: Basis | None = None,
        parts: Parts = FLOWN,
        confirmed: bool = True,
    ) -> None:
        """``network`` None: a constant basis. ``confirmed`` False: nobody has said that ``vehicle`` is the one that
        flies; until a flight shows it nothing is declared. Raises ConfigError for an unknown allocation method."""
        self.vehicle, self.rate_hz, self.network, self.parts = vehicle, rate_hz, network, parts
        self.tuning, self.allocation, self.confirmed = tuning or Tuning(), allocation, confirmed
        o = self.tuning
        self._dt_s, self._composite = 1.0 / rate_hz, self.tuning.adaptation.composite > 0.0
        basis = network if parts.learn else None
        self._estimator = (
            Estimator(vehicle, self._dt_s, o, basis, identify=parts.identify, joint=parts.joint, judged=parts.judged)
            if parts.estimator is None
            else parts.estimator(vehicle, self._dt_s)
        )
        self._phase = FlightPhase(vehicle, o.flight_phase)
        self._planner = Planner(vehicle, allocator(allocation), o.planner, parts.target, Prober(vehicle, o))
        self._handover = Handover(vehicle, o)
        # Without a network neither the matrix in force nor what the vehicle does has a part in the estimate.
        self._only_judges = parts.judged and basis is None
        self._loop = OverrideLoop(vehicle, o.law, o.override)
        self._adaptation = None if parts.adapt is None else parts.adapt(vehicle)
        self._speeds = RotorSpeedWatch(vehicle.motors, o.rotor_speed)
        self._fit = FitMonitor(vehicle, self._dt_s, o.fit)
        self._wear = Wear(vehicle, o)
        self._nothing = Knowledge.none(vehicle.axes)
        self._outcome = Outcome(vehicle.motors, vehicle.axes)

    def rebuilt(
        self,
        *,
        rate_hz: float | None = None,
        telemetry: TelemetryTable | None = None,
        tuning: Tuning | None = None,
    ) -> Companion:
        """The same companion for another sample rate, other filters of the autopilot, or other tuning: between flights
        (``CompanionState.watching`` False) the state goes on with it."""
        vehicle = self.vehicle if telemetry is None else self.vehicle.with_telemetry(telemetry)
        return Companion(
            vehicle,
            rate_hz or self.rate_hz,
            tuning or self.tuning,
            allocation=self.allocation,
            network=self.network,
            parts=self.parts,
            confirmed=self.confirmed,
        )

    def start(self, mode: Mode) -> CompanionState:
        """Nothing heard, nothing declared."""
        output = self._outcome.first()
        return CompanionState(
            mode=mode,
            failed=output.failed,
            last=output,
            planning=self._planner.start(),
            handover=self._handover.start(),
            speeds=RotorSpeedState.start(self.vehicle.motors),
            knowledge=self._nothing,
            adapted=None if self._adaptation is None else self._adaptation.start(),
            fit=self._fit.start(),
            wear=self._wear.start(),
            confirmed=self.confirmed,
        )

    # -- the step -----------------------------------------------------------------------------------------------

    def respond(
        self, state: CompanionState, sample: Sample, condition: Condition
    ) -> tuple[CompanionState, NDArray[np.float64] | None]:
        """Motor outputs (m,) that answer ``sample`` in override mode, None in every other.

        To be called before ``step`` with the same sample: the answer rests on what was believed up to the sample
        before (u_k on g(x, u_(k-1)), equation (6.7)), so that no estimation stands between a sample and its outputs.
        """
        if acting(state, condition) != Mode.OVERRIDE or state.estimate is None:
            return state, None
        gap = _gap(state, sample)
        if gap is None or not self._follows(gap) or self._refused(sample) is not None:
            return state, None
        if condition.drive is not None:
            return replace(state, blind=condition.drive, loop=OverrideState()), None
        plan = state.planning.plan or self._planner.healthy
        if plan is None:
            return replace(state, blind=Statement(Reason.NO_HEALTHY_MATRIX)), None
        matrix, adapted = plan.matrix, state.adapted
        if self._adaptation is not None:
            adapted, matrix = self._adaptation.allocation(adapted, matrix)
        left = None if state.planning.plan is None else plan.effectiveness
        loop, answer = self._loop.answer(state.loop, sample, matrix, left, state.knowledge, gap)
        if isinstance(answer, Statement):
            return replace(state, loop=loop, adapted=adapted, blind=answer), None
        outputs = self.vehicle.output_for(answer)
        outputs[state.failed] = 0.0
        outputs.flags.writeable = False
        return replace(state, loop=loop, adapted=adapted, blind=None), outputs

    def step(
        self,
        state: CompanionState,
        sample: Sample | None,
        condition: Condition,
        orders: Orders = NO_ORDERS,
        override: NDArray[np.float64] | None = None,
    ) -> tuple[CompanionState, Output]:
        """One sample; None: telemetry does not come, and the orders are taken all the same. ``override``: what
        ``respond`` answered to the sample. Never raises on bad input."""
        if orders is not NO_ORDERS:
            state = self._obeyed(state, orders)
        if sample is None:
            return self._said(state, condition, estimate=state.last.estimate if state.watching else None)
        refused = self._refused(sample)
        if refused is not None:
            # What cannot be used says all the same what time it is: commands must not be of an older one.
            return self._bad(state, condition, refused, None if refused.reason == Reason.SAMPLE_TIME else sample.time_s)
        gap = _gap(state, sample)
        if gap is not None and again(gap, self._dt_s, self.tuning.companion):
            state = replace(state, bad_samples=state.bad_samples + 1)
            return state, replace(state.last, events=(), override=None, bad_samples=state.bad_samples)
        if gap is not None and not self._follows(gap):
            jump = Statement(Reason.TIME_JUMP, f"{gap:+.3f}")
            return self._bad(self._interrupted(state), condition, jump, sample.time_s)
        return self._flown(state, sample, condition, gap, override)

    def interrupted(self, state: CompanionState, condition: Condition, why: Statement) -> tuple[CompanionState, Output]:
        """Telemetry stopped: what was being estimated is dropped, what was declared stays; the mode is observe."""
        return self._bad(self._interrupted(state), condition, why)

    def speed_faults(self, state: CompanionState) -> list[int]:
        """Motors (from 1) whose speed reads zero while they pull: a fault of the speed sensor."""
        return [int(i) + 1 for i in np.flatnonzero(self._speeds.faults(state.speeds, state.failed))]

    def _refused(self, sample: Sample) -> Statement | None:
        return refusal(sample, self.vehicle.motors, self.tuning.companion)

    def _follows(self, gap_s: float) -> bool:
        return follows(gap_s, self._dt_s, self.tuning.companion)

    # -- parts of it --------------------------------------------------------------------------------------------

    def _obeyed(self, state: CompanionState, orders: Orders) -> CompanionState:
        """The operator's orders, and what a restart takes over: the only place where they are applied."""
        failed = state.failed
        if orders.adopt:  # only a file that was confirmed has declared them
            state = replace(state, confirmed=True)
        if orders.lift or orders.adopt is not None:
            failed = np.array(failed)
            if orders.adopt is not None:
                failed[:] = False
                failed[[motor - 1 for motor in orders.adopt]] = True
            failed[[motor - 1 for motor in orders.lift]] = False
            failed.flags.writeable = False
            if orders.adopt is not None or {motor - 1 for motor in orders.lift} & set(state.either):
                state = replace(state, either=())  # the word for one of the two is for both
        if orders.mode is None:
            return replace(state, failed=failed)
        return replace(state, failed=failed, mode=orders.mode, loop=OverrideState(), blind=None)

    def _flown(
        self,
        state: CompanionState,
        sample: Sample,
        condition: Condition,
        gap: float | None,
        override: NDArray[np.float64] | None,
    ) -> tuple[CompanionState, Output]:
        """A good sample: on the ground nothing is estimated, in flight everything is."""
        time_s = sample.time_s
        command = sample.thrust if sample.thrust is not None else self.vehicle.thrust_fraction(sample.output)
        phase = self._phase.step(state.phase, sample, command)
        good_since = time_s if state.good_since_s is None else state.good_since_s
        if not phase.flying or gap is None or condition.samples is not None:
            state = replace(state, phase=phase, last_s=time_s, good_since_s=good_since)
            if phase.landed_and_disarmed or (not sample.armed and (state.failed.any() or state.either)):
                state = self._forgotten(state)
            why = Statement(Reason.NOT_FLYING if not phase.flying else Reason.STARTING)
            why = first(why, condition.samples) or why
            fault = state.fault and phase.flying
            fit = self._fit.paused(state.fit, anew=not phase.flying)
            if phase.aloft_since_s is not None and not state.failed.any() and not state.either:
                fit = self._fit.lifted(state.fit, -float(sample.specific_force_m_s2[2]), command)
            wear = self._wear.paused(state.wear)
            state = replace(state, estimate=None, loop=OverrideState(), trouble=why, fault=fault, fit=fit, wear=wear)
            return self._said(state, condition, time_s)
        try:
            estimating, estimate = self._estimated(state, sample, command, gap)
        except (SolverError, np.linalg.LinAlgError) as error:
            why = Statement(Reason.ESTIMATOR, str(error))
            state = replace(state, phase=phase)
            return self._bad(replace(self._interrupted(state), fault=True), condition, why, time_s)
        weak = estimating.partial_loss if isinstance(estimating, EstimatorState) else state.weak
        fit = self._fitted(state, estimating, override)
        trusted = trusts(fit, confirmed=state.confirmed)
        if not trusted:
            state, estimate = self._held_back(state, estimate, time_s)
        recovered = time_s - good_since >= self.tuning.companion.recover_s
        failed = state.failed if estimate.failed is state.failed else read_only(estimate.failed)
        planning, handover, adapted = state.planning, state.handover, state.adapted
        if not trusted:
            handover = self._handover.start()
        if trusted and not self._only_judges:
            partial = estimate.settled and self._fits_closely(fit, confirmed=state.confirmed)
            driven = override is not None
            mode = acting(state, condition)
            tests = mode != Mode.OBSERVE and (condition.takes_matrix or driven)
            planning = self._planner.step(planning, time_s, estimate, trust_partial=partial, driven=driven, tests=tests)
            mixes = mode != Mode.OBSERVE and condition.takes_matrix and not driven
            handover = self._handover.step(handover, time_s, gap, estimate, planning, in_force=mixes)
        if self._adaptation is not None:
            adapted = self._adaptation.step(adapted, estimate, gap)
        state = replace(
            state,
            phase=phase,
            last_s=time_s,
            good_since_s=good_since,
            fit=fit,
            weak=weak,
            wear=self._worn(state, estimating, estimate, gap),
            estimate=estimating,
            failed=failed,
            either=estimate.either,
            planning=planning,
            handover=handover,
            knowledge=self._known(estimate),
            adapted=adapted,
            trouble=None if recovered else Statement(Reason.RECOVERING),
            fault=state.fault and not recovered,
        )
        return self._said(state, condition, time_s, estimate, override)

    def _estimated(
        self, state: CompanionState, sample: Sample, command: NDArray[np.float64], gap_s: float
    ) -> tuple[EstimatorState, Estimate]:
        """Raises SolverError, LinAlgError."""
        before = state.estimate
        gyro, force = sample.gyro_rad_s, sample.specific_force_m_s2
        if before is None:
            # After a gap, or a restart in the air, what is off may be a motor that failed meanwhile.
            took_off = not state.phase.flew and state.phase.ground_m is not None
            before = self._estimator.start(sample.time_s, gyro, force, command, state.failed, takes_off=took_off)
            if isinstance(before, EstimatorState):  # no peer's
                before = dataclasses.replace(before, partial_loss=partial_loss.carried(state.weak))
        plan, error = state.planning.plan or self._planner.healthy, state.loop.memory.tracking_error
        measurement = Measurement(
            time_s=sample.time_s,
            dt_s=gap_s,
            gyro=gyro,
            specific_force=force,
            command=command,
            stopped=self._stopped(state, sample, command),
            motion=None if self._only_judges else _motion(sample),
            allocation_norm=plan.norm if plan is not None else 0.0,
            gains=state.fit.gains,
            failed=state.failed,
            either=state.either,
            tracking_error=np.array(error) if self._composite and error and state.blind is None else None,
        )
        return self._estimator.step(before, measurement)

    def _fits_closely(self, state: FitState, *, confirmed: bool) -> bool:
        """Whether a partial loss may be believed: where the lag is off, or the gains of a file that only the flight has
        confirmed, a turn looks like one for a while."""
        fit, later_s = state.fit, state.fit.seen.later_s
        if later_s is not None and abs(later_s) > self.tuning.fit.partial_lag_s:
            return False
        return confirmed or not fit.differs

    def _fitted(
        self, state: CompanionState, estimating: EstimatorState, override: NDArray[np.float64] | None
    ) -> FitState:
        """What the sample says of the airframe file. Outputs of our own say only what the file says itself, and once a
        motor is declared the vehicle is no longer the one that the file describes."""
        if override is not None or not isinstance(estimating, EstimatorState):
            return self._fit.paused(state.fit)
        decided, lost = estimating.decision, True in state.failed.tolist() or bool(state.either)
        if lost or decided.among or decided.more:
            return self._fit.paused(state.fit, anew=lost)
        return self._fit.step(state.fit, estimating.residual)

    def _worn(self, state: CompanionState, estimating: EstimatorState, estimate: Estimate, gap_s: float) -> WearState:
        """What the sample says of motors that give less than before, of a vehicle that is whole."""
        if not isinstance(estimating, EstimatorState) or not self.parts.identify:
            return state.wear
        decided = estimating.decision
        if True in estimate.failed.tolist() or estimate.either:
            return self._wear.start()
        if estimate.weak:
            return self._wear.anew(state.wear)  # more than wear, and said as such
        if not estimate.settled or decided.among or decided.more:
            return self._wear.paused(state.wear)
        return self._wear.step(state.wear, estimating.residual, gap_s)

    @staticmethod
    def _held_back(state: CompanionState, estimate: Estimate, time_s: float) -> tuple[CompanionState, Estimate]:
        """Nothing is declared by a file that may be another vehicle's; what would have been is remembered."""
        motors = tuple(sorted(event.motor for event in estimate.events if event.declared))
        motors = motors or tuple(motor + 1 for motor in estimate.either)
        if motors:
            state = replace(state, held_back=(motors, time_s))
        said = estimate.events or estimate.either or estimate.among or estimate.more or estimate.weak
        if said or estimate.failed is not state.failed:
            nothing: tuple[int, ...] = ()
            estimate = dataclasses.replace(
                estimate, failed=state.failed, either=nothing, among=(), more=nothing, weak=nothing, events=[]
            )
        return state, estimate

    def _known(self, estimate: Estimate) -> Knowledge:
        """What is fed forward."""
        parts, nothing = self.parts, self._nothing
        return Knowledge(
            estimate.disturbance if parts.learn else nothing.residual,
            estimate.lateral_m_s2 if parts.feed_lateral else nothing.push_m_s2,
        )

    def _stopped(self, state: CompanionState, sample: Sample, command: NDArray[np.float64]) -> NDArray[np.bool_] | None:
        """(m,) bool: motors that stand still by their rotor speeds; None where no speeds come."""
        speed, read = sample.rotor_speed_rad_s, sample.rotor_speed_time_s
        if speed is None or read is None or speed.shape != command.shape or read.shape != command.shape:
            return None
        return self._speeds.step(state.speeds, sample.time_s, speed, read, command)

    def _interrupted(self, state: CompanionState) -> CompanionState:
        """The estimate starts anew; what was declared, and the plan for it, stay."""
        return replace(
            state,
            estimate=None,
            loop=OverrideState(),
            last_s=None,
            speeds=RotorSpeedState.start(self.vehicle.motors),
            fit=self._fit.paused(state.fit),
            wear=self._wear.paused(state.wear),
            planning=self._planner.interrupted(state.planning),
            handover=self._handover.interrupted(state.handover),
            adapted=None if self._adaptation is None else self._adaptation.start(),
        )

    def _forgotten(self, state: CompanionState) -> CompanionState:
        """After landing and disarming the next flight starts without declarations; a file that fitted is confirmed."""
        return replace(
            state,
            fit=self._fit.start(),
            wear=self._wear.start(),
            confirmed=state.confirmed or state.fit.proven,
            held_back=((), -math.inf),
            failed=read_only(np.zeros(self.vehicle.motors, bool)),
            either=(),
            weak=partial_loss.NOTHING,
            planning=self._planner.forgotten(state.planning),
            handover=self._handover.start(),
            adapted=None if self._adaptation is None else self._adaptation.start(),
        )

    # -- result -------------------------------------------------------------------------------------------------

    def _bad(
        self, state: CompanionState, condition: Condition, why: Statement, time_s: float | None = None
    ) -> tuple[CompanionState, Output]:
        state = replace(state, bad_samples=state.bad_samples + 1, good_since_s=None, trouble=why)
        return self._said(state, condition, time_s)

    def _said(
        self,
        state: CompanionState,
        condition: Condition,
        time_s: float | None = None,
        estimate: Estimate | None = None,
        override: NDArray[np.float64] | None = None,
    ) -> tuple[CompanionState, Output]:
        notes = state.notes(time_s, self.tuning.fit.word_s)
        output = self._outcome.output(state, condition, time_s, estimate, override, notes)
        return replace(state, last=output), output


def _gap(state: CompanionState, sample: Sample) -> float | None:
    return None if state.last_s is None else sample.time_s - state.last_s


def _motion(sample: Sample) -> Motion | None:
    """What the basis network looks at; None where it is not known: garbage would stay in a for the whole flight."""
    velocity, quaternion = sample.velocity_m_s, sample.quaternion
    if velocity is None or quaternion is None or not sample.moves_plausibly:
        return None
    return Motion(velocity, quaternion)
