"""Telling PX4 by CA_ROTORn_CT and _KM: which declarations are passed on, when, and why the others are not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nff_companion.autopilots.px4.examination import Examined
from nff_companion.autopilots.px4.parameter_change import ParameterChange
from nff_companion.autopilots.px4.record import Record
from nff_companion.autopilots.px4.remedy import NoRemedy
from nff_companion.condition import Reason, Statement
from nff_companion.mavlink.codec import Message

_CHANGE_MIN = 0.15  # of a motor's effectiveness: each change wears the parameter storage
_CHANGE_INTERVAL_S = 1.0
_PUT_OFF_MAX_S = 1.5  # what was declared longer ago is no longer believed, or was told since
_DEAD = 0.05
_NOT_ON_DISK = Statement(Reason.NOT_TOLD, "what the parameters were is not on disk yet")


class Telling:
    """Remembers what was told last. Times are of any one monotonic clock, in s."""

    def __init__(self, change: ParameterChange, record: Record) -> None:
        self._change, self._record = change, record
        self._refused: Statement | None = None
        self._waits = False  # for the journal
        # (m,) last told, or found to be better left untold; None: nothing
        self._attempted: NDArray[np.float64] | None = None
        self._changed_s = -np.inf
        self._declared: NDArray[np.float64] | None = None  # (m,) too soon after the last change
        self._declared_s = -np.inf

    @property
    def untold(self) -> Statement | None:
        """Why the last declaration was not passed on."""
        return _NOT_ON_DISK if self._waits else self._refused

    def forget(self) -> None:
        """The flight is over."""
        self._attempted, self._declared, self._refused, self._waits = None, None, None, False

    def put_nothing_off(self) -> None:
        """What was declared too soon is not wanted any more."""
        self._declared = None

    def take_over(self, shares: NDArray[np.float64], now_s: float) -> None:
        """An earlier run has told these ``shares`` (m,) of CT."""
        clipped = np.clip(shares, 0.0, 1.0)
        self._attempted, self._changed_s = np.where(clipped < _DEAD, 0.0, clipped), now_s

    def tell(self, believed: NDArray[np.float64], examined: Examined, now_s: float) -> list[Message]:
        """Pass on ``believed`` (m,) effectiveness when it is new; else again what is not yet confirmed.

        At once when other motors are dead than at the last attempt; else on a large change, once a second.
        """
        last = np.ones_like(believed) if self._attempted is None else self._attempted
        dead_changed = bool(((believed == 0.0) != (last == 0.0)).any())
        large = float(np.abs(believed - last).max()) >= _CHANGE_MIN
        soon = now_s < self._changed_s + _CHANGE_INTERVAL_S
        self._declared, self._declared_s = (believed, now_s) if large and soon and not dead_changed else (None, now_s)
        self._waits = False
        if dead_changed or (large and not soon):
            self._attempt(believed, examined, now_s)
        return self._change.due(now_s)

    def put_off(self, examined: Examined, now_s: float) -> list[Message]:
        """What was declared too soon after a change, when it no longer is."""
        if self._declared is None or now_s < self._changed_s + _CHANGE_INTERVAL_S:
            return []
        believed, self._declared = self._declared, None
        return self.tell(believed, examined, now_s) if now_s < self._declared_s + _PUT_OFF_MAX_S else []

    def _attempt(self, believed: NDArray[np.float64], examined: Examined, now_s: float) -> None:
        if not self._record.covers(examined.found):
            # Nothing may be changed yet; the schedule repeats what is not confirmed.
            self._waits = True
            return
        self._changed_s, self._attempted = now_s, np.array(believed)
        remedy = examined.remedies.of(np.array(believed))
        if isinstance(remedy, NoRemedy):
            self._refused = Statement(Reason.NO_LIFT) if remedy.no_lift else Statement(Reason.NOT_TOLD, remedy.reason)
            return
        self._refused = None
        self._change.tell(remedy, now_s)
