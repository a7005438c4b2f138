"""A motor that does not answer: it keeps its thrust, whatever its output is.

In steady flight it lacks nothing, and no loss is seen. It shows when the others move: the vehicle turns as if this one
had not moved. Of each axis the measured acceleration is explained by what all motors were asked to turn, by how much
later, by the body's rate, each by a factor of its own, and by what they lift beside a centre of mass that is a little
elsewhere, so that a file that is off is no motor's fault; what one motor adds to that, by the same share about all
axes, is compared with what any other one would. Pure.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from nff_companion.core.tuning import FitTuning

_FILE = len(("asked", "rate", "later", "lift"))  # columns of what the file may have wrong
_TINY = 1e-12


class AnswersState(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """``sums`` of the last ``seconds``; the ``motor`` (index) that seems not to answer (-1: none), ``alike``: for how
    many judgements; ``told`` (-1: none): what is believed."""

    sums: NDArray[np.float64]
    seconds: float = 0.0
    motor: int = -1
    alike: int = 0
    told: int = -1


class Answers:
    """Constants of an airframe. Columns of the sums: n accelerations, their n rates, anything, m thrusts from column
    ``motors``, and last the n derivatives of the modelled accelerations; n turns."""

    def __init__(self, effectiveness: NDArray[np.float64], motors: int, tuning: FitTuning) -> None:
        """``effectiveness`` (1 + n, m) in accelerations, up first; ``motors``: the first thrust's column."""
        lift, rows = effectiveness[0], effectiveness[1:]
        self._tuning, axes, count = tuning, *rows.shape
        width = motors + count + axes
        columns = np.zeros((axes, width, _FILE + count + 1))  # the file's; each motor's part; measured
        for axis in range(axes):
            columns[axis, motors : motors + count, 0] = rows[axis]
            columns[axis, axes + axis, 1] = columns[axis, motors + count + axis, 2] = columns[axis, axis, -1] = 1.0
            columns[axis, motors : motors + count, 3] = lift * float(np.abs(rows[axis]).max() / lift.mean())
            columns[axis, np.arange(motors, motors + count), np.arange(_FILE, _FILE + count)] = rows[axis]
        self._columns, self._width, self._motors = columns, width, count

    def start(self) -> AnswersState:
        """Nothing seen."""
        return AnswersState(sums=np.zeros((self._width, self._width)))

    def step(self, state: AnswersState, band: NDArray[np.float64], look_s: float) -> AnswersState:
        """Some more looks (., width) at the motion, ``look_s`` apart, and what they say."""
        seconds = len(band) * look_s
        keep = float(np.exp(-seconds / self._tuning.answers_memory_s))
        sums = keep * state.sums + band.T.dot(band)
        state = replace(state, sums=sums, seconds=keep * state.seconds + seconds)
        try:
            motor = self._silent(state)
        except np.linalg.LinAlgError:  # nothing that a vehicle does
            return self.start()
        alike = state.alike + 1 if motor == state.motor else 1
        told = motor if alike >= self._tuning.answers_alike else state.told
        return replace(state, motor=motor, alike=alike, told=told)

    def lost(self, state: AnswersState) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Share (m,) of its changes that each motor, were it the only one, does not make, and by how many nats (m,)
        that explains more than that all do."""
        turned = self._columns.swapaxes(1, 2) @ state.sums @ self._columns  # (n, 4 + m + 1, 4 + m + 1)
        energy = np.diagonal(turned, axis1=1, axis2=2)
        nothing = np.zeros(self._motors)
        if not (energy[:, :_FILE] > 0.0).all():
            return nothing, nothing
        ridge = np.einsum("ai,ij->aij", self._tuning.ridge * energy[:, :_FILE], np.eye(_FILE))
        independent = max(state.seconds * self._tuning.independent_hz, 1.0)
        variance = np.maximum(_without(turned, ridge)[:, -1, -1], _TINY) / independent
        ridge[:, 3, 3] += variance / self._tuning.answers_balance**2
        rest = _without(turned, ridge)
        square = (np.diagonal(rest, axis1=1, axis2=2)[:, _FILE:-1] / variance[:, None]).sum(axis=0)
        with_it = (rest[:, _FILE:-1, -1] / variance[:, None]).sum(axis=0)
        lost = np.clip(-with_it / np.maximum(square, _TINY), 0.0, 1.0)
        return lost, -with_it * lost - 0.5 * square * lost * lost

    def _silent(self, state: AnswersState) -> int:
        """The motor (index) that does not answer, -1: none, or it is not certain."""
        o = self._tuning
        lost, improvement = self.lost(state)
        motor = int(improvement.argmax())
        ahead = improvement[motor] - np.delete(improvement, motor).max()
        ends = state.told == motor  # what is believed ends later than it would begin
        least = o.answers_lost_min - (o.answers_hysteresis if ends else 0.0)
        enough = improvement[motor] >= o.answers_improvement_min * (0.5 if ends else 1.0)
        return (
            motor if lost[motor] >= least and enough and ahead >= o.answers_margin_min * (0.0 if ends else 1.0) else -1
        )


def _without(gram: NDArray[np.float64], ridge: NDArray[np.float64]) -> NDArray[np.float64]:
    """What is left of ``gram`` (n, k, k) when the file's columns are fitted, held back by ``ridge`` (n, 4, 4)."""
    files = gram[:, :_FILE]
    return np.asarray(gram - files.swapaxes(1, 2) @ np.linalg.solve(files[:, :, :_FILE] + ridge, files))
