"""The companion as a pilot needs it: bad input never acts, declarations latch, any airframe."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stepping import OBEDIENT, Stepped, text_of

from nff_companion import companion as companion_module
from nff_companion.allocation import allocator
from nff_companion.allocation.problem import Problem
from nff_companion.companion_state import Orders, Output
from nff_companion.condition import Condition, Mode, Reason, Statement
from nff_companion.core import vehicle
from nff_companion.core.sample import Sample
from nff_companion.errors import SolverError
from sitl import airframe as plant_airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight

RATE = 200.0
OTHERS = ["ramp", "stuck", "intermittent"]


def flight(
    name: str,
    faults: list[Fault],
    *,
    mode: Mode = Mode.ALLOCATE,
    wind: float = 3.0,
    seed: int = 1,
    error: float = 0.05,
    alter: Callable[[Sample], Sample] | None = None,
    vehicles: int = 1,
) -> VirtualFlight:
    """With so many ``vehicles`` that fly alike but for their ``faults``."""
    nominal = plant_airframe.load(vehicle.path_of(name))
    options = FleetOptions(
        seeds=[seed] * vehicles, height_m=10.0, wind_m_s=wind, turbulence_m_s=0.25 * wind, model_error=error
    )
    return VirtualFlight(
        Fleet(nominal, options, faults),
        {vehicle: TrialOptions(mode=mode) for vehicle in range(vehicles)},
        airframe=name,
        thrust_to_weight=None,
        rate_hz=RATE,
        link_delay_s=0.01,
        alter=alter,
    )


def fly(trial: VirtualFlight, seconds: float) -> Output:
    for _ in range(int(400 * seconds)):
        trial.step()
    return trial.companions[0].output


@pytest.fixture(scope="module")
def recorded() -> list[Sample]:
    """6 s of healthy hover as samples; copied by whoever changes them."""
    samples: list[Sample] = []

    def record(sample: Sample) -> Sample:
        samples.append(sample)
        return sample

    fly(flight("octo-x", [], mode=Mode.OBSERVE, alter=record), 6.0)
    return samples


def run(samples: list[Sample], mode: Mode = Mode.ALLOCATE) -> tuple[Stepped, list[Output]]:
    companion = Stepped(mode=mode)
    return companion, companion.steps(samples)


def test_a_healthy_hover_sends_nothing(recorded: list[Sample]) -> None:
    _, outputs = run(recorded)
    assert outputs[-1].mode == Mode.ALLOCATE
    assert outputs[-1].obstacle is None
    assert all(o.plan is None and not o.events for o in outputs)
    assert outputs[-1].effectiveness.min() > 0.9


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"gyro_rad_s": np.array([np.nan, 0, 0])}, "gyro"),
        ({"specific_force_m_s2": np.array([0, np.inf, 0])}, "accelerometer"),
        ({"output": np.full(8, np.nan)}, "motor outputs"),
        ({"output": np.full(6, 0.5)}, "6 motor outputs, the airframe 8"),
        ({"time_s": math.nan}, "time"),
        ({"time_s": 1.0}, "time jumped by -"),
        ({"time_s": 1e6}, "time jumped by +"),
    ],
)
def test_bad_input_degrades_to_observe_with_a_reason(recorded: list[Sample], change: dict[str, Any], word: str) -> None:
    companion, _ = run(recorded[:800])
    output = companion.step(dataclasses.replace(recorded[800], **change))
    assert output.mode == Mode.OBSERVE
    assert word in text_of(output)
    assert output.plan is None
    assert output.override is None
    assert companion.state.bad_samples >= 1


def test_after_bad_input_good_samples_bring_it_back(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:800])
    companion.step(dataclasses.replace(recorded[800], gyro_rad_s=np.full(3, np.nan)))
    modes = [companion.step(s).mode for s in recorded[801:]]
    assert modes[0] == Mode.OBSERVE, "one good sample is not enough"
    assert modes[-1] == Mode.ALLOCATE


def test_override_answers_nothing_to_a_bad_sample(recorded: list[Sample]) -> None:
    companion, outputs = run(recorded[:900], Mode.OVERRIDE)
    assert outputs[-1].override is not None
    assert np.all((outputs[-1].override >= 0) & (outputs[-1].override <= 1))
    for change in (
        {"quaternion": np.full(4, np.nan)},
        {"position_m": None},
        {"velocity_m_s": np.array([0, 0, np.inf])},
        {"gyro_rad_s": np.full(3, np.nan)},
        {"time_s": recorded[900].time_s + 5.0},
    ):
        assert companion.respond(dataclasses.replace(recorded[900], **change)) is None, change


def test_silence_is_an_observe_with_its_reason(recorded: list[Sample]) -> None:
    companion, _ = run(recorded)
    output = companion.interrupted()
    assert (output.mode, text_of(output)) == (Mode.OBSERVE, "telemetry stopped")
    assert output.time_s == recorded[-1].time_s, "what is sent now is stamped with the last sample, never with 0"


def test_on_the_ground_nothing_is_estimated(recorded: list[Sample]) -> None:
    idle = [dataclasses.replace(s, output=np.full(8, 0.15)) for s in recorded]
    _, outputs = run(idle)
    assert not any(o.flying for o in outputs)


@pytest.fixture(scope="module")
def faulty() -> VirtualFlight:
    """8 s with one fault each: total, partial, ramp, stuck, intermittent."""
    faults = [
        Fault(vehicle=0, motor=4, start_s=4.0),
        Fault(vehicle=1, motor=2, start_s=4.0, kind="partial", effectiveness=0.55),
        *(
            Fault(vehicle=k, motor=6, start_s=4.0, kind=kind, effectiveness=0.0, duration_s=1.5)
            for k, kind in enumerate(OTHERS, start=2)
        ),
    ]
    trial = flight("octo-x", faults, vehicles=len(faults))
    fly(trial, 8.0)
    return trial


def test_a_declaration_latches_while_the_motor_stands_still_and_the_operator_lifts_it(faulty: VirtualFlight) -> None:
    companion = faulty.companions[0]
    assert companion.output.failed.tolist() == [False] * 3 + [True] + [False] * 4
    assert faulty.fleet.autopilot.output[0, 3] == 0.0, "the declared motor is stopped"
    companion.order(Orders(lift=(4,)))
    assert not companion.output.failed.any()
    companion.order(Orders(adopt=(4,)))  # as it was


def test_a_wrong_declaration_is_lifted_by_evidence_while_the_motor_is_driven() -> None:
    trial = flight("octo-x", [], mode=Mode.OBSERVE)  # the autopilot goes on driving every motor
    fly(trial, 4.0)
    trial.companions[0].order(Orders(adopt=(2,)))
    output = fly(trial, 4.0)
    assert not output.failed.any()
    assert [(e.motor, e.declared) for _, e in trial.companions[0].events] == [(2, False)]


def test_a_motor_that_fails_partly_is_allocated_around_without_a_declaration(faulty: VirtualFlight) -> None:
    output = faulty.companions[1].output
    assert not output.failed.any()
    assert output.degraded.tolist() == [False, True] + [False] * 6
    assert output.effectiveness[1] == pytest.approx(0.55, abs=0.12)
    assert output.plan is not None


@pytest.mark.parametrize("kind", OTHERS)
def test_other_faults_name_no_healthy_motor(faulty: VirtualFlight, kind: str) -> None:
    vehicle = 2 + OTHERS.index(kind)
    named = {e.motor for _, e in faulty.companions[vehicle].events if e.declared}
    assert named <= {6}
    if kind != "stuck":
        assert named == {6}
    assert not faulty.fleet.state.crashed[vehicle]


@pytest.mark.parametrize("name", ["hexa-x", "octo-plus", "coax-x8", "paper-octo"])
def test_other_airframes_go_through_the_whole_companion(name: str) -> None:
    motors = vehicle.load(name).motors
    faults = [Fault(vehicle=k, motor=motor, start_s=4.0) for k, motor in enumerate((1, motors))]
    trial = flight(name, faults, wind=2.0, vehicles=2)
    fly(trial, 7.0)
    for fault, companion in zip(faults, trial.companions, strict=True):
        output = companion.output
        assert [int(i) + 1 for i in np.flatnonzero(output.failed)] == [fault.motor]
        assert output.plan is not None
        assert output.plan.matrix.shape == (motors, 4)
    assert not trial.fleet.state.crashed.any()


def test_a_flight_in_override_survives_a_failure_and_never_falls_back() -> None:
    trial = flight("octo-x", [Fault(vehicle=0, motor=5, start_s=6.0)], mode=Mode.OVERRIDE)
    worst = 0.0
    for cycle in range(int(400 * 12.0)):
        trial.step()
        if cycle > 400 * 3.0:
            assert trial.fleet.autopilot.allocation[0] == 3, "outputs of the companion are in force"
            worst = max(worst, float(np.linalg.norm(trial.fleet.state.position_m[0] - [0, 0, -10.0])))
    assert trial.companions[0].output.failed.tolist() == [False] * 4 + [True] + [False] * 3
    assert not trial.fleet.state.crashed[0]
    assert worst < 3.0


def test_duplicates_and_late_samples_are_ignored_without_forgetting(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:900])
    for sample in (recorded[899], recorded[897], recorded[899]):
        output = companion.step(sample)
        assert (output.mode, output.events) == (Mode.ALLOCATE, ())
        assert companion.respond(sample) is None
    assert companion.step(recorded[900]).mode == Mode.ALLOCATE
    assert companion.state.bad_samples == 3


def test_a_spike_no_vehicle_survives_is_refused_and_names_no_motor(recorded: list[Sample]) -> None:
    for axis in range(3):
        companion, _ = run(recorded[:700])
        spike = np.zeros(3)
        spike[axis] = 1e6
        output = companion.step(dataclasses.replace(recorded[700], gyro_rad_s=spike))
        assert "beyond" in text_of(output)
        assert not any(companion.step(s).failed.any() for s in recorded[701:])


def test_a_shock_in_the_air_does_not_end_the_watch(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:800])
    shock = np.array([0.0, 0.0, -90.0])
    for sample in recorded[800:802]:
        companion.step(dataclasses.replace(sample, specific_force_m_s2=shock))
    outputs = [companion.step(s) for s in recorded[802:]]
    assert outputs[-1].flying
    assert not outputs[-1].failed.any()


def test_override_falls_back_to_allocation_when_it_is_blind(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:900], Mode.OVERRIDE)
    blind = dataclasses.replace(recorded[900], position_m=None)
    output = companion.step(blind)
    assert output.mode == Mode.ALLOCATE
    assert "allocating instead" in text_of(output)
    sample = recorded[901]
    output = companion.step(sample)
    assert (output.mode, output.obstacle) == (Mode.OVERRIDE, None)


def test_override_holds_the_last_target_when_targets_stop(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:600], Mode.OVERRIDE)
    far = np.array([40.0, -20.0, -30.0])
    for sample in recorded[600:700]:
        moved = dataclasses.replace(sample, position_m=far, target_position_m=far, target_yaw_rad=math.nan)
        companion.step(moved)
    stopped = dataclasses.replace(recorded[700], position_m=far, velocity_m_s=np.zeros(3), target_position_m=None)
    answer = companion.respond(stopped)
    assert answer is not None
    assert companion.state.loop.hold is not None
    np.testing.assert_allclose(companion.state.loop.hold.position_m, far)


def test_override_keeps_its_hands_off_where_it_is_told_to(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:900], Mode.OVERRIDE)
    guided = Statement(Reason.NOT_GUIDED)
    companion.condition = Condition(takes_matrix=True, drive=guided)
    output = companion.step(recorded[900])
    assert (output.mode, output.obstacle, output.override) == (Mode.ALLOCATE, guided, None)
    companion.condition = OBEDIENT
    assert companion.respond(recorded[901]) is not None


def test_a_blocked_autopilot_gets_nothing_and_the_reason_is_shown(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:900])
    silent = Statement(Reason.SILENT, "the applet")
    companion.condition = Condition(takes_matrix=True, command=silent)
    output = companion.step(recorded[900])
    assert (output.mode, output.obstacle, output.plan) == (Mode.OBSERVE, silent, None)


def test_a_refused_plan_is_tried_again(recorded: list[Sample], monkeypatch: pytest.MonkeyPatch) -> None:
    solve = allocator("trim")
    calls: list[Problem] = []

    def flaky(problem: Problem) -> NDArray[np.float64]:
        calls.append(problem)
        if 1 < len(calls) <= 3:  # the first is that of the healthy vehicle
            raise SolverError("out of luck")
        return solve(problem)

    monkeypatch.setattr(companion_module, "allocator", lambda _: flaky)
    companion = Stepped()
    companion.steps(recorded[:700])
    first = companion.step(recorded[700], Orders(adopt=(6,)))
    outputs = companion.steps(recorded[701:800])
    assert first.rejected == 1
    assert "out of luck" in text_of(first)
    assert outputs[-1].plan is not None


@pytest.mark.parametrize(
    "garbage",
    [
        {"velocity_m_s": np.full(3, 1e308)},
        {"velocity_m_s": np.array([0.0, math.nan, 0.0])},
        {"quaternion": np.array([1e200, 1e200, 0.0, 0.0])},
        {"quaternion": np.zeros(4)},
        {"quaternion": np.array([math.inf, 0.0, 0.0, 0.0])},
    ],
    ids=["huge-velocity", "nan-velocity", "huge-attitude", "no-attitude", "infinite-attitude"],
)
def test_a_garbage_state_reaches_neither_the_network_nor_a_motor(
    recorded: list[Sample], garbage: dict[str, Any]
) -> None:
    companion, _ = run(recorded[:900], Mode.OVERRIDE)
    assert companion.companion.network is not None
    with np.errstate(all="raise"):
        for sample in recorded[900:920]:
            bad = dataclasses.replace(sample, **garbage)
            answer = companion.respond(bad)
            assert answer is None
            output = companion.step(bad)
            assert output.mode == Mode.ALLOCATE
            assert "not those of a vehicle" in text_of(output)
    outputs = [companion.step(s) for s in recorded[920:1000]]
    assert outputs[-1].mode == Mode.OVERRIDE
    assert outputs[-1].estimate is not None
    assert np.isfinite(outputs[-1].estimate.disturbance).all()
    assert not any(o.events for o in outputs)


def test_a_residual_that_is_not_finite_starts_the_estimate_anew(recorded: list[Sample]) -> None:
    companion, _ = run(recorded[:900])
    assert companion.state.estimate is not None
    companion.state.estimate.disturbance.adaptation.a[:] = math.nan
    output = companion.step(recorded[900])
    assert output.mode == Mode.OBSERVE
    assert "not finite" in text_of(output)
    outputs = [companion.step(s) for s in recorded[901:1100]]
    assert outputs[-1].obstacle is None


def test_what_leaves_a_step_cannot_be_changed_and_does_not_change(recorded: list[Sample]) -> None:
    companion, outputs = run(recorded[:300])
    outputs.append(companion.step(recorded[300], Orders(adopt=(2,))))
    kept = [(o.failed.copy(), o.effectiveness.copy(), o.deviation.copy()) for o in outputs]
    outputs += companion.steps(recorded[301:400])
    outputs.append(companion.step(None, Orders(lift=(2,))))
    for output, (failed, effectiveness, deviation) in zip(outputs, kept, strict=False):
        np.testing.assert_array_equal(output.failed, failed)
        np.testing.assert_array_equal(output.effectiveness, effectiveness)
        np.testing.assert_array_equal(output.deviation, deviation)
        for array in (output.failed, output.effectiveness, output.deviation, output.degraded, output.believed):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1
