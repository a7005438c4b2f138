"""What a judge of logs leaves out changes nothing of what is found: the same bits, through losses and a lifting."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from flown_logs import RATE_HZ, Flight

from nff_companion.companion import Companion
from nff_companion.companion_state import Output
from nff_companion.condition import Condition, Mode
from nff_companion.core import hypotheses, vehicle
from nff_companion.core.decision import Event
from nff_companion.core.estimate import Estimate
from nff_companion.core.parts import FLOWN, Parts
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import Vehicle
from nff_companion.core.weighing import Weighing


def stretches(model: Vehicle, rng: np.random.Generator) -> list[Sample]:
    """Motor 2 is lost for 14 s, while something shakes the vehicle; it works for 6 s, and motor 3 is lost."""
    parts = [
        Flight(model, seconds=5.0).rows(rng),
        Flight(model, seconds=14.0, fail_s=0.0, lost={2: 0.0}, noise_rad_s=0.06).rows(rng),
        Flight(model, seconds=9.0, fail_s=6.0, lost={3: 0.0}).rows(rng),
    ]
    samples = [sample for part in parts for _, sample in part]
    for k, sample in enumerate(samples):
        sample.time_s = 100.0 + k / RATE_HZ
    return samples


def flown(model: Vehicle, samples: list[Sample], parts: Parts) -> Iterator[Output]:
    companion = Companion(model, RATE_HZ, parts=parts)
    state = companion.start(Mode.OBSERVE)
    for sample in samples:
        state, output = companion.step(state, sample, Condition())
        yield output


def numbers(estimate: Estimate) -> list[float]:
    parts = (estimate.effectiveness, estimate.deviation, estimate.failed, estimate.residual, estimate.disturbance)
    return np.concatenate(parts).tolist()


@pytest.mark.parametrize("name", ["h250", "octo-x"])
def test_a_judge_finds_the_same_bits_as_what_flies(
    name: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = vehicle.load(name)
    samples = stretches(model, rng)
    short: list[bool] = []
    suspects = Weighing.suspects

    def counted(*given: Any) -> bool:
        short.append(True)
        return suspects(*given)

    monkeypatch.setattr(Weighing, "suspects", counted)
    events: list[Event] = []
    both = zip(flown(model, samples, FLOWN), flown(model, samples, Parts(judged=True)), strict=True)
    for real, judged in both:
        assert (real.estimate is None) == (judged.estimate is None)
        if real.estimate is not None and judged.estimate is not None:
            assert numbers(real.estimate) == numbers(judged.estimate)
        assert real.events == judged.events
        assert judged.plan is None
        events += real.events
    declared = [event.motor for event in events if event.declared]
    lifted = [event.motor for event in events if not event.declared]
    assert declared[0] == 2
    if name == "h250":  # which may lose one
        assert 2 in lifted
        assert 3 in declared
        assert len(short) > 300


def test_without_one_motor_by_hand_is_what_the_complement_of_several_gives(rng: np.random.Generator) -> None:
    for _ in range(200):
        moment = rng.standard_normal((7, 4, 6)) * 10.0 ** rng.uniform(-2.0, 2.0)
        matrix, vector = np.einsum("kai,kaj->kij", moment, moment), rng.standard_normal((7, 6))
        energy, motor = rng.uniform(1.0, 9.0, 7), np.array([rng.integers(6)])
        at_once = hypotheses.without_nuisance(matrix, vector, energy, motor)
        for k in range(7):
            alone = hypotheses.without_nuisance(matrix[k], vector[k], energy[k], motor)
            for one, other in zip(at_once, alone, strict=True):
                np.testing.assert_allclose(one[k], other, rtol=1e-9, atol=1e-9 * float(np.abs(matrix).max()))
