"""Adapter for stock PX4: a failed motor is told by its thrust coefficient, CA_ROTORn_CT.

Parameters outlive a power cycle, so what they were is in a journal on disk from the arming on, and they are restored
when the vehicle disarms, when the companion ends on the ground, and at its next start on the ground. In the air
nothing is restored: a dead motor stays told as dead until the vehicle has landed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from nff_companion.autopilots import times
from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.px4 import examination, findings, rates
from nff_companion.autopilots.px4.examination import Examined, examine
from nff_companion.autopilots.px4.identity import Identity
from nff_companion.autopilots.px4.injection import Injection
from nff_companion.autopilots.px4.parameter_change import ParameterChange
from nff_companion.autopilots.px4.record import Record
from nff_companion.autopilots.px4.telling import Telling
from nff_companion.autopilots.schedule import Command, Declare, Release
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.condition import Condition, InForce, Reason, Statement, first
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import JournalError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader, name_of
from nff_companion.mavlink.services.streams import Stream

_EXAMINE_AGAIN_S = 5.0  # where the journal stands in the way: somebody may remove it
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_TELEMETRY = TelemetryTable(0.0, 0.0)  # HIGHRES_IMU is made from integrated samples, in front of PX4's filters
_DRIVE = Statement(Reason.NO_OUTPUTS_TAKEN, "PX4")

Method = Literal["scale", "inject"]


class Px4Adapter:
    """One vehicle. ``target`` is the autopilot's (system, component); nobody else is listened to."""

    name = "px4"

    def __init__(self, vehicle: Vehicle, target: tuple[int, int], journal_path: Path, method: Method = "scale") -> None:
        """``method``: scale (CA_ROTORn_CT) or inject (MAV_CMD_INJECT_FAILURE: no parameter is changed, but the first
        total failure alone can be told)."""
        self._vehicle, self.target = vehicle, target
        self._decoder = TelemetryDecoder(vehicle)
        self._reader = ParameterReader(examination.names(vehicle), target, bytewise=True)
        self._record = Record(journal_path)
        self._change = ParameterChange(self._reader, target, vehicle.motors)
        self._injection = Injection(vehicle.motors, target) if method == "inject" else None
        self._telling = Telling(self._change, self._record)
        self._identity = Identity(target)
        self._waiting = rates.Waiting()
        self._examined: Examined | None = None
        self._trouble: Statement | None = None  # what the examination found instead
        self._outdated = False  # somebody else has changed the vehicle since
        self._examine_s = -np.inf
        self._armed: bool | None = None
        self._permit = Permit.LISTEN  # as last given
        self._now_s = -np.inf
        self._condition: Condition | None = None  # None: to be made anew

    # -- telemetry ----------------------------------------------------------------------------------------------

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for, at rates that PX4 honours: beyond 125 Hz that is 250 Hz, or what its samples come at."""
        return rates.streams(rate_hz, self._integration_hz)

    @property
    def _integration_hz(self) -> float | None:
        return self._reader.values.get(rates.INTEGRATION)

    def observe(self, message: Message, now_s: float) -> Sample | None:
        """Telemetry, parameters, version, acknowledgements; of the target alone."""
        if (message.get_srcSystem(), message.get_srcComponent()) != self.target:
            return None
        self._now_s = now_s
        kind = message.get_type()
        if kind == "PARAM_VALUE":
            self._parameter(message)
        elif kind == "PARAM_ERROR":
            self._change.heard_error(name_of(message), message.error, now_s)
        elif kind == "AUTOPILOT_VERSION":
            self._identity.observe(message)
        elif kind == "COMMAND_ACK":
            if self._injection is not None:
                self._injection.observe(message, now_s)
        else:
            if kind == "HEARTBEAT":
                self._heartbeat(bool(message.base_mode & _ARMED))
            sample = self._decoder.observe(message)
            return None if sample is None or not self._waiting.over(self._reader, now_s) else sample
        self._condition = None
        return None

    def _heartbeat(self, armed: bool) -> None:
        was, self._armed = self._armed, armed
        if was == armed:
            return
        self._condition = None
        if armed:
            self._keep_record()
        elif was:
            self._undo()

    def _parameter(self, message: Message) -> None:
        before = self._reader.values.get(name_of(message))
        name = self._reader.observe(message)
        if name is None:
            return
        changed = before != self._reader.values[name] if before is not None else self._trouble is not None
        self._outdated |= changed and name not in self._change.touched
        self._renew()
        self._change.heard(name, self._now_s)

    def _renew(self) -> None:
        """Somebody else has changed the vehicle, or mended what was wrong with it: it is looked at anew, though not
        while it is changed by us."""
        if self._outdated and not self._change.touched:
            self._examined, self._trouble, self._outdated = None, None, False
            self._change.begin({}, ())

    # -- start and end ------------------------------------------------------------------------------------------

    def _examine(self) -> None:
        """Everything is known: what was found, and what an earlier run left behind."""
        self._examine_s = self._now_s
        try:
            left = [] if self._record.ours else self._record.read(self._identity.autopilot)
        except JournalError as error:
            self._trouble = Statement(Reason.JOURNAL, str(error))
            return
        values, injecting = self._reader.values, self._injection is not None
        found = examine(values, self._vehicle, left, injecting=injecting)
        self._trouble = found if isinstance(found, Statement) else None
        version = self._identity.version
        if self._injection is not None and version is not None and self._trouble is None:
            useless = self._injection.prepare(version, values)
            self._trouble = Statement(Reason.CONTRADICTION, useless) if useless else None
        if self._trouble is not None or isinstance(found, Statement):
            return
        self._examined = found
        self._change.begin(found.found, found.found if found.left else ())
        if not found.left:
            return
        self._record.take_over(found.found)
        if self._armed is False:
            self._undo()
        else:
            # Back in the air: what was told stays told, and is not told again.
            self._telling.take_over(self._change.shares(), self._now_s)

    def _keep_record(self) -> None:
        """The journal is on the disk before anything can be changed: from the arming on, by who may act."""
        if self._injection is not None or self._examined is None or not self._armed or self._permit < Permit.ACT:
            return
        found = self._examined.found
        if not self._record.covers(found):
            self._record.write(self._identity.autopilot, found, self._reader.kinds, self._now_s)

    def _undo(self) -> None:
        """Everything of ours is to be taken back."""
        if self._injection is not None:
            self._injection.lift()
        self._telling.forget()
        if self._change.touched:
            self._change.restore(self._now_s)

    def _tidy(self) -> None:
        """On the ground: what turned out changed after all, and the journal when nothing is."""
        if self._change.touched:
            self._change.insist(self._now_s)
            if not self._change.restored(self._now_s):
                return
            self._change.touched.clear()
            self._renew()
        if self._record.ours:
            self._record.clear(self._now_s)

    def due(self, now_s: float, permit: Permit) -> list[Message]:
        """Version and parameters until they are known; what is wanted until it is confirmed."""
        self._now_s, self._permit, self._condition = now_s, permit, None
        if self._injection is None:
            self._record.try_out(now_s)
        if self._identity.version is None:
            return self._identity.due(now_s)
        out = self._reader.tick(now_s)
        self._look(now_s)
        if permit == Permit.LISTEN:
            return out
        self._keep_record()
        if self._armed is False:
            self._tidy()
        if permit == Permit.ACT and self._armed and self._examined is not None and self._injection is None:
            out += self._telling.put_off(self._examined, now_s)
        # Tidying too finishes what was begun: half of a declaration flies worse than all of it or none.
        out += self._change.due(now_s)
        if self._injection is not None:
            out += self._injection.due(now_s, permit)
        return out

    def _look(self, now_s: float) -> None:
        if not self._reader.complete or self._armed is None:
            return
        journal = self._trouble is not None and self._trouble.reason == Reason.JOURNAL
        again = journal and now_s >= self._examine_s + _EXAMINE_AGAIN_S
        if self._examined is None and (self._trouble is None or again):
            self._examine()
        elif self._examined is not None and self._armed is False:
            self._examined.remedies.prepare_one()

    # -- commands -----------------------------------------------------------------------------------------------

    def encode(self, command: Command) -> list[Message]:
        """Declarations, in the air alone; the same one again sends only what is not confirmed. Nothing else is taken:
        a release restores on the ground, by ``due``."""
        self._condition = None
        if isinstance(command, Release):
            self._telling.put_nothing_off()
            if self._armed is False:
                self._undo()
            return []
        if not isinstance(command, Declare) or self._examined is None or not self._armed or self._blocked() is not None:
            return []
        if self._injection is not None:
            return self._injection.tell(command.effectiveness, self._examined.advisor, self._now_s)
        return self._telling.tell(command.effectiveness, self._examined, self._now_s)

    def _blocked(self) -> Statement | None:
        """Why no command may be sent."""
        unknown = self._identity.unknown()
        if unknown is not None:
            return unknown
        if self._examined is None:
            return self._trouble or Statement(Reason.READING)
        lost = self._record.trouble and not self._record.covers(self._examined.found)
        return Statement(Reason.JOURNAL, self._record.trouble) if lost else None

    # -- condition ----------------------------------------------------------------------------------------------

    def condition(self, now_s: float) -> Condition:
        """How PX4 is; made anew only when something was heard, sent or became due."""
        self._now_s = now_s
        if self._condition is None:
            self._condition = self._make_condition(now_s)
        return self._condition

    def _make_condition(self, now_s: float) -> Condition:
        return Condition(
            armed=self._armed,
            command=self._blocked(),
            drive=_DRIVE,
            untold=self._untold(now_s),
            in_force=self._in_force(),
            telemetry=_TELEMETRY,
            notes=findings.notes(self._change, self._record, on_ground=self._armed is False, permit=self._permit),
            unfinished=self._unfinished(),
        )

    def _in_force(self) -> InForce:
        if self._examined is None:
            return InForce()
        return self._change.in_force() if self._injection is None else self._injection.in_force()

    def _untold(self, now_s: float) -> Statement | None:
        if self._injection is not None:
            return self._injection.untold
        if not self._armed:
            return None
        refused = ", ".join(self._change.refused.values())
        late = self._change.unconfirmed_s(now_s) > times.CONFIRM_MAX_S
        return first(
            self._telling.untold,
            Statement(Reason.NOT_TOLD, refused) if refused else None,
            Statement(Reason.NOT_CONFIRMED, ", ".join(self._change.pending)) if late else None,
        )

    def _unfinished(self) -> bool:
        """Whether something of ours is changed that could be restored now."""
        if self._armed is not False:
            return False
        lifting = self._injection is not None and self._injection.unfinished
        return lifting or ((bool(self._change.touched) or self._record.ours) and not self._change.refused)

    def findings(self) -> list[Finding]:
        """Version, rotors, a journal that is left over, and whether one can be written."""
        return [
            findings.of_version(self._identity.version),
            findings.of_rotors(self._trouble, read=self._examined is not None),
            findings.of_journal(self._change, self._trouble, armed=bool(self._armed), permit=self._permit),
            *([] if self._injection is not None else [findings.of_state_folder(self._record)]),
        ]
