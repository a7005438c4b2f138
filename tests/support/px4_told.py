"""What the tests of PX4's adapter share: what was sent, what is in force, what the companion puts out."""

from __future__ import annotations

import numpy as np
from fake_px4 import without

from nff_companion.companion_state import Output
from nff_companion.condition import Condition, Mode, Reason
from nff_companion.core.vehicle import Vehicle
from nff_companion.mavlink.codec import Message
from nff_companion.mavlink.services.parameter_reader import name_of

NEEDS = {"SYS_FAILURE_EN": 1.0, "CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}  # what injection needs


def names(messages: list[Message]) -> list[str]:
    return [name_of(m) for m in messages if m.get_type() == "PARAM_SET"]


def held(condition: Condition) -> list[int]:
    assert condition.in_force.failed is not None
    assert not condition.in_force.failed.flags.writeable
    return [int(i) + 1 for i in np.flatnonzero(condition.in_force.failed)]


def untold(condition: Condition) -> tuple[Reason, str]:
    assert condition.untold is not None
    return condition.untold.reason, condition.untold.text


def output(model: Vehicle, failed: tuple[int, ...], mode: Mode = Mode.ALLOCATE) -> Output:
    eta = without(model, failed)
    return Output(
        time_s=10.0,
        mode=mode,
        obstacle=None,
        flying=True,
        failed=eta == 0.0,
        effectiveness=eta,
        deviation=np.zeros(8),
        degraded=np.zeros(8, bool),
        events=(),
        plan=None,
        override=None,
        estimate=None,
        unallocated=np.zeros(4),
        rejected=0,
        bad_samples=0,
    )
