"""The only loop: messages and a time in, messages out. No socket, no clock: daemon, doctor and trials are its users.

link -> telemetry -> residual -> estimate -> decision -> allocation -> command -> link, once a sample: in ``take`` what
answers it, in ``think`` the rest; what is due between samples in ``due``. Times ``now_s`` are of one monotonic clock,
whichever.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots import schedule
from nff_companion.autopilots.base import Adapter, Finding, Permit
from nff_companion.autopilots.meeting import Meeting
from nff_companion.autopilots.schedule import Command, Drive, ScheduleState
from nff_companion.calibration.recorder import FlightRecorder
from nff_companion.companion import Companion
from nff_companion.companion_state import NO_ORDERS, Orders, Output
from nff_companion.condition import Condition, Mode, Reason, Statement
from nff_companion.core.decision import Event
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning
from nff_companion.mavlink.codec import Message
from nff_companion.mavlink.services.parameter_server import ParameterServer
from nff_companion.reporting import Moment, Reporter
from nff_companion.settings import settings
from nff_companion.vehicle_link import Outgoing, VehicleLink
from nff_companion.verdict import Confirmation, numbers, verdict
from nff_companion.voice import Voice

_LOOK_S = 1.0
_GONE_S = 5.0  # without a sample: whoever was being helped is out of reach
_NOTHING = Condition()


@dataclass(frozen=True, slots=True)
class _Pending:
    """A sample that was answered and not yet estimated from."""

    adapter: Adapter
    sample: Sample
    answer: NDArray[np.float64] | None
    now_s: float


@dataclass(frozen=True, kw_only=True)
class SessionOptions:
    """``act`` False: a check before the flight, which asks and listens and changes nothing."""

    mode: Mode = Mode.OBSERVE
    rate_hz: float = 200.0
    component: int = 191
    system: int = 0  # of the vehicle; 0: the one that is heard
    stream_timeout_s: float = 0.25
    act: bool = True
    network_note: str = ""  # why the network that the airframe file names is not used


class Session:
    """One companion and the vehicle that it meets."""

    def __init__(
        self,
        companion: Companion,
        meeting: Meeting,
        options: SessionOptions,
        now_s: float,
        host_status: Callable[[], Message] | None = None,
        recorder: FlightRecorder | None = None,
    ) -> None:
        """``host_status`` makes ONBOARD_COMPUTER_STATUS, where there is a computer to speak of; ``recorder`` keeps what
        a calibration may use of the flights."""
        self._companion, self._options, self.recorder = companion, options, recorder
        self.state = companion.start(options.mode)
        self._orders = NO_ORDERS
        self._schedule = ScheduleState.start(companion.vehicle.motors)
        self._confirmation = Confirmation()
        self._unconfirmed_s: float | None = None
        self._link = VehicleLink(
            meeting,
            system=options.system,
            component=options.component,
            rate_hz=options.rate_hz,
            tuning=companion.tuning.sample_rate,
        )
        self._met: Adapter | None = None  # the adapter that the state below belongs to
        self._met_system: int | None = None
        self._sample_s = -np.inf  # of our clock
        self._sample_time_s: float | None = None  # of the autopilot's clock
        self._lost, self._adopted, self._engaged = True, False, False
        self._condition = _NOTHING
        self._parameters = ParameterServer(
            settings(
                companion.vehicle.motors,
                lambda: self.state.mode,
                self._obey,
                lambda: self._companion.tuning,
                self._retune,
            ),
            options.component,
        )
        self.reporter = Reporter(companion.vehicle, companion.network, meeting.instance)
        self.reporter.built_for_hz = companion.rate_hz
        self._voice = Voice(self.reporter, host_status, act=options.act)
        self._next_look_s = -np.inf
        self._now_s = now_s
        self._pending: _Pending | None = None
        self._news: list[tuple[float, Event]] = []
        self._out: list[Outgoing] = []

    # -- what is known ------------------------------------------------------------------------------------------

    @property
    def output(self) -> Output:
        """Of the last step."""
        return self.state.last

    @property
    def companion(self) -> Companion:
        """As it is built now."""
        return self._companion

    @property
    def adapter(self) -> Adapter | None:
        """Of the vehicle adopted."""
        return self._link.adapter

    @property
    def system(self) -> int | None:
        """Of the vehicle adopted."""
        return self._link.system

    def _acting(self, now_s: float) -> bool:
        """Whether this flight has been helped: until it ends, or the vehicle is out of reach, it stays ours."""
        return self._engaged and now_s - self._sample_s <= _GONE_S

    def autopilot_time_s(self, now_s: float) -> float:
        """The autopilot's clock: of the last sample, and as much later as our clock says."""
        if not np.isfinite(self._sample_s):
            return self.output.time_s
        return self.output.time_s + max(now_s - self._sample_s, 0.0)

    def news(self) -> list[tuple[float, Event]]:
        """Declarations and their lifting since the last call, with the time of our clock."""
        news, self._news = self._news, []
        return news

    def moment(self) -> Moment:
        """All that there is to say now."""
        output, condition = self.output, self._condition
        said = verdict(output, condition, self.state.mode, self._companion.parts, self._unconfirmed_s)
        if said.reason == Reason.TELEMETRY_STOPPED:
            said = self._link.instead() or said
        return Moment(output, condition, self.state.mode, said, self.adapter)

    def document(self, now_s: float) -> dict[str, Any]:
        """For the monitor."""
        age = now_s - self._sample_s
        faults = self._companion.speed_faults(self.state)
        document = self.reporter.document(self.moment(), age if np.isfinite(age) else None, faults)
        trip = self._link.round_trip_s
        document["round_trip_ms"] = None if trip is None else round(1e3 * trip, 2)
        return document

    def findings(self, now_s: float) -> list[Finding]:
        """What a check before the flight has found."""
        adapter = self.adapter
        if adapter is None:
            return [Finding("link", False, "no autopilot heard")]
        out = [Finding("link", True, f"autopilot of system {adapter.target[0]}, adapter {adapter.name}")]
        if self._condition.armed:
            out.append(Finding("armed", False, "the vehicle is armed: nothing was asked of it; disarm and try again"))
        out += self._link.findings(now_s)
        network = self._companion.network
        used = "none: a constant basis" if network is None else network.label
        out.append(Finding("network", True, "; ".join(filter(None, (used, self._options.network_note)))))
        out += adapter.findings()
        return [*out, self._link.rates(now_s, self._companion.rate_hz)]

    # -- in -----------------------------------------------------------------------------------------------------

    def take(self, message: Message, port: int, now_s: float) -> list[Outgoing]:
        """One message that has arrived at a port; what is to be sent, and then ``think``."""
        self._estimated()
        self._now_s = now_s
        kind = message.get_type()
        ours = self._link.hear(message, now_s, acting=self._acting(now_s))
        adapter = self.adapter
        if adapter is not self._met:
            self._meet(adapter, now_s)
        if kind == "HEARTBEAT":
            self._send_all(self._voice.notes(self._link.vehicles_heard(), now_s))
        elif kind == "TIMESYNC":
            self._out += self._link.synchronised(message, port, now_s)
        elif kind.startswith("PARAM_"):
            self._send_all(self._parameters.answer(message), port)
        if adapter is None and self._options.act:
            self._out += self._link.ask_who(message, port, now_s)
        if not ours or adapter is None or not self._link.takes(message, port, now_s):
            return self._flushed()
        sample = adapter.observe(message, now_s)
        if sample is not None:
            self._answered(adapter, sample, now_s)
        return self._flushed()

    def think(self) -> list[Outgoing]:
        """Estimate from the sample that was taken last, once its answer is on its way; what is to be sent. Whoever does
        not call this is served at the next ``take``, ``order``, ``due`` or ``leave``."""
        self._estimated()
        return self._flushed()

    def order(self, orders: Orders, now_s: float) -> list[Outgoing]:
        """The operator's word, at once; what is to be sent."""
        self._estimated()
        self._now_s = now_s
        self._obey(orders)
        return self._flushed()

    def tell(self, note: Statement, now_s: float) -> list[Outgoing]:
        """Something for the pilot that was found out beside the loop; what is to be sent."""
        self._send_all(self._voice.notes([note], now_s))
        return self._flushed()

    def _obey(self, orders: Orders) -> None:
        self.state, output = self._companion.step(self.state, None, self._condition, orders)
        adapter = self.adapter
        if adapter is not None and np.isfinite(self._sample_s):
            time_s = self.autopilot_time_s(self._now_s)
            if orders.lift:
                self._schedule = schedule.lifted(self._schedule, orders.lift, time_s)
            if orders.mode == Mode.OBSERVE and not self._elsewhere():
                self._schedule, commands = schedule.released(self._schedule, time_s)
                self._command(adapter, commands)
            self._commands(adapter, output, time_s)

    def _retune(self, tuning: Tuning) -> bool:
        """Other tuning, from the next flight on; False in flight, when nothing changes."""
        if self.state.watching or self.state.phase.flying:
            return False
        self._rebuild(self._companion.rebuilt(tuning=tuning))
        return True

    def leave(self, now_s: float) -> list[Outgoing]:
        """The end: the vehicle is given back; confirmed declarations stay."""
        self._estimated()
        adapter = self.adapter
        if adapter is not None and np.isfinite(self._sample_s) and not self._elsewhere():
            self._schedule, commands = schedule.released(self._schedule, self.autopilot_time_s(now_s), leaving=True)
            self._command(adapter, commands)
        return self._flushed()

    def unfinished(self, now_s: float) -> bool:
        """Whether the end must wait for the autopilot to confirm something."""
        return self.adapter is not None and self.adapter.condition(now_s).unfinished

    # -- one sample ---------------------------------------------------------------------------------------------

    def _answered(self, adapter: Adapter, sample: Sample, now_s: float) -> None:
        """What answers the sample at once; what is to be estimated from it waits in ``_pending``."""
        if self._lost and sample.time_s == self._sample_time_s:
            return  # the same again and again is silence
        self._link.sampled(sample.time_s)
        if not self.state.watching:
            self._agree()
        condition = self._condition = self._conditioned(adapter, now_s)
        orders = self._taken_over(condition)
        if orders is not NO_ORDERS:
            self.state, _ = self._companion.step(self.state, None, condition, orders)
        self.state, answer = self._companion.respond(self.state, sample, condition)
        if answer is not None and self._options.act:
            self._command(adapter, [Drive(sample.time_s, answer)])
        self._pending = _Pending(adapter, sample, answer, now_s)

    def _estimated(self) -> None:
        """The step that the last sample asked for, once."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        sample, now_s, condition = pending.sample, pending.now_s, self._condition
        self.state, output = self._companion.step(self.state, sample, condition, override=pending.answer)
        self._commands(pending.adapter, output, output.time_s)
        if self.recorder is not None:
            self._record(self.recorder, sample)
        if sample.time_s != self._sample_time_s:
            self._sample_time_s, self._sample_s, self._lost = sample.time_s, now_s, False
        self._engaged = self.state.phase.flying and (self._engaged or (output.flying and output.mode != Mode.OBSERVE))
        self._unconfirmed_s = self._confirmation.step(output, condition, now_s)
        self.reporter.step_done(output, now_s)
        for event in output.events:
            self._news.append((now_s, event))
            self._send_all(self._voice.event(event, now_s))
        self._say_verdict(now_s)

    def _record(self, recorder: FlightRecorder, sample: Sample) -> None:
        """What a calibration may use: samples of a whole vehicle in flight."""
        state = self.state
        if not sample.armed:
            recorder.landed()
        elif state.whole:
            recorder.add(sample)
        elif state.failed.any():
            recorder.spoil()

    def _commands(self, adapter: Adapter, output: Output, time_s: float) -> None:
        self._schedule, commands = schedule.steps(self._schedule, output, self._condition, time_s)
        self._command(adapter, commands)

    def _command(self, adapter: Adapter, commands: Iterable[Command]) -> None:
        if not self._options.act:
            return
        for command in commands:
            for message in adapter.encode(command):
                self._out.append(Outgoing(message, self._link.port))
                self.reporter.counters.commands_sent += 1

    def _conditioned(self, adapter: Adapter, now_s: float) -> Condition:
        acting, built_hz = self._acting(now_s), self._companion.rate_hz
        return self._link.condition(adapter, now_s, acting=acting, built_hz=built_hz)

    def _elsewhere(self) -> bool:
        """Whether the vehicle is somebody else's now."""
        return self._link.elsewhere(self._condition)

    def _taken_over(self, condition: Condition) -> Orders:
        """After a restart in flight, or when another companion is gone, the autopilot knows better than we do what has
        been declared; what an earlier flight has left behind on the ground is not taken over."""
        held = condition.in_force.failed
        if self._elsewhere():
            self._adopted = False
        elif not self._adopted and held is not None:
            self._adopted = True
            return Orders(adopt=tuple(numbers(held))) if condition.armed else NO_ORDERS
        return NO_ORDERS

    # -- who is there -------------------------------------------------------------------------------------------

    def _agree(self) -> None:
        """Between flights the companion is built for the samples and the filters that there are."""
        built, telemetry = self._companion, self._condition.telemetry
        rate = self._link.rate_to_build_for(built.rate_hz)
        if rate != built.rate_hz or (telemetry is not None and telemetry != built.vehicle.telemetry):
            self._rebuild(built.rebuilt(rate_hz=rate, telemetry=telemetry))

    def _rebuild(self, companion: Companion) -> None:
        self._companion = companion
        self._link.retune(companion.tuning.sample_rate)
        self.reporter.built_for_hz = companion.rate_hz

    def _meet(self, adapter: Adapter | None, now_s: float) -> None:
        """Another vehicle, or another adapter for it: what was agreed with the last one does not hold."""
        self._met = adapter
        self._condition = _NOTHING
        self._schedule = ScheduleState.start(self._companion.vehicle.motors)
        self._lost, self._adopted, self._engaged = True, False, False
        self._sample_s = -np.inf
        if adapter is None:
            self.state, _ = self._companion.interrupted(self.state, _NOTHING, Statement(Reason.WAITING))
            return
        if self._met_system not in (None, adapter.target[0]):
            self.state = self._companion.start(self.state.mode)
            if self.recorder is not None:
                self.recorder.forget()
        self._met_system = adapter.target[0]
        self._condition = self._conditioned(adapter, now_s)
        self._parameters.adopt(adapter.target[0])
        if not self.state.watching and self._link.agreed_hz != self._companion.rate_hz:
            self._rebuild(self._companion.rebuilt(rate_hz=self._link.agreed_hz))

    # -- between samples ----------------------------------------------------------------------------------------

    def due(self, now_s: float) -> list[Outgoing]:
        """What is due at ``now_s``, whether or not anything arrives."""
        self._estimated()
        self._now_s = now_s
        self._link.tick(now_s, acting=self._acting(now_s))
        if self.adapter is not self._met:
            self._meet(self.adapter, now_s)
        adapter = self.adapter
        if not self._lost and now_s - self._sample_s > self._options.stream_timeout_s:
            self._silence(now_s)
        if adapter is not None:
            if self._may_ask() and not self.state.fault:  # else whoever relies on us must see that we do not watch
                self._send_all(adapter.due(now_s, self._permit()), self._link.port)
            if self._lost and self._schedule.lifted is not None:
                self._condition = self._conditioned(adapter, now_s)
                self._commands(adapter, self.output, self.autopilot_time_s(now_s))
        self._introduce(now_s)
        if adapter is not None and now_s >= self._next_look_s:
            self._next_look_s = now_s + _LOOK_S
            self._look(adapter, now_s)
        return self._flushed()

    def _silence(self, now_s: float) -> None:
        self._lost = True
        why = Statement(Reason.TELEMETRY_STOPPED)
        self.state, output = self._companion.interrupted(self.state, self._condition, why)
        self._link.silent()
        self.reporter.silent()
        self._unconfirmed_s = self._confirmation.step(output, self._condition, now_s)
        self._say_verdict(now_s)

    def _may_ask(self) -> bool:
        """A check before the flight asks nothing of an armed vehicle."""
        return self._options.act or not self._condition.armed

    def _permit(self) -> Permit:
        if not self._options.act:
            return Permit.LISTEN
        acts = self.state.mode != Mode.OBSERVE and self._condition.command is None
        return Permit.ACT if acts else Permit.TIDY

    def _introduce(self, now_s: float) -> None:
        """Claim the vehicle; heartbeat, status, and how the computer fares."""
        able = self._options.act and not self.state.fault and self.state.mode != Mode.OBSERVE
        changed = self._link.claim(now_s, acting=self._acting(now_s), able=able)
        well = not self.state.fault
        self._send_all(self._voice.due(self.moment, self._link.rank, now_s, well=well, changed=changed))

    def _look(self, adapter: Adapter, now_s: float) -> None:
        """Once a second: ask for streams that do not come, and what the pilot should know of link and adapter."""
        if self._may_ask():
            self._send_all(self._link.requests(adapter, now_s), self._link.port)
        if self._lost or not self._options.act:
            self._condition = self._conditioned(adapter, now_s)
        if not self._options.act:
            return
        self.reporter.slow_streams = {} if self._lost else self._link.slow_streams(now_s)
        self._send_all(self._voice.slow_streams(self.reporter.slow_streams, now_s))
        notes = [*self._link.notes(now_s), *adapter.condition(now_s).notes, *self.output.notes]
        notes += [Statement(Reason.SPEED_SENSOR, str(m)) for m in self._companion.speed_faults(self.state)]
        self._send_all(self._voice.notes(notes, now_s))

    # -- out ----------------------------------------------------------------------------------------------------

    def _say_verdict(self, now_s: float) -> None:
        if self._options.act:
            self._send_all(self._voice.verdict(self.moment().verdict, now_s))

    def _send_all(self, messages: Iterable[Message], port: int | None = None) -> None:
        """Through one port, or all."""
        self._out += [Outgoing(message, port) for message in messages]

    def _flushed(self) -> list[Outgoing]:
        out, self._out = self._out, []
        return out
