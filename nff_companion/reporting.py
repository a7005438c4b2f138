"""What the companion says of itself: MAVLink status messages, the monitor's document, the service's status line."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from nff_companion.autopilots.base import Adapter
from nff_companion.core.decision import Event
from nff_companion.core.vehicle import AXES, Vehicle
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.pipeline import Mode, Output, Pipeline

_EFFECTIVENESS_S = 0.05
_STATUS_S = 0.2
_WINDOW = 400
_SLOTS = 16
_REASON = 60
SOURCES = ("stock", "declaration", "matrix", "override")


class Reporter:
    """Collects counters and the last output; makes messages when they are due."""

    def __init__(self, vehicle: Vehicle, pipeline: Pipeline) -> None:
        self._vehicle, self._pipeline = vehicle, pipeline
        self.samples = 0
        self.commands_sent = 0
        self.unsendable = 0
        self.slow_streams: dict[str, tuple[float, float]] = {}  # name to rate heard and asked
        self._durations: deque[float] = deque(maxlen=_WINDOW)
        self._arrivals: deque[float] = deque(maxlen=_WINDOW)
        self._output: Output | None = None
        self._events: deque[dict[str, Any]] = deque(maxlen=50)
        self._next_effectiveness = self._next_status = -np.inf

    def step_done(self, output: Output, duration_s: float, now: float) -> None:
        """Note one step."""
        self.samples += 1
        self._durations.append(duration_s)
        self._arrivals.append(now)
        self._output = output
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

    def silent(self, output: Output) -> None:
        """Telemetry stopped: the rate is nought."""
        self._arrivals.clear()
        self._output = output

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

    def _mode(self) -> Mode:
        return Mode.OBSERVE if self._output is None else self._output.mode

    def _reason(self) -> str:
        return "waiting for telemetry" if self._output is None else self._output.reason

    # -- messages -----------------------------------------------------------------------------------------------

    def heartbeat(self) -> Message:
        """Heartbeat of a companion computer."""
        state = dialect.MAV_STATE_ACTIVE if self._mode() != Mode.OBSERVE else dialect.MAV_STATE_STANDBY
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, int(self._mode()), state, 3
        )

    def due(self, now: float, bad_frames: int, adapter: Adapter | None) -> list[Message]:
        """Messages to be sent at ``now``."""
        out: list[Message] = []
        if self._output is not None and now >= self._next_effectiveness:
            self._next_effectiveness = now + _EFFECTIVENESS_S
            out.append(self.effectiveness_message(self._output))
        if now >= self._next_status:
            self._next_status = now + _STATUS_S
            out.append(self.status_message(bad_frames, adapter))
        return out

    def effectiveness_message(self, output: Output) -> Message:
        """NFF_EFFECTIVENESS of the last step."""
        m = self._vehicle.motors
        eta, deviation, decision = np.full(_SLOTS, np.nan), np.full(_SLOTS, np.nan), np.zeros(_SLOTS, int)
        eta[:m], deviation[:m] = output.effectiveness, output.deviation
        decision[:m] = np.where(output.failed, 2, np.where(output.degraded, 1, 0))
        return dialect.MAVLink_nff_effectiveness_message(
            round(1e6 * output.time_s), m, eta.tolist(), deviation.tolist(), decision.tolist()
        )

    def status_message(self, bad_frames: int, adapter: Adapter | None) -> Message:
        """NFF_COMPANION_STATUS."""
        output = self._output
        failed = np.zeros(0, bool) if output is None else output.failed
        unallocated = [0.0] * len(AXES) if output is None else output.unallocated.tolist()
        return dialect.MAVLink_nff_companion_status_message(
            0 if output is None else round(1e6 * output.time_s),
            self.samples,
            self._pipeline.bad_samples,
            bad_frames,
            self.commands_sent,
            self._pipeline.rejected,
            int((1 << np.flatnonzero(failed)).sum()),
            self.rate_hz,
            self.step_us,
            unallocated,
            int(self._pipeline.mode),
            int(self._mode()),
            0 if adapter is None else adapter.applied.source,
            self._reason().encode("ascii", "replace")[: _REASON - 1],
        )

    @staticmethod
    def event_message(event: Event) -> Message:
        """NFF_FAULT_EVENT."""
        return dialect.MAVLink_nff_fault_event_message(
            round(1e6 * event.time_s), event.motor, int(event.declared), event.effectiveness, event.confidence
        )

    def text_of(self, event: Event, verdict: str) -> tuple[str, int]:
        """Text and severity for the pilot; ``verdict``: what was done about it."""
        if event.declared:
            output = self._output
            observing = output is None or output.mode == Mode.OBSERVE
            acting = "observing" if observing else verdict
            text = f"Motor {event.motor} failed (eff {event.effectiveness:.2f}): {acting}"
        else:
            text = f"Motor {event.motor} works again"
        severity = dialect.MAV_SEVERITY_CRITICAL if event.declared else dialect.MAV_SEVERITY_WARNING
        return text, int(severity)

    # -- monitor ------------------------------------------------------------------------------------------------

    def line(self) -> str:
        """One line for the service manager."""
        return f"{self._mode().name.lower()}: {self._reason()}; {self.rate_hz:.0f} Hz, step {self.step_us:.0f} us"

    def _learning(self) -> dict[str, Any]:
        """The basis network, whether it is given what it looks at, and phi a."""
        network = self._pipeline.network
        estimate = None if self._output is None else self._output.estimate
        return {
            "network": None if network is None else network.label,
            "sighted": None if network is None or estimate is None else estimate.features is not None,
            "residual_explained": None
            if estimate is None
            else dict(zip(AXES, (round(float(v), 3) for v in estimate.disturbance), strict=True)),
        }

    def document(self, bad_frames: int, adapter: Adapter | None, sample_age_s: float | None) -> dict[str, Any]:
        """What ``nff status --json`` prints."""
        output = self._output
        applied = None if adapter is None else adapter.applied
        m = self._vehicle.motors
        motors = []
        for index in range(m):
            motors.append(
                {
                    "motor": index + 1,
                    "effectiveness": None if output is None else round(float(output.effectiveness[index]), 3),
                    "deviation": None if output is None else round(float(output.deviation[index]), 3),
                    "decision": "unknown"
                    if output is None
                    else "failed"
                    if output.failed[index]
                    else "degraded"
                    if output.degraded[index]
                    else "healthy",
                }
            )
        plan = None if output is None else output.plan
        return {
            "airframe": self._vehicle.name,
            "configured_mode": self._pipeline.mode.name.lower(),
            "mode": self._mode().name.lower(),
            "reason": self._reason(),
            "flying": output is not None and output.flying,
            "motors": motors,
            "failed": [] if output is None else [int(i) + 1 for i in np.flatnonzero(output.failed)],
            "events": list(self._events),
            "authority": None if plan is None else [round(float(a), 3) for a in plan.authority],
            "unallocated": None if output is None else [round(float(v), 4) for v in output.unallocated],
            "learning": self._learning(),
            "rate_hz": round(self.rate_hz, 1),
            "step_us": round(self.step_us, 1),
            "speed_sensor_faults": self._pipeline.speed_faults,
            "slow_streams": {n: {"hz": round(h, 1), "asked_hz": a} for n, (h, a) in self.slow_streams.items()},
            "sample_age_s": None if sample_age_s is None else round(sample_age_s, 3),
            "counters": {
                "samples": self.samples,
                "bad_samples": self._pipeline.bad_samples,
                "bad_frames": bad_frames,
                "commands_sent": self.commands_sent,
                "unsendable": self.unsendable,
                "matrices_rejected": self._pipeline.rejected,
            },
            "autopilot": None
            if applied is None
            else {
                "adapter": "" if adapter is None else adapter.name,
                "allocation": SOURCES[applied.source] if applied.source < len(SOURCES) else str(applied.source),
                "failed": [] if applied.failed is None else [int(i) + 1 for i in np.flatnonzero(applied.failed)],
                "refused": applied.refused,
            },
        }
