"""When a log says nothing: outputs too seldom for the motion, a pair that cannot be declared, another airframe."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.core.sample import Sample
from nff_companion.core.vehicle import GRAVITY_M_S2, PITCH, ROLL, Vehicle
from nff_companion.replay.judge import Judgement, judge
from nff_companion.replay.verdict import judgement
from nff_companion.replay.watch import Fault, Watch

RATE_HZ = 200.0
QUAD = vehicle.load("h250")


def flown(
    model: Vehicle,
    rng: np.random.Generator,
    *,
    sway: Callable[[float], float | tuple[float, float]] = lambda time_s: 0.0,
    logged_every: int = 1,
    lost: dict[int, float] | None = None,
    seconds: float = 12.0,
    between_s: tuple[float, float] = (8.0, np.inf),
    spoilt_every: int = 0,
) -> Judgement:
    """A rigid body whose motors push as they are asked to: at hover, and ``sway`` (t) of it more on the left
    (and in front); ``between_s`` without the motors ``lost`` (share that is left). What is logged is every so many-th
    output, held."""
    sides = np.sign(model.effectiveness_si[[ROLL, PITCH]])
    rate, lagged, logged = np.zeros(3), np.full(model.motors, model.hover), np.full(model.motors, model.hover)
    rows: list[tuple[float, Sample]] = []
    for k in range(round(seconds * RATE_HZ)):
        time_s = 10.0 + k / RATE_HZ
        asked = model.hover * (1.0 + np.append(sway(k / RATE_HZ), 0.0)[:2] @ sides)
        if k % logged_every == 0:
            logged = asked
        lagged = lagged + (asked - lagged) * (1.0 - np.exp(-1.0 / RATE_HZ / model.motor.time_constant_up_s))
        given = lagged.copy()
        for motor, share in (lost or {}).items():
            given[motor - 1] *= share if between_s[0] < k / RATE_HZ < between_s[1] else 1.0
        up, *turning = model.acceleration_effectiveness @ given
        rate = rate + (np.array(turning) - 2.0 * rate * (k / RATE_HZ <= between_s[0])) / RATE_HZ
        told = logged * np.nan if spoilt_every and k % spoilt_every == 0 else logged
        rows.append((time_s, sample(time_s, rate + 0.01 * rng.standard_normal(3), up, model, told)))
    return judge(model, rows, RATE_HZ, 10.0, "RCOU", RATE_HZ / logged_every)


def sample(time_s: float, rate: NDArray[np.float64], up: float, model: Vehicle, thrust: NDArray[np.float64]) -> Sample:
    return Sample(
        time_s=time_s,
        gyro_rad_s=rate,
        specific_force_m_s2=np.array([0.0, 0.0, -up]),
        output=model.output_for(thrust),
        armed=True,
    )


def test_outputs_that_come_too_seldom_for_the_motion_are_no_evidence(rng: np.random.Generator) -> None:
    def limit_cycle(time_s: float) -> float:
        return 0.3 * np.sin(2.0 * np.pi * 9.7 * time_s)

    fast = flown(QUAD, rng, sway=limit_cycle)
    assert fast.verdict == "no_fault"
    assert fast.explained is not None
    assert fast.explained[ROLL] > 0.5
    seldom = flown(QUAD, rng, sway=limit_cycle, logged_every=20)
    assert seldom.verdict == "not_judged"
    assert "RCOU at 10 Hz is too seldom" in seldom.reason
    assert seldom.faults == []


@pytest.mark.parametrize("begin_s", [0.0, 8.0], ids=["from take-off", "out of a hover"])
def test_a_motion_that_begins_between_two_outputs_is_no_loss(begin_s: float, rng: np.random.Generator) -> None:
    def rocking(time_s: float) -> tuple[float, float]:
        if time_s <= begin_s:
            return 0.0, 0.0
        return 0.4 * np.sin(2.0 * np.pi * 5.0 * time_s), 0.28 * np.sin(2.0 * np.pi * 5.15 * time_s + 1.5)

    fast = flown(QUAD, rng, sway=rocking, between_s=(np.inf, np.inf))
    assert fast.verdict == "no_fault"
    seldom = flown(QUAD, rng, sway=rocking, between_s=(np.inf, np.inf), logged_every=20)
    assert (seldom.verdict, seldom.faults) == ("not_judged", [])
    if begin_s == 0.0 and "too few to see" not in seldom.reason:  # by its noise, nothing seemed lost until late
        assert "RCOU at 10 Hz is too seldom for this motion: what they leave unexplained" in seldom.reason
        return
    if begin_s == 0.0:
        assert "too few to see" in seldom.reason
    else:
        seemed = re.search(r"seemed lost at ([0-9.]+) s", seldom.reason)
        assert seemed is not None
        assert float(seemed[1]) >= begin_s
    assert "would have been declared" in seldom.reason


@pytest.mark.parametrize("left", [0.0, 0.3])
def test_a_loss_is_a_fault_by_outputs_at_10_hz_too(left: float, rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, lost={2: left}, seconds=9.0, logged_every=20)
    assert (found.verdict, [fault.motor for fault in found.faults]) == ("fault", [2])


def test_a_slow_motion_is_judged_by_outputs_at_10_hz(rng: np.random.Generator) -> None:
    slow = flown(QUAD, rng, sway=lambda time_s: 0.1 * np.sin(2.0 * np.pi * 0.5 * time_s), logged_every=20)
    assert slow.verdict == "no_fault"


def test_a_pair_that_a_quadrotor_cannot_lose_is_said_and_not_dropped(rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, lost={1: 0.0, 3: 0.1}, seconds=10.0)
    assert found.verdict == "not_judged"
    assert "motors 1 and 3" in found.reason


def test_one_lost_motor_of_a_quadrotor_is_a_fault(rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, lost={2: 0.0}, seconds=9.0)
    assert found.verdict == "fault"
    assert [fault.motor for fault in found.faults] == [2]
    assert found.faults[0].time_s == pytest.approx(8.0, abs=0.2)


def test_a_motor_that_works_again_is_said_to_be_lifted(rng: np.random.Generator) -> None:
    octo = vehicle.load("octo-x")
    found = flown(octo, rng, lost={3: 0.0}, between_s=(8.0, 8.5), seconds=14.0)
    assert [fault.motor for fault in found.faults] == [3]
    lifted = found.faults[0].lifted_s
    assert lifted is not None
    assert 8.5 < lifted < 13.0


def test_a_vehicle_that_is_heavier_than_its_file_does_not_fit(rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, lost=dict.fromkeys(range(1, 5), 0.3), between_s=(-1.0, np.inf))
    assert found.verdict == "not_judged"
    assert "does not fit: on the thrust axis" in found.reason


def test_nothing_is_said_of_a_flight_on_the_ground() -> None:
    still = [(0.01 * k, sample(0.01 * k, np.zeros(3), GRAVITY_M_S2, QUAD, np.full(4, 0.02))) for k in range(500)]
    found = judge(QUAD, still, 100.0, 0.0, "RCOU", 100.0)
    assert found.verdict == "not_judged"
    assert "of what hover needs" in found.reason
    assert found.explained is None


@pytest.mark.parametrize("spoilt_every", [0, 190, 60])
def test_samples_that_cannot_be_used_hide_no_airframe_that_does_not_fit(
    rng: np.random.Generator, spoilt_every: int
) -> None:
    weak = dict.fromkeys(range(1, 5), 0.3)
    found = flown(QUAD, rng, lost=weak, between_s=(-1.0, np.inf), spoilt_every=spoilt_every)
    assert found.verdict == "not_judged"
    assert found.reason


def test_a_flight_in_which_no_stretch_is_whole_is_not_judged(rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, spoilt_every=40)
    assert (found.verdict, found.faults) == ("not_judged", [])


@pytest.mark.parametrize("name", ["hexa-x", "octo-x"])
def test_one_lost_motor_of_more_is_a_fault_whatever_can_be_done_about_it(name: str, rng: np.random.Generator) -> None:
    found = flown(vehicle.load(name), rng, lost={4: 0.0}, seconds=9.0)
    assert [fault.motor for fault in found.faults] == [4]
    assert found.faults[0].time_s == pytest.approx(8.0, abs=0.2)


def test_a_fault_that_is_declared_late_is_no_airframe_that_does_not_fit(rng: np.random.Generator) -> None:
    """A motor that gives less for two seconds before it is lost: what it did then is the fault, not the model."""
    watch = Watch()
    for k in range(round(8.0 * RATE_HZ)):
        share = 0.0 if k < 6.0 * RATE_HZ else 0.9
        shown = np.full(4, QUAD.hover)
        asked = QUAD.acceleration_effectiveness @ (QUAD.hover * (1.0 + 0.02 * rng.standard_normal(4)))
        residual = -share * QUAD.acceleration_effectiveness[:, 0] * QUAD.hover + 0.1 * rng.standard_normal(4)
        watch.measured.append(asked)
        watch.residual.append(residual)
        watch.shown.append(shown)
        watch.times.append(k / RATE_HZ)
    watch.faults.append(Fault(1, 8.0, 0.1, 1.0))
    watch.judged_s, watch.used_armed = 8.0, round(8.0 * RATE_HZ)
    found = judgement(watch, QUAD, 0, RATE_HZ, ("RCOU", 10.0))
    assert (found.verdict, [fault.motor for fault in found.faults]) == ("fault", [1])


@pytest.mark.parametrize(("noise", "confidence"), [(0.01, 1.0), (1.7, 0.76), (30.0, 0.5)])
def test_confidence_goes_with_how_much_the_model_explains(
    noise: float, confidence: float, rng: np.random.Generator
) -> None:
    watch = Watch()
    for k in range(round(24.0 * RATE_HZ)):
        motion = np.array([0.1, 1.0, 1.0, 0.1]) * rng.standard_normal(4)
        left = noise * rng.standard_normal(4)
        watch.measured.append(motion + left)
        watch.residual.append(left)
        watch.shown.append(np.full(4, QUAD.hover))
        watch.times.append(k / RATE_HZ)
    watch.faults.append(Fault(1, 24.0, 0.0, 1.0))
    found = judgement(watch, QUAD, 0, RATE_HZ, ("RCOU", 200.0))
    assert found.verdict == "fault"
    assert found.faults[0].confidence == pytest.approx(confidence, abs=0.06)


def test_a_declaration_that_nothing_was_checked_against_is_half_believed(rng: np.random.Generator) -> None:
    found = flown(QUAD, rng, lost={2: 0.0}, between_s=(2.6, np.inf), seconds=4.0)
    assert [fault.motor for fault in found.faults] == [2]
    assert found.reason.startswith("not checked against healthy flight")
    assert 0.4 < found.faults[0].confidence <= 0.5
