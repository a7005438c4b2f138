"""A motor that gives seven tenths for five seconds: said within one, with what is left, and until it works again."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from nff_companion.condition import Mode, Reason
from nff_companion.core import vehicle as vehicles
from nff_companion.core.answers import Answers
from nff_companion.core.estimator import Estimator
from nff_companion.core.sample import Sample
from nff_companion.errors import SolverError
from sitl import airframe
from sitl.faults import Fault
from sitl.fleet import Fleet, FleetOptions
from sitl.trials.virtual import TrialOptions, VirtualFlight

FROM_S, UNTIL_S = 4.0, 9.0


def flown_from(name: str, until_s: float) -> VirtualFlight:
    fault = Fault(vehicle=0, motor=3, kind="partial", effectiveness=0.7, start_s=FROM_S, until_s=until_s)
    options = FleetOptions(seeds=[1], height_m=10.0, wind_m_s=3.0, turbulence_m_s=0.75, model_error=0.05)
    fleet = Fleet(airframe.load(vehicles.path_of(name)), options, [fault])
    return VirtualFlight(fleet, {0: TrialOptions(mode=Mode.ALLOCATE)}, airframe=name)


@pytest.mark.parametrize(("name", "motors"), [("octo-x", (3,)), ("octo-plus", (3,)), ("coax-x8", (3, 8))])
def test_a_part_of_a_motor_is_said_while_it_is_lost(name: str, motors: tuple[int, ...]) -> None:
    flight = flown_from(name, UNTIL_S)
    fleet = flight.fleet
    companion, changes, said = flight.companions[0], list[tuple[float, tuple[int, ...]]](), set[Reason]()
    while fleet.time_s < UNTIL_S + 2.0:
        flight.step()
        output = companion.output
        if output.weak != (changes[-1][1] if changes else ()):
            changes.append((fleet.time_s, output.weak))
        if output.weak:
            assert output.weak_left == pytest.approx(0.7, abs=0.05)
            document = companion.session.document(fleet.time_s)
            assert document["weak"] == {"motors": list(motors), "left": round(output.weak_left, 2)}
            said.add(companion.session.moment().verdict.reason)
    assert [weak for _, weak in changes] == [motors, ()]
    assert changes[0][0] - FROM_S < 1.0
    assert 0.0 < changes[1][0] - UNTIL_S < 0.6
    assert said <= {Reason.WEAK, Reason.PARTIAL, Reason.TELLING}
    assert companion.events == []


def test_it_stays_said_when_the_telemetry_stops_and_a_solver_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the vehicle works again: what is learnt after a gap hides the loss, but does not end it."""
    flight = flown_from("octo-x", math.inf)
    companion, step = flight.companions[0], Answers.lost

    def failing(*_: Any) -> Any:
        raise np.linalg.LinAlgError("singular")

    while flight.fleet.time_s < 10.0:
        flight.step()
        now_s = flight.fleet.time_s
        if 5.5 < now_s < 6.0:
            companion.down.receive(math.inf)  # lost
        monkeypatch.setattr(Answers, "lost", failing if 7.0 < now_s < 9.0 else step)
        if now_s > 5.0:
            assert companion.output.weak == (3,)
            assert companion.output.weak_left == pytest.approx(0.7, abs=0.05)
    assert companion.output.mode == Mode.ALLOCATE
    assert companion.events == []
    assert not flight.fleet.state.crashed.any()


def test_wear_stays_said_when_the_link_is_lost_samples_are_no_numbers_and_a_solver_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    faults = [Fault(vehicle=0, motor=3, start_s=12.0, kind="partial", effectiveness=0.88)]
    options = FleetOptions(seeds=[7], wind_m_s=3.0, turbulence_m_s=0.75, height_m=20.0)
    fleet = Fleet(airframe.load(vehicles.path_of("octo-x"), vehicles=1), options, faults)

    def altered(sample: Sample) -> Sample:
        nan = 19.5 < fleet.time_s < 19.7
        return dataclasses.replace(sample, gyro_rad_s=np.full(3, np.nan)) if nan else sample

    def failing(*_: Any) -> Any:
        raise SolverError("singular")

    step = Estimator.step
    flight = VirtualFlight(fleet, {0: TrialOptions()}, airframe="octo-x", alter=altered)
    companion = flight.companions[0]
    while fleet.time_s < 22.0:
        flight.step()
        if 18.5 < fleet.time_s < 19.0:
            companion.down.receive(math.inf)  # lost
        monkeypatch.setattr(Estimator, "step", failing if 20.2 < fleet.time_s < 20.4 else step)
        if fleet.time_s > 18.5:
            assert companion.output.worn == (3,)
            assert companion.output.worn_left == pytest.approx(0.88, abs=0.05)
    assert companion.output.bad_samples > 20
    assert companion.events == []
    assert not fleet.state.crashed.any()
