"""Whom we hear: which vehicle, through which port, at what rate, and which other companions.

Decides whose messages are taken; what they say is the adapter's, and what is done about it the session's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from msgspec.structs import replace

from nff_companion.autopilots.adoption import Adoption
from nff_companion.autopilots.base import Adapter, Finding
from nff_companion.autopilots.meeting import Meeting
from nff_companion.autopilots.port import PortChoice
from nff_companion.autopilots.twins import Rank, Twins
from nff_companion.condition import Condition, Reason, Statement, first
from nff_companion.core.sample_rate import Agreement
from nff_companion.core.tuning import SampleRateTuning
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.streams import Stream, StreamMonitor
from nff_companion.mavlink.services.timesync import TimeSync

_ASK_WHO_S = 0.2
_ELSEWHERE = (Reason.TWIN, Reason.AMBIGUOUS)  # somebody else may be commanding this vehicle


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message to be sent through one port, None: through all."""

    message: Message
    port: int | None = None


class VehicleLink:
    """``now_s`` of our clock; ``acting``: this flight is being helped, and nothing may change now."""

    def __init__(
        self, meeting: Meeting, *, system: int, component: int, rate_hz: float, tuning: SampleRateTuning
    ) -> None:
        """``system`` of the vehicle, 0: the one that is heard; ``component``: ours; ``rate_hz`` to be asked for."""
        self._adoption, self._twins = Adoption(meeting, system), Twins(meeting.instance)
        self._sync, self._streams, self._ports = TimeSync(component), StreamMonitor(), PortChoice()
        self._asked_hz, self._tuning, self._rate = rate_hz, tuning, Agreement(rate_hz, tuning)
        self._met: Adapter | None = None  # the adapter that streams, port and rate belong to
        self._met_system: int | None = None
        self._sampled = False  # since that adapter was met
        self._asked_who_s = -float("inf")

    # -- what is known ------------------------------------------------------------------------------------------

    @property
    def adapter(self) -> Adapter | None:
        """Of the vehicle adopted."""
        return self._adoption.adapter

    @property
    def system(self) -> int | None:
        """Of the vehicle adopted."""
        return self._adoption.system

    @property
    def port(self) -> int | None:
        """Where the vehicle is heard."""
        return self._ports.port

    @property
    def rank(self) -> Rank:
        """Ours among companions."""
        return self._twins.rank

    @property
    def round_trip_s(self) -> float | None:
        """To the autopilot and back; None while unknown."""
        return self._sync.round_trip_s

    @property
    def agreed_hz(self) -> float:
        """Rate of samples that was agreed with the autopilot."""
        return self._rate.agreed_hz

    def condition(self, adapter: Adapter, now_s: float, *, acting: bool, built_hz: float) -> Condition:
        """The adapter's word, and what stands in the way besides; ``built_hz``: what the estimator is built for."""
        condition, samples = adapter.condition(now_s), self.rate_off(built_hz)
        mine = first(self._twins.obstacle(now_s, acting=acting), self._adoption.obstacle(acting=acting))
        if mine is None and samples is None:
            return condition
        return replace(condition, command=first(mine, condition.command), samples=samples)

    @staticmethod
    def elsewhere(condition: Condition) -> bool:
        """Whether the vehicle is somebody else's now."""
        return condition.command is not None and condition.command.reason in _ELSEWHERE

    def rate_to_build_for(self, built_hz: float) -> float:
        """Between flights: the rate that an estimator built for ``built_hz`` should be built for."""
        return self._rate.build_for(built_hz)

    def rate_off(self, built_hz: float) -> Statement | None:
        """Why the samples are not those that an estimator built for ``built_hz`` can take."""
        measured = self._rate.off_hz(built_hz)
        return None if measured is None else Statement(Reason.RATE, f"{measured:.0f} instead of {built_hz:.0f}")

    def slow_streams(self, now_s: float) -> dict[str, tuple[float, float]]:
        """Streams that do not come as asked: name to (rate heard, rate asked)."""
        return {} if self.adapter is None else self._streams.slow(self._wanted(self.adapter), now_s)

    def notes(self, now_s: float) -> list[Statement]:
        """What the pilot should hear of other companions."""
        return self._twins.notes(now_s)

    def vehicles_heard(self) -> list[Statement]:
        """What the pilot should hear of other vehicles."""
        return self._adoption.notes()

    def instead(self) -> Statement | None:
        """Who else is heard, now that the vehicle's telemetry has stopped."""
        return self._adoption.instead()

    def findings(self, now_s: float) -> list[Finding]:
        """Who else is there."""
        obstacles = (self._adoption.obstacle(acting=False), self._twins.obstacle(now_s, acting=False))
        return [Finding("vehicle", False, obstacle.text) for obstacle in obstacles if obstacle is not None]

    def rates(self, now_s: float, built_hz: float) -> Finding:
        """Whether everything comes as it was asked for."""
        wrong = [f"{name} {rate:.0f} of {asked:.0f} Hz" for name, (rate, asked) in self.slow_streams(now_s).items()]
        off = self.rate_off(built_hz)
        wrong += [] if off is None else [off.text]
        return Finding("rates", not wrong, ", ".join(wrong) or f"all streams at {self.agreed_hz:.0f} Hz")

    # -- in -----------------------------------------------------------------------------------------------------

    def hear(self, message: Message, now_s: float, *, acting: bool) -> bool:
        """One message of anybody; whether it is of the autopilot adopted. Who that is may have changed then."""
        self._twins.hear(message, self.system, now_s)
        ours = self._adoption.hear(message, now_s, acting=acting)
        self._follow()
        return ours

    def takes(self, message: Message, port: int, now_s: float) -> bool:
        """Whether a message of the autopilot adopted is taken at this port."""
        number = message.get_msgId()
        taken = self._ports.takes(port, sample=number == dialect.MAVLINK_MSG_ID_HIGHRES_IMU, now_s=now_s)
        if taken:
            self._streams.heard(number, now_s)
        return taken

    def synchronised(self, message: Message, port: int, now_s: float) -> list[Outgoing]:
        """The answer to a TIMESYNC."""
        return [Outgoing(answer, port) for answer in self._sync.observe(message, round(1e9 * now_s))]

    def ask_who(self, message: Message, port: int, now_s: float) -> list[Outgoing]:
        """A vehicle that is heard, but not yet known: after a restart in flight nobody waits for its next heartbeat."""
        target = (message.get_srcSystem(), dialect.MAV_COMP_ID_AUTOPILOT1)
        known = self._adoption.knows(target[0]) or message.get_srcComponent() != target[1]
        if known or now_s - self._asked_who_s < _ASK_WHO_S:
            return []
        self._asked_who_s = now_s
        values = (0, float(dialect.MAVLINK_MSG_ID_HEARTBEAT), *[0.0] * 6)
        request = dialect.MAVLink_command_long_message(*target, dialect.MAV_CMD_REQUEST_MESSAGE, *values)
        return [Outgoing(request, port)]

    def sampled(self, time_s: float) -> None:
        """A sample came, of this time of the autopilot's clock."""
        if self._met is not None and not self._sampled:
            # The adapter may know better by now than when it was met.
            self._sampled = True
            expected_hz = _sample_rate(self._wanted(self._met), self._asked_hz)
            if expected_hz != self._rate.agreed_hz:
                self._rate = Agreement(expected_hz, self._tuning)
        self._rate.add(time_s)

    def silent(self) -> None:
        """Samples have stopped: what is asked for again, may come at another rate."""
        self._rate.restart()
        self._streams.ask_again()

    def retune(self, tuning: SampleRateTuning) -> None:
        """Other numbers from now on: the rate is measured anew."""
        if tuning != self._tuning:
            self._tuning, self._rate = tuning, Agreement(self._rate.agreed_hz, tuning)

    # -- time passes --------------------------------------------------------------------------------------------

    def tick(self, now_s: float, *, acting: bool) -> None:
        """Who is silent is forgotten."""
        self._adoption.tick(now_s, acting=acting)
        self._follow()

    def claim(self, now_s: float, *, acting: bool, able: bool) -> bool:
        """Claim the vehicle among companions, or give it up; whether our rank changed."""
        return self._twins.step(now_s, acting=acting, able=able)

    def requests(self, adapter: Adapter, now_s: float) -> list[Message]:
        """For the time, and for streams that do not come."""
        out = self._sync.tick(round(1e9 * now_s))
        return [*out, *self._streams.requests(self._wanted(adapter), adapter.target, now_s)]

    def _wanted(self, adapter: Adapter) -> list[Stream]:
        return adapter.streams(self._asked_hz)

    def _follow(self) -> None:
        """Another vehicle, or another adapter for it: what was measured of the last one does not hold."""
        adapter = self._adoption.adapter
        if adapter is self._met:
            return
        self._met, self._sampled = adapter, False
        self._rate.restart()
        if adapter is None:
            return
        if self._met_system != adapter.target[0]:
            self._streams = StreamMonitor()
        self._met_system = adapter.target[0]
        self._streams.ask_again()
        self._ports = PortChoice()
        self._sync.adopt(adapter.target[0])
        self._rate = Agreement(_sample_rate(self._wanted(adapter), self._asked_hz), self._tuning)


def _sample_rate(streams: Iterable[Stream], otherwise_hz: float) -> float:
    """Rate of the inertial samples among the streams asked for."""
    rates = [s.rate_hz for s in streams if s.message_id == dialect.MAVLINK_MSG_ID_HIGHRES_IMU]
    return rates[0] if rates else otherwise_hz
