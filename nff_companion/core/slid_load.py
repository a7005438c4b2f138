"""A load that slid, or a centre of mass that moved: it turns the vehicle as a motor does that has lost a part, but
takes no lift away.

Roll and pitch alone look the same, for as long as they last, and of yaw some motor fits any. The lift tells: from when
the sparse estimate first shows a loss, the likelihood of the residual's thrust under that loss is compared with that
under none. Where none is likelier the motors count as whole, and what turns the vehicle is learnt. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nff_companion.core import sparse
from nff_companion.core.tuning import SlidLoadTuning
from nff_companion.core.vehicle import THRUST


@dataclass(frozen=True, slots=True)
class SlidLoadState:
    """What the thrust axis has shown since a loss was first seen, or a larger one than before; that loss; when one was
    seen last, and whether it is a load's."""

    lift: sparse.Information
    loss: float
    seen_s: float
    seen: bool = True
    slid: bool = False
    nats: float = 0.0  # by which the thrust axis speaks for the loss; below 0: against it


class SlidLoad:
    """Constants; ``looked`` where the sparse program was solved, ``grown`` with each sample while a loss is seen."""

    def __init__(self, motors: int, tuning: SlidLoadTuning, loss_seen: float, loss_lost: float) -> None:
        """``loss_seen``: of the sparse estimate, that counts as one; ``loss_lost``: that is a failure's."""
        self._motors, self._tuning = motors, tuning
        self._seen, self._lost = 1.0 - loss_seen, 1.0 - loss_lost

    def grown(
        self,
        state: SlidLoadState,
        lost: NDArray[np.float64],
        residual: NDArray[np.float64],
        noise_weight: NDArray[np.float64],
        dt_s: float,
    ) -> SlidLoadState:
        """With one sample: ``lost`` B0 diag(w) (n, m), ``residual`` (n,), ``noise_weight`` (n,) as of the program."""
        if not state.seen:
            return state
        row = slice(THRUST, THRUST + 1)
        lift = sparse.update(
            state.lift, lost[row], residual[row], noise_weight[row], dt_s, self._tuning.forgetting_per_s
        )
        return replace(state, lift=lift)

    def looked(
        self, state: SlidLoadState | None, time_s: float, effectiveness: NDArray[np.float64], failed: NDArray[np.bool_]
    ) -> SlidLoadState | None:
        """After the program was solved: ``effectiveness`` (m,) by it, ``failed`` (m,) bool are declared; None: no loss
        is seen."""
        loss = np.where(failed, 0.0, 1.0 - effectiveness)
        least = 1.0 - float(loss.max())
        if least >= self._seen:
            over = state is None or time_s - state.seen_s > self._tuning.hold_s
            return None if over or state is None else replace(state, seen=False)
        if state is None or 1.0 - least > state.loss + self._tuning.grown_by:
            return SlidLoadState(sparse.Information.empty(self._motors), 1.0 - least, time_s)
        nats = -float(state.lift.vector.dot(loss)) - 0.5 * float(loss.dot(state.lift.matrix).dot(loss))
        slid = least > self._lost and nats < -self._tuning.nats_min
        return replace(state, seen_s=time_s, seen=True, slid=slid, nats=nats)
