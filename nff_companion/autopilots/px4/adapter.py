"""Adapter for stock PX4: a failed motor is told by its thrust coefficient, CA_ROTORn_CT.

Parameters outlive a power cycle, so what they were is in a journal on disk before the first one is changed, and they
are restored when the vehicle disarms, when the companion ends on the ground, and at its next start on the ground. In
the air nothing is restored: a dead motor stays told as dead until the vehicle has landed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from nff_companion.autopilots.base import Applied, Capabilities, Finding, Stream
from nff_companion.autopilots.px4 import outputs
from nff_companion.autopilots.px4.injection import INJECTION_NEEDS, Injection
from nff_companion.autopilots.px4.journal import Entry, Journal
from nff_companion.autopilots.px4.remedy import Advisor, NoRemedy, Remedy, disagreement, geometry_of
from nff_companion.autopilots.px4.remedy_book import RemedyBook
from nff_companion.autopilots.px4.versions import behaviour, version_of
from nff_companion.autopilots.telemetry_decoder import TelemetryDecoder
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import TelemetryTable, Vehicle
from nff_companion.errors import JournalError
from nff_companion.mavlink.codec import Message, dialect
from nff_companion.mavlink.services.parameter_reader import ParameterReader, encode
from nff_companion.pipeline import Mode, Output

_RATE_MAX_HZ = 250.0
_RESEND_S = 0.05
_VERSION_INTERVAL_S = 0.5
_CHANGE_MIN = 0.15  # of a motor's effectiveness: each change wears the parameter storage
_CHANGE_INTERVAL_S = 1.0
_DEAD = 0.05  # a CT below this share of what it was counts as declared dead
_SUFFIXES = ("PX", "PY", "PZ", "AX", "AY", "AZ", "CT", "KM")
_REAL = int(dialect.MAV_PARAM_TYPE_REAL32)
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED


Method = Literal["scale", "inject"]


def _same(value: float, other: float) -> bool:
    """Equal as PX4 stores it, in 32 bits."""
    return abs(value - other) <= 1e-5 * abs(other) + 1e-6


class Px4Adapter:
    """One vehicle. ``target`` is the autopilot's (system, component)."""

    name = "px4"
    farewell_s = 2.0

    def __init__(self, vehicle: Vehicle, target: tuple[int, int], journal: Path, method: Method = "scale") -> None:
        """``method``: scale (CA_ROTORn_CT) or inject (MAV_CMD_INJECT_FAILURE: no parameter is changed, but the first
        total failure alone can be told)."""
        self._vehicle, self.target = vehicle, target
        self.capabilities = Capabilities(declare=True, matrix=False, outputs=False)
        self.applied = Applied()
        self._decoder = TelemetryDecoder(vehicle)
        rotors = [f"CA_ROTOR{i}_{suffix}" for i in range(vehicle.motors) for suffix in _SUFFIXES]
        others = ["CA_ROTOR_COUNT", "CA_METHOD", "MC_AIRMODE", "THR_MDL_FAC", *INJECTION_NEEDS]
        names = [*rotors, *others, *outputs.names(vehicle)]
        self.parameters = ParameterReader(names, target, bytewise=True)
        self._journal = Journal(journal)
        self._autopilot = ""  # unique id, once known
        self._version: tuple[int, int, int] | None = None
        self._next_version_s = -np.inf
        self._found: dict[str, float] = {}  # CT and KM as they were before us
        self._advisor: Advisor | None = None
        self._remedies: RemedyBook | None = None
        self._trouble = ""
        self._note = ""
        self._armed: bool | None = None
        self._wanted: dict[str, float] = {}  # parameters that are not yet confirmed, in the order to send
        self._sent_s = self._tick_s = -np.inf
        self._journaled = False
        self._injection = Injection(vehicle.motors, target) if method == "inject" else None
        self._attempted = np.ones(vehicle.motors)  # what was last told, or found to be better left untold
        self._changed_s = -np.inf

    # -- telemetry ----------------------------------------------------------------------------------------------

    @property
    def telemetry(self) -> TelemetryTable | None:
        """HIGHRES_IMU is made from integrated samples, in front of PX4's filters."""
        return TelemetryTable(0.0, 0.0)

    def streams(self, rate_hz: float) -> list[Stream]:
        """Messages to ask for. Intervals of more than 4 ms come at half the rate: 250 Hz is asked for."""
        ids = dialect
        rate = _RATE_MAX_HZ if rate_hz > 0.5 * _RATE_MAX_HZ else rate_hz
        return [
            Stream(ids.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, rate),
            Stream(ids.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW, rate),
            Stream(ids.MAVLINK_MSG_ID_HIGHRES_IMU, rate),
            Stream(ids.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50.0, required=False),
            Stream(ids.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 2.0, required=False),
            Stream(ids.MAVLINK_MSG_ID_ESC_STATUS, min(rate, 100.0), required=False),
        ]

    def observe(self, message: Message) -> Sample | None:
        """Telemetry, parameters, version."""
        kind = message.get_type()
        if kind == "PARAM_VALUE":
            self._parameter(message)
            return None
        if kind == "AUTOPILOT_VERSION":
            self._version = version_of(message.flight_sw_version)
            uid2 = bytes(getattr(message, "uid2", b"")[:18])
            self._autopilot = f"{message.uid:016x}-{uid2.hex()}"
            return None
        if kind == "COMMAND_ACK" and self._injection is not None:
            if self._injection.observe(message):
                self.applied.failed = np.arange(1, self._vehicle.motors + 1) == (self._injection.motor or 0)
                self.applied.source = int(self._injection.motor is not None)
            return None
        if kind == "HEARTBEAT":
            was, self._armed = self._armed, bool(message.base_mode & _ARMED)
            if was and not self._armed:
                self._restore()
        return self._decoder.observe(message)

    def _parameter(self, message: Message) -> None:
        before = dict(self.parameters.values) if not self._journaled else {}
        name = self.parameters.observe(message)
        if name is None:
            return
        value = self.parameters.values[name]
        wanted = self._wanted.get(name)
        if wanted is not None and _same(value, wanted):
            del self._wanted[name]
        if not self._journaled and not self._wanted and name in before and not _same(before[name], value):
            # Somebody else has changed the vehicle, or mended what was wrong with it: look at it anew.
            self._advisor, self._remedies, self._trouble, self._found = None, None, "", {}
        if self._found:
            self._note_applied()

    def _note_applied(self) -> None:
        values = self.parameters.values
        share = [
            values[f"CA_ROTOR{i}_CT"] / self._found[f"CA_ROTOR{i}_CT"] if self._found[f"CA_ROTOR{i}_CT"] else 1.0
            for i in range(self._vehicle.motors)
        ]
        failed = np.abs(np.array(share)) < _DEAD
        self.applied.failed = failed
        self.applied.source = int(failed.any())

    # -- start --------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Everything is known: what was found, and what an earlier run left behind."""
        values = self.parameters.values
        motors = self._vehicle.motors
        try:
            left = self._journal.read(self._autopilot)
            if int(values.get("CA_ROTOR_COUNT", 0)) != motors:
                self._trouble = (
                    f"CA_ROTOR_COUNT is {values.get('CA_ROTOR_COUNT', 0):.0f}, the airframe has {motors} motors"
                )
                return
            mine = [f"CA_ROTOR{i}_{s}" for i in range(motors) for s in ("CT", "KM")]
            found = {name: values[name] for name in mine}
            found.update({entry.name: entry.value for entry in left if entry.name in found})
            geometry = geometry_of({**values, **found}, motors)
        except (JournalError, KeyError) as error:
            self._trouble = str(error) if isinstance(error, JournalError) else f"PX4 does not answer for {error}"
            return
        self._trouble = (
            disagreement(geometry, self._vehicle)
            or outputs.contradiction(values, self._vehicle)
            or outputs.conflict(values, found, injecting=self._injection is not None)
        )
        if self._injection is not None and self._version is not None and not self._trouble:
            self._trouble = self._injection.prepare(self._version, values)
        if self._trouble:
            return
        self._found, self._journaled = found, bool(left)
        self._advisor = Advisor(self._vehicle, geometry)
        self._remedies = RemedyBook(self._advisor, motors)
        if left and self._armed is False:
            self._restore()
        elif left:
            # Back in the air: what was told stays told, and is not told again.
            share = [values[f"CA_ROTOR{i}_CT"] / found[f"CA_ROTOR{i}_CT"] for i in range(motors)]
            self._attempted = np.clip(np.array(share), 0.0, 1.0)
        self._note_applied()

    # -- parameters ---------------------------------------------------------------------------------------------

    def _tell(self, remedy: Remedy) -> None:
        """Want the parameters of this remedy, in the order in which every part of the burst flies best."""
        scale = {
            f"CA_ROTOR{i}_CT": self._found[f"CA_ROTOR{i}_CT"] * float(share)
            for i, share in enumerate(remedy.effectiveness)
        }
        ahead = [] if remedy.first is None else [f"CA_ROTOR{remedy.first}_CT"]
        moments = [f"CA_ROTOR{i}_KM" for i in range(self._vehicle.motors)]
        wanted = {name: scale[name] for name in ahead}
        wanted |= {name: 0.0 if remedy.yaw_released else self._found[name] for name in moments}
        wanted |= {name: value for name, value in scale.items() if name not in ahead}
        values = self.parameters.values
        self._wanted = {name: value for name, value in wanted.items() if not _same(values[name], value)}
        self._sent_s = -np.inf

    def _restore(self) -> None:
        """Want everything as it was found: all of it, for what is on its way may not have been confirmed yet."""
        if self._injection is not None:
            self._injection.lift()
        self._attempted = np.ones(self._vehicle.motors)
        self._note = ""
        if self._journaled and self._found:
            self._wanted = dict(self._found)
            self._sent_s = -np.inf

    def _original(self) -> bool:
        values = self.parameters.values
        return all(_same(values[name], value) for name, value in self._found.items())

    def _sets(self, now_s: float) -> list[Message]:
        """PARAM_SET for everything not yet confirmed, again every 50 ms."""
        if not self._wanted or now_s < self._sent_s + _RESEND_S:
            return []
        self._sent_s = now_s
        return [
            dialect.MAVLink_param_set_message(
                *self.target,
                name.encode(),
                encode(value, self.parameters.kinds.get(name, _REAL), bytewise=True),
                self.parameters.kinds.get(name, _REAL),
            )
            for name, value in self._wanted.items()
        ]

    @property
    def unfinished(self) -> bool:
        """Whether something is changed that could be restored now."""
        pending = self._injection is not None and self._injection.unfinished
        return self._armed is False and (pending or (bool(self._found) and (self._journaled or bool(self._wanted))))

    def tick(self, now_s: float) -> list[Message]:
        """Version and parameters until they are known; what is wanted until it is confirmed."""
        self._tick_s = now_s
        out: list[Message] = []
        if self._version is None:
            if now_s >= self._next_version_s:
                self._next_version_s = now_s + _VERSION_INTERVAL_S
                out.append(
                    dialect.MAVLink_command_long_message(
                        *self.target,
                        dialect.MAV_CMD_REQUEST_MESSAGE,
                        0,
                        float(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
                        *[0.0] * 6,
                    )
                )
            return out
        out += self.parameters.tick(now_s)
        ready = self.parameters.complete and self._armed is not None
        if self._advisor is None and not self._trouble and ready:
            self._begin()
        elif self._remedies is not None and self._armed is False:
            self._remedies.prepare_one()
        out += self._sets(now_s)
        if self._injection is not None:
            out += self._injection.tick(now_s)
        if self._journaled and not self._wanted and self._armed is False and self._found and self._original():
            try:
                self._journal.clear()
                self._journaled = False
            except JournalError as error:
                self._note = str(error)
        return out

    # -- commands -----------------------------------------------------------------------------------------------

    def complaints(self) -> list[str]:
        """What stands in the way, and a declaration that may not be sent."""
        note = self._note if self._injection is None else self._injection.note
        return [text for text in (self._trouble, note) if text]

    def findings(self) -> list[Finding]:
        """Version, rotors, and a journal that is left over."""
        version = "unknown" if self._version is None else ".".join(str(part) for part in self._version)
        known = self._version is not None and behaviour(self._version) is not None
        ready = self._advisor is not None
        return [
            Finding("version", known, f"PX4 {version}" if known else f"PX4 {version}: not known here"),
            Finding("rotors", ready, "agree with the airframe" if ready else self._trouble or "not read yet"),
            Finding("journal", not self._journaled, "parameters are being restored" if self._journaled else "clean"),
        ]

    def blocked(self, time_s: float, mode: Mode) -> str:
        """Why nothing may be sent; empty when something may."""
        if self._version is None:
            return "waiting for PX4's version"
        known = behaviour(self._version)
        if known is None or not known.scales:
            version = ".".join(str(part) for part in self._version)
            return f"PX4 {version}: what it does with a declared motor is not known here; observing"
        if self._trouble:
            return self._trouble
        if self._advisor is None:
            return "reading PX4's parameters"
        return ""

    def act(self, output: Output) -> list[Message]:
        """Tell what the motors still give, when it has changed and PX4's allocator would fly with it."""
        if output.mode == Mode.OBSERVE or not output.flying or self._advisor is None or not self._armed:
            return []
        believed = np.where(output.failed, 0.0, np.where(output.degraded, np.clip(output.effectiveness, 0.1, 1.0), 1.0))
        return self._attempt(believed, output.time_s)

    def _attempt(self, believed: np.ndarray, time_s: float) -> list[Message]:
        """At once when other motors are dead than at the last attempt; else on a large change, once a second."""
        dead_changed = bool(((believed == 0.0) != (self._attempted == 0.0)).any())
        waited = abs(time_s - self._changed_s) >= _CHANGE_INTERVAL_S
        if not dead_changed and (np.abs(believed - self._attempted).max() < _CHANGE_MIN or not waited):
            return []
        self._changed_s, self._attempted = time_s, believed.copy()
        assert self._advisor is not None and self._remedies is not None
        if self._injection is not None:
            return self._injection.act(believed, self._advisor)
        remedy = self._remedies.of(believed)
        if isinstance(remedy, NoRemedy):
            self._note = f"not told to PX4: {remedy.reason}"
            return []
        try:
            self._write_journal()
        except JournalError as error:
            self._note = str(error)
            return []
        self._note = "yaw given up" if remedy.yaw_released else ""
        self._tell(remedy)
        return self._sets(self._tick_s)

    def hands_off(self) -> str:
        """No version takes outputs."""
        return "PX4 takes no motor outputs over MAVLink: allocating instead"

    def declare(self, failed: np.ndarray, time_s: float) -> list[Message]:
        """The operator's word, told in the air only."""
        if self._advisor is None or not self._armed:
            return []
        return self._attempt(np.where(failed, 0.0, 1.0), time_s)

    def verdict(self, output: Output) -> str:
        """Whether PX4 was told."""
        note = self._note if self._injection is None else self._injection.note
        return "NOT told to PX4" if note and note != "yaw given up" else "told to PX4"

    def _write_journal(self) -> None:
        if self._journaled:
            return
        entries = [Entry(n, v, self.parameters.kinds.get(n, _REAL)) for n, v in self._found.items()]
        self._journal.write(self._autopilot, entries)
        self._journaled = True

    def drive(self, outputs: np.ndarray, time_s: float) -> list[Message]:
        """Nothing: ``hands_off`` says why."""
        return []

    def release(self, time_s: float) -> list[Message]:
        """On the ground everything is restored; in the air declarations stay."""
        if self._armed is False:
            self._restore()
        return []
