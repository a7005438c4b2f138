"""What the companion says of itself: MAVLink status messages, the monitor's document, the service's status line."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nff_companion.autopilots.base import Adapter
from nff_companion.autopilots.twins import Rank, custom_mode
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, Mode, Statement
from nff_companion.core import balance
from nff_companion.core.basis_network import Basis
from nff_companion.core.decision import Event
from nff_companion.core.estimate import Estimate
from nff_companion.core.fit import Fit
from nff_companion.core.vehicle import AXES, Vehicle
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.verdict import numbers

_EFFECTIVENESS_S = 0.05
_STATUS_S = 0.2
_WINDOW = 400
_SLOTS = 16
_REASON = 60


@dataclass(slots=True)
class Counters:
    """What is counted besides the companion's own."""

    samples: int = 0
    commands_sent: int = 0
    bad_frames: int = 0
    unsendable: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class Moment:
    """Everything that is said of one moment."""

    output: Output
    condition: Condition
    asked: Mode
    verdict: Statement
    adapter: Adapter | None


def fit_numbers(fit: Fit) -> dict[str, Any]:
    """Whether the airframe file fits the vehicle that flies; null: not known."""
    seen = fit.seen
    factors = dict(zip(AXES, (seen.thrust, *seen.turns), strict=True))
    explained = zip(AXES[1:], seen.explained, strict=True)
    return {
        "verdict": fit.verdict.value,
        "text": fit.text,
        "seconds": round(seen.seconds, 1),
        "over_file": {axis: None if f is None else [round(f.low, 3), round(f.high, 3)] for axis, f in factors.items()},
        "explained": {axis: round(share, 3) for axis, share in explained},
        "motors_later_s": None if seen.later_s is None else round(seen.later_s, 4),
        "order_margin": round(seen.margin, 1),
        "order_misfit": round(seen.misfit, 1),
    }


def balance_numbers(estimate: Estimate | None, vehicle: Vehicle) -> dict[str, Any] | None:
    """Lift, centre of mass, gains and thrust curve as the flight shows them; null: not known."""
    if estimate is None or estimate.balance is None:
        return None
    lift, (forward_m, right_m) = balance.of_vehicle(estimate.balance, vehicle)
    gains = [1.0] * len(AXES[1:]) if estimate.gain is None else estimate.gain[1:].tolist()
    return {
        "lift_over_file": round(lift, 3),
        "centre_of_mass_beside_m": {"forward": round(forward_m, 4), "right": round(right_m, 4)},
        "turns_over_file": {axis: round(gain, 3) for axis, gain in zip(AXES[1:], gains, strict=True)},
        "thrust_curve_bent": round(estimate.bend, 3),
    }


@dataclass(slots=True)
class Reporter:
    """Collects counters and durations; makes messages and the document of a moment."""

    vehicle: Vehicle
    network: Basis | None
    instance: int
    counters: Counters = field(default_factory=Counters)
    slow_streams: dict[str, tuple[float, float]] = field(default_factory=dict)  # name to rate heard and asked
    built_for_hz: float = 0.0
    _durations: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    _events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=50))
    _next_effectiveness_s: float = -np.inf
    _next_status_s: float = -np.inf

    def step_done(self, output: Output, now_s: float) -> None:
        """Note one step."""
        self.counters.samples += 1
        self._arrivals.append(now_s)
        for event in output.events:
            self._events.append(
                {
                    "time_s": round(event.time_s, 4),
                    "motor": event.motor,
                    "declared": event.declared,
                    "effectiveness": round(event.effectiveness, 3),
                    "confidence": round(event.confidence, 4),
                }
            )

    def took(self, duration_s: float) -> None:
        """Note how long one sample took, from its message to the commands that answer it."""
        self._durations.append(duration_s)

    def silent(self) -> None:
        """Telemetry stopped: the rate is nought."""
        self._arrivals.clear()

    @property
    def rate_hz(self) -> float:
        """Rate of samples lately."""
        if len(self._arrivals) < 2 or self._arrivals[-1] <= self._arrivals[0]:
            return 0.0
        return (len(self._arrivals) - 1) / (self._arrivals[-1] - self._arrivals[0])

    @property
    def step_us(self) -> float:
        """Median time of a step."""
        return 1e6 * float(np.median(self._durations)) if self._durations else 0.0

    # -- messages -----------------------------------------------------------------------------------------------

    def heartbeat(self, output: Output, rank: Rank, *, act: bool = True) -> Message:
        """Heartbeat of a companion computer; a check before the flight (``act`` False) is nobody."""
        state = dialect.MAV_STATE_ACTIVE if output.mode != Mode.OBSERVE else dialect.MAV_STATE_STANDBY
        mode = custom_mode(self.instance if act else 0, output.mode, rank)
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, mode, state, 3
        )

    def is_due(self, now_s: float) -> bool:
        """Whether ``due`` has anything to say."""
        return now_s >= min(self._next_effectiveness_s, self._next_status_s)

    def due(self, moment: Moment, now_s: float) -> list[Message]:
        """Messages to be sent at ``now_s``."""
        out: list[Message] = []
        if self.counters.samples and now_s >= self._next_effectiveness_s:
            self._next_effectiveness_s = now_s + _EFFECTIVENESS_S
            out.append(self._effectiveness(moment.output))
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + _STATUS_S
            out.append(self._status(moment))
        return out

    def _effectiveness(self, output: Output) -> Message:
        m = self.vehicle.motors
        eta, deviation, decision = np.full(_SLOTS, np.nan), np.full(_SLOTS, np.nan), np.zeros(_SLOTS, int)
        eta[:m], deviation[:m] = output.effectiveness, output.deviation
        decision[:m] = np.where(output.failed, 2, np.where(output.degraded, 1, 0))
        return dialect.MAVLink_nff_effectiveness_message(
            round(1e6 * output.time_s), m, eta.tolist(), deviation.tolist(), decision.tolist()
        )

    def _status(self, moment: Moment) -> Message:
        output, counters = moment.output, self.counters
        return dialect.MAVLink_nff_companion_status_message(
            round(1e6 * output.time_s),
            counters.samples,
            output.bad_samples,
            counters.bad_frames,
            counters.commands_sent,
            output.rejected,
            int((1 << np.flatnonzero(output.failed)).sum()),
            self.rate_hz,
            self.step_us,
            output.unallocated.tolist(),
            int(moment.asked),
            int(output.mode),
            int(moment.condition.in_force.source),
            moment.verdict.text.encode("ascii", "replace")[: _REASON - 1],
        )

    @staticmethod
    def event(event: Event) -> Message:
        """NFF_FAULT_EVENT."""
        return dialect.MAVLink_nff_fault_event_message(
            round(1e6 * event.time_s), event.motor, int(event.declared), event.effectiveness, event.confidence
        )

    # -- monitor ------------------------------------------------------------------------------------------------

    def line(self, moment: Moment) -> str:
        """One line for the service manager."""
        mode, text = moment.output.mode.name.lower(), moment.verdict.text
        return f"{mode}: {text}; {self.rate_hz:.0f} Hz, step {self.step_us:.0f} us"

    def document(self, moment: Moment, sample_age_s: float | None, speed_faults: list[int]) -> dict[str, Any]:
        """What ``nff status --json`` prints."""
        output, counters = moment.output, self.counters
        plan, network, estimate = output.plan, self.network, output.estimate
        phi_a = None if estimate is None else [round(float(v), 3) for v in estimate.disturbance]
        return {
            "airframe": self.vehicle.name,
            "configured_mode": moment.asked.name.lower(),
            "mode": output.mode.name.lower(),
            "reason": moment.verdict.text,
            "reason_name": moment.verdict.reason.name.lower(),
            "flying": output.flying,
            "motors": self._motors(output),
            "failed": numbers(output.failed),
            "either": list(output.either),
            "among": [list(motors) for motors in output.among],
            "probing": output.probing,
            "more": list(output.more),
            "unresponsive": list(output.unresponsive),
            "weak": {"motors": list(output.weak), "left": round(output.weak_left, 2)} if output.weak else None,
            "worn": None if not output.worn else _worn(output),
            "events": list(self._events),
            "notes": [note.text for note in output.notes],
            "authority": None if plan is None else [round(float(a), 3) for a in plan.authority],
            "unallocated": [round(float(v), 4) for v in output.unallocated],
            "learning": {
                "network": None if network is None else network.label,
                "sighted": None if network is None or estimate is None else estimate.features is not None,
                "residual_explained": None if phi_a is None else dict(zip(AXES, phi_a, strict=True)),
                "balance": balance_numbers(estimate, self.vehicle),
            },
            "airframe_fit": {"trusted": output.trusted, **fit_numbers(output.fit)},
            "rate_hz": round(self.rate_hz, 1),
            "built_for_hz": round(self.built_for_hz, 1),
            "step_us": round(self.step_us, 1),
            "speed_sensor_faults": speed_faults,
            "slow_streams": {n: {"hz": round(h, 1), "asked_hz": a} for n, (h, a) in self.slow_streams.items()},
            "sample_age_s": None if sample_age_s is None else round(sample_age_s, 3),
            "counters": {
                "samples": counters.samples,
                "bad_samples": output.bad_samples,
                "bad_frames": counters.bad_frames,
                "commands_sent": counters.commands_sent,
                "dropped": counters.dropped,
                "unsendable": counters.unsendable,
                "matrices_rejected": output.rejected,
            },
            "autopilot": None if moment.adapter is None else self._autopilot(moment.adapter, moment.condition),
        }

    def _motors(self, output: Output) -> list[dict[str, Any]]:
        known = self.counters.samples > 0
        motors = []
        for index in range(self.vehicle.motors):
            decision = "failed" if output.failed[index] else "degraded" if output.degraded[index] else "healthy"
            motors.append(
                {
                    "motor": index + 1,
                    "effectiveness": round(float(output.effectiveness[index]), 3) if known else None,
                    "deviation": round(float(output.deviation[index]), 3) if known else None,
                    "decision": decision if known else "unknown",
                }
            )
        return motors

    @staticmethod
    def _autopilot(adapter: Adapter, condition: Condition) -> dict[str, Any]:
        in_force = condition.in_force
        return {
            "adapter": adapter.name,
            "system": adapter.target[0],
            "armed": condition.armed,
            "allocation": in_force.source.name.lower(),
            "failed": [] if in_force.failed is None else numbers(in_force.failed),
            "yaw_given_up": in_force.yaw_released,
            "refused": dict(in_force.refused),
        }


def _worn(output: Output) -> dict[str, Any]:
    """The motor that gives less than before, or one of two above each other; ``or_load``: or a load has moved."""
    return {"motors": list(output.worn), "left": round(output.worn_left, 2), "or_load": not output.worn_sure}
