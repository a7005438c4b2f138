"""What is said of the moment: what the companion believes, and what of it the autopilot has confirmed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.times import CONFIRM_MAX_S
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, Mode, Reason, Source, Statement, first
from nff_companion.core.parts import Parts

_HEALTHY = Statement(Reason.HEALTHY)


def numbers(motors: NDArray[np.bool_]) -> list[int]:
    """Motors, from 1, of a mask (m,) bool."""
    return [int(i) + 1 for i in np.flatnonzero(motors)]


def _listed(motors: NDArray[np.bool_]) -> str:
    return ", ".join(map(str, numbers(motors)))


def confirmed(output: Output, condition: Condition) -> bool:
    """Whether the autopilot says that it does what ``output`` wants of it."""
    in_force = condition.in_force
    held = in_force.failed
    if (output.failed.any() or (held is not None and held.any())) and not in_force.holds(output.failed):
        return False
    if output.mode == Mode.OVERRIDE and output.override is not None:
        return in_force.source == Source.OVERRIDE
    if output.plan is not None and condition.takes_matrix:
        return in_force.source in (Source.MATRIX, Source.OVERRIDE)
    if output.degraded.any() and not condition.takes_matrix:
        return in_force.source == Source.DECLARATION
    return True


class Confirmation:
    """Since when something that was told has not been confirmed. ``now_s`` of our clock."""

    def __init__(self) -> None:
        self._since_s: float | None = None

    def step(self, output: Output, condition: Condition, now_s: float) -> float | None:
        """How long something has been wanted without being in force, in s; None: all is."""
        wanted = output.mode != Mode.OBSERVE and output.flying
        if not wanted or confirmed(output, condition):
            self._since_s = None
            return None
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s


def verdict(output: Output, condition: Condition, asked: Mode, parts: Parts, unconfirmed_s: float | None) -> Statement:
    """The one thing to be said. ``asked``: the operator's mode; ``unconfirmed_s`` by ``Confirmation``."""
    untold = condition.untold if output.mode != Mode.OBSERVE and _anything(output) else None
    trouble = first(output.obstacle, untold)
    if trouble is not None:
        return trouble
    if asked == Mode.OBSERVE:  # what nothing is done about anyway is said all the same
        return _undecided(output) or _weak(output) or Statement(Reason.OBSERVING)
    if not parts.identify:
        return Statement(Reason.NOT_WATCHING, parts.name)
    if unconfirmed_s is not None and unconfirmed_s > CONFIRM_MAX_S:
        return Statement(Reason.NOT_CONFIRMED, _refusals(condition))
    if not _anything(output):
        return _undecided(output) or _weak(output) or _HEALTHY
    motors = _listed(output.failed if output.failed.any() else output.degraded)
    if unconfirmed_s is not None:
        return Statement(Reason.TELLING, motors)
    if condition.takes_matrix and output.plan is None:
        return Statement(Reason.STOPPED, motors)
    undecided = _undecided(output)
    if undecided is not None:
        return undecided
    no_yaw = condition.in_force.yaw_released or (output.plan is not None and bool(output.plan.released))
    if output.failed.any():
        return Statement(Reason.REALLOCATED_NO_YAW if no_yaw else Reason.REALLOCATED, motors)
    if output.either:
        one = " or ".join(map(str, output.either))
        return Statement(Reason.EITHER_NO_YAW if no_yaw else Reason.EITHER, one)
    return Statement(Reason.PARTIAL_NO_YAW if no_yaw else Reason.PARTIAL, motors)


def _undecided(output: Output) -> Statement | None:
    """What is believed of motors that nothing is done about."""
    if output.among:
        sets = " or ".join("+".join(map(str, motors)) for motors in output.among)
        told = Reason.AMONG if len(output.among) > 1 else Reason.PERHAPS  # of one set: whether it is lost
        return Statement(Reason.PROBING if output.probing else told, sets)
    if output.more:
        return Statement(Reason.MORE, " or ".join(map(str, output.more)))
    return Statement(Reason.UNRESPONSIVE, str(output.unresponsive[0])) if output.unresponsive else None


def _weak(output: Output) -> Statement | None:
    if output.weak:
        return Statement(Reason.WEAK, " or ".join(map(str, output.weak)))
    told = Reason.WORN if output.worn_sure else Reason.WORN_OR_LOAD
    return Statement(told, " or ".join(map(str, output.worn))) if output.worn else None


def _anything(output: Output) -> bool:
    return bool(output.failed.any() or output.degraded.any())


def _refusals(condition: Condition) -> str:
    refused = ", ".join(f"{count} {name}" for name, count in condition.in_force.refused.items() if count)
    return f"refused {refused}" if refused else "no answer"
