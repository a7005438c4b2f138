"""When the allocation is solved again."""

from __future__ import annotations

import numpy as np
import pytest
from estimates import hovering

from nff_companion.allocation import allocator
from nff_companion.allocation.planner import Planner, PlannerState
from nff_companion.core.estimate import Estimate
from nff_companion.core.vehicle import Vehicle

LEFT = 0.6  # of motor 3


def partly_lost(octo: Vehicle) -> Estimate:
    effectiveness = np.ones(octo.motors)
    effectiveness[2] = LEFT
    return hovering(octo, effectiveness)


@pytest.mark.parametrize("trusted", [True, False])
def test_a_lasting_partial_loss_is_allocated_around_where_the_model_can_be_trusted(
    octo: Vehicle, trusted: bool
) -> None:
    planner, estimate = Planner(octo, allocator("trim")), partly_lost(octo)
    state: PlannerState = planner.start()
    for k in range(400):
        state = planner.step(state, 0.005 * k, estimate, trust_partial=trusted)
    assert (state.plan is not None) == trusted
    assert state.degraded.tolist() == [trusted and motor == 3 for motor in range(1, octo.motors + 1)]
    # A doubt that comes and goes switches nothing; what is in force ends with the loss.
    before = state.plan
    for k in range(400, 800):
        state = planner.step(state, 0.005 * k, estimate, trust_partial=bool(k % 2))
        assert state.plan is before or not trusted
    estimate.effectiveness[2] = 1.0
    for k in range(800, 1200):
        state = planner.step(state, 0.005 * k, estimate, trust_partial=False)
    assert state.plan is None
    assert not state.degraded.any()
