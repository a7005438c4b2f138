"""PX4's allocator foreseen: which declarations it flies with, which never, and when nothing helps."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, octo, without
from unlike_rotors import having, loaded

from nff_companion.autopilots.px4 import allocator
from nff_companion.autopilots.px4.remedy import Advisor, NoRemedy, Remedy, geometry_of
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle

# Both motors told dead drove all eight outputs of a flown PX4 v1.16 to zero.
COLLAPSE = {(1, 7), (1, 8), (2, 7), (2, 8), (3, 4), (3, 5), (4, 6), (5, 6)}


def geometry(model: Vehicle) -> allocator.Geometry:
    px4 = FakePx4(model)
    return geometry_of({name: px4.value(name) for name in px4.names}, model.motors)


def test_the_pairs_that_collapse_are_those_that_did_in_flight() -> None:
    model = octo()
    advisor = Advisor(model, geometry(model))
    found = set()
    for pair in itertools.combinations(range(1, 9), 2):
        eta = without(model, pair)
        if advisor.predict(eta, eta, yaw_released=False).thrust_ratio < 0.1:
            found.add(pair)
    assert found == COLLAPSE


@pytest.mark.parametrize("ratio", [1.55, 2.56])
def test_no_remedy_ever_triggers_a_collapse(ratio: float) -> None:
    model = octo(ratio)
    advisor = Advisor(model, geometry(model))
    for pair in itertools.combinations(range(1, 9), 2):
        remedy = advisor.remedy(without(model, pair))
        if isinstance(remedy, NoRemedy):
            continue
        told = advisor.predict(remedy.effectiveness, without(model, pair), yaw_released=remedy.yaw_released)
        assert told.thrust_ratio >= 1.0
        assert pair not in COLLAPSE or remedy.yaw_released


def test_a_hexarotor_is_told_together_with_its_yaw() -> None:
    model = vehicle.load("hexa-x", thrust_to_weight=2.56)
    advisor = Advisor(model, geometry(model))
    for motor in range(1, 7):
        remedy = advisor.remedy(without(model, (motor,)))
        assert isinstance(remedy, Remedy)
        assert remedy.yaw_released


def test_what_the_autopilot_trims_out_all_the_time_is_no_torque_left_over(tmp_path: Path) -> None:
    """A calibrated hexarotor: centre of mass beside the middle, rotors not quite alike."""
    text = vehicle.path_of("hexa-x").read_text(encoding="utf-8")
    unlike = [f"thrust = {share}" for share in (1.12, 1.12, 0.94, 0.92, 0.95, 0.95)]
    head = ["centre_of_mass_m = [-0.003, 0.003, 0.0]"]
    model = loaded(tmp_path, having(unlike, head=head, text=text), thrust_to_weight=2.56)
    advisor = Advisor(model, geometry(vehicle.load("hexa-x")))
    for motor in range(1, 7):
        remedy = advisor.remedy(without(model, (motor,)))
        assert isinstance(remedy, Remedy), remedy
        assert remedy.yaw_released


def test_motors_that_cannot_carry_the_weight_are_told_from_an_allocator_that_would_not() -> None:
    model = octo(1.55)
    advisor = Advisor(model, geometry(model))
    too_few, collapsing = advisor.remedy(without(model, (1, 2, 3, 5))), advisor.remedy(without(model, (1, 7)))
    assert isinstance(too_few, NoRemedy)
    assert too_few.no_lift  # 4 of 8 motors give 0.78 of the weight
    assert isinstance(collapsing, NoRemedy)
    assert not collapsing.no_lift


def test_a_healthy_hover_is_even_and_balanced() -> None:
    model = octo()
    g = geometry(model)
    hover = allocator.allocate(allocator.mix_matrix(g), np.array([0, 0, 0, 0, 0, -0.4]), g)
    assert hover == pytest.approx(np.full(8, 0.4), abs=1e-6)
    for axis in range(3):
        demand = np.array([0, 0, 0, 0, 0, -0.5])
        demand[axis] = 0.1
        wrench = model.effectiveness @ allocator.allocate(allocator.mix_matrix(g), demand, g)
        assert wrench[1 + axis] > 0.01
        assert np.delete(wrench[1:], axis) == pytest.approx(np.zeros(2), abs=1e-6)


@pytest.mark.parametrize("motor", range(1, 5))
def test_of_two_above_each_other_of_which_one_is_lost_no_yaw_is_made(motor: int) -> None:
    """By their difference PX4 drove the dead one of them to 0.9, and the vehicle crashed."""
    model = vehicle.load("coax-x8")
    place = model.position_m[motor - 1]
    (mate,) = [i for i in range(8) if i != motor - 1 and np.allclose(model.position_m[i, :2], place[:2])]
    eta = np.ones(8)
    eta[[motor - 1, mate]] = 0.5
    remedy = Advisor(model, geometry(model)).remedy(eta)
    assert isinstance(remedy, Remedy), remedy
    assert set(remedy.still) == {motor - 1, mate}
    mix = allocator.mix_matrix(geometry(model).scaled(eta, still=remedy.still))
    np.testing.assert_allclose(mix[motor - 1], mix[mate], atol=1e-9)
    apart = eta.copy()
    apart[mate] = 0.6  # each has lost a part of its own
    other = Advisor(model, geometry(model)).remedy(apart)
    assert not isinstance(other, NoRemedy)
    assert other.still == ()
