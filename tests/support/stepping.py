"""A companion stepped by hand: the state is kept here, everything else is the product's."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from nff_companion.companion import Companion
from nff_companion.companion_state import NO_ORDERS, CompanionState, Orders, Output
from nff_companion.condition import Condition, Mode, Reason, Statement
from nff_companion.core import basis_network, vehicle
from nff_companion.core.parts import FLOWN, Parts
from nff_companion.core.sample import Sample
from nff_companion.core.tuning import Tuning

OBEDIENT = Condition(takes_matrix=True)


class Stepped:
    """One vehicle's companion, and its state between the calls."""

    def __init__(
        self,
        airframe: str = "octo-x",
        mode: Mode = Mode.ALLOCATE,
        *,
        rate_hz: float = 200.0,
        network: str = "airframe",
        parts: Parts = FLOWN,
        tuning: Tuning | None = None,
    ) -> None:
        model = vehicle.load(airframe)
        basis = basis_network.for_vehicle(model, network)
        self.companion = Companion(model, rate_hz, tuning, network=basis, parts=parts)
        self.state: CompanionState = self.companion.start(mode)
        self.condition = OBEDIENT

    def respond(self, sample: Sample) -> NDArray[np.float64] | None:
        self.state, answer = self.companion.respond(self.state, sample, self.condition)
        return answer

    def step(self, sample: Sample | None, orders: Orders = NO_ORDERS) -> Output:
        answer = None if sample is None else self.respond(sample)
        self.state, output = self.companion.step(self.state, sample, self.condition, orders, answer)
        return output

    def steps(self, samples: Iterable[Sample]) -> list[Output]:
        return [self.step(sample) for sample in samples]

    def interrupted(self) -> Output:
        why = Statement(Reason.TELEMETRY_STOPPED, "0.30")
        self.state, output = self.companion.interrupted(self.state, self.condition, why)
        return output


def text_of(output: Output) -> str:
    """Why the output is not what was asked for; empty when it is."""
    return "" if output.obstacle is None else output.obstacle.text
