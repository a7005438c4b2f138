"""What stands in the way, and what is in force: typed, with one table of texts. Nothing here compares a text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum
from types import MappingProxyType
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from nff_companion.core.vehicle import TelemetryTable

Scalar = TypeVar("Scalar", bound=np.generic)


class Mode(IntEnum):
    """What the companion may do."""

    OBSERVE = 0
    ALLOCATE = 1
    OVERRIDE = 2


class Reason(Enum):
    """Every reason that the companion gives: (priority, text). The lowest number is said first; {} takes the detail."""

    # Samples that cannot be used.
    WAITING = (10, "waiting for telemetry")
    TELEMETRY_STOPPED = (10, "telemetry stopped")
    ANOTHER_SYSTEM = (10, "telemetry stopped: {}")
    MOTOR_COUNT = (11, "telemetry has {}: check the airframe")
    OUTPUTS_MISSING = (11, "motor outputs missing in telemetry")
    NOT_FINITE = (11, "gyro or accelerometer not finite")
    IMPLAUSIBLE = (11, "gyro or accelerometer beyond what a vehicle survives")
    SAMPLE_TIME = (11, "time of the sample is {}")
    TIME_JUMP = (12, "time jumped by {} s")
    ESTIMATOR = (12, "estimator: {}")
    RATE = (12, "samples at {} Hz: observing")
    WRONG_FILE = (12, "wrong airframe file: {}")
    NOT_FLYING = (13, "not flying")
    STARTING = (13, "starting")
    RECOVERING = (14, "recovering")
    # Link and vehicle.
    TWIN = (20, "another companion was here first ({}): observing")
    AMBIGUOUS = (20, "systems {} are heard: set link.system; observing")
    # The autopilot.
    VERSION_UNKNOWN = (30, "{}: what it does with a declared motor is not known here; observing")
    READING = (31, "reading the autopilot's parameters")
    PARAMETER_SILENT = (31, "the autopilot does not answer for {}: observing")
    CONTRADICTION = (32, "{}: observing")
    CARD_DIFFERS = (33, "the mixer on the card is not this airframe file's ({}): install again; observing")
    UNREADABLE = (33, "applet: {}")
    SILENT = (34, "{} does not answer: observing")
    APPLET_MOTORS = (34, "the applet flies {}: install it again")
    JOURNAL = (35, "{}: nothing may be changed; observing")
    UNCONFIRMED = (37, "observing: airframe file not yet confirmed")
    NO_MATRIX_TAKEN = (36, "FRAME_CLASS is not 17: no matrix can be loaded; set it, or use override mode")
    # What was decided cannot be put into force.
    NO_LIFT = (40, "LAND: the motors left cannot carry the weight")
    NO_PLAN = (41, "no new matrix: {}")
    NOT_TOLD = (41, "not told to the autopilot: {}")
    NOT_CONFIRMED = (42, "told, NOT confirmed by the autopilot: {}")
    # Override alone.
    NO_OUTPUTS_TAKEN = (50, "{} takes no motor outputs: allocating instead")
    NOT_GUIDED = (50, "override needs flight mode GUIDED: allocating instead")
    STATE_UNKNOWN = (51, "override needs fresh attitude, position and velocity: allocating instead")
    STATE_IMPLAUSIBLE = (51, "override: attitude, velocity or position not those of a vehicle: allocating instead")
    OUTPUTS_NOT_FINITE = (51, "override: outputs not finite: allocating instead")
    NO_HEALTHY_MATRIX = (51, "override: no matrix for this airframe: allocating instead")
    # What is being done.
    OBSERVING = (60, "observing")
    NOT_WATCHING = (61, "law {}: no motor is watched")
    TELLING = (62, "telling the autopilot of motors {}")
    REALLOCATED = (62, "reallocated without motors {}")
    REALLOCATED_NO_YAW = (62, "reallocated without motors {}, yaw given up")
    STOPPED = (62, "motors {} stopped, no matrix in force")
    EITHER = (63, "reallocated: motor {} lost")
    EITHER_NO_YAW = (63, "reallocated: motor {} lost, yaw given up")
    AMONG = (63, "LAND: motors {} lost, not told which")
    PERHAPS = (63, "LAND: motors {} may be lost")
    PROBING = (63, "motors {} lost: testing which")
    MORE = (63, "LAND: motor {} pulls more than asked")
    WEAK = (63, "motor {} has lost a part of its thrust")
    WORN = (63, "motor {} gives less thrust than before")
    WORN_OR_LOAD = (63, "motor {} gives less, or a load moved")
    UNRESPONSIVE = (63, "LAND: motor {} does not answer")
    PARTIAL = (63, "reallocated a partial loss of motor {}")
    PARTIAL_NO_YAW = (63, "reallocated, motor {} partly lost, yaw given up")
    HEALTHY = (64, "all motors healthy")
    # For the pilot, beside the above.
    WATCHDOG_SILENT = (70, "applet watchdog is silent")
    TABLES_DIFFER = (71, "{} tables on the card are not this airframe file's")
    SECOND_VEHICLE = (70, "system {} is heard too")
    LATER_TWIN = (70, "another companion is heard ({})")
    HELD_BACK = (70, "motor {} lost, or the airframe file is wrong")
    FILE_CONFIRMED = (71, "this flight confirms the airframe file")
    FILE_OPEN = (71, "file unconfirmed: {}")
    FILE_PROPOSED = (71, "file proposed: {}")
    FILE_OFF = (72, "airframe file: {}")
    SPEED_SENSOR = (71, "motor {} pulls but reads no speed")
    SLOW_STREAM = (71, "{} needed")
    STILL_CHANGED = (70, "parameters are still changed: {}")
    JOURNAL_STAYS = (71, "{}: remove it before you tune CA_ROTORn")

    @property
    def priority(self) -> int:
        """The lowest is said first."""
        return self.value[0]


@dataclass(frozen=True, slots=True)
class Statement:
    """One reason with its detail; ``text`` for people."""

    reason: Reason
    detail: str = ""

    @property
    def text(self) -> str:
        """In words."""
        text: str = self.reason.value[1]
        return text.format(self.detail)


def first(*statements: Statement | None) -> Statement | None:
    """The one to be said first, None when there is none."""
    given = [s for s in statements if s is not None]
    return min(given, key=lambda s: s.reason.priority) if given else None


class Source(IntEnum):
    """Whose allocation drives the motors, by the autopilot's word."""

    STOCK = 0
    DECLARATION = 1
    MATRIX = 2
    OVERRIDE = 3


class InForce(msgspec.Struct, frozen=True, eq=False):
    """What the autopilot says it has in force. ``failed`` (m,) bool, read-only; None: it has not said."""

    source: Source = Source.STOCK
    failed: NDArray[np.bool_] | None = None
    yaw_released: bool = False
    refused: Mapping[str, int] = msgspec.field(default_factory=lambda: MappingProxyType({}))

    def holds(self, failed: NDArray[np.bool_]) -> bool:
        """Whether exactly the motors ``failed`` (m,) bool are held failed."""
        return self.failed is not None and bool((self.failed == failed).all())


_NOTHING = InForce()


class Condition(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """The autopilot and the link to it at one moment, as the adapter and the session see them."""

    armed: bool | None = None  # None: not heard
    samples: Statement | None = None  # why nothing can be estimated from them
    command: Statement | None = None  # why no command may be sent
    allocate: Statement | None = None  # why mode allocate can do nothing
    drive: Statement | None = None  # why motor outputs may not be sent though commands may
    untold: Statement | None = None  # why what was decided could not be told
    takes_matrix: bool = False
    in_force: InForce = _NOTHING
    telemetry: TelemetryTable | None = None  # filters of what it sends; None: as the airframe file says
    notes: tuple[Statement, ...] = ()  # what the pilot should hear beside all that
    unfinished: bool = False  # something of ours must be undone or confirmed before leaving


def read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """A copy that nobody can write to."""
    out = np.array(array)
    out.flags.writeable = False
    return out
