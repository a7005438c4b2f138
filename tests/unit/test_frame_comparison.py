"""An airframe file against a frame: what agrees, and what is said where it does not."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest
from other_airframes import OWN, PAIRS, SHIPPED, altered, swapped

from nff_companion.core import vehicle
from nff_companion.frames import catalogue
from nff_companion.frames.catalogue import Frame
from nff_companion.frames.comparison import agrees, contradictions_of_frame, frame_of


def named(wrong: list[str]) -> list[int]:
    """Motors that are named, from 1."""
    return [int(found[1]) for text in wrong if (found := re.match(r"motor (\d+): ", text))]


def as_px4(frame: Frame) -> Frame:
    """The same places as a firmware has them that scales both axes alike."""
    return Frame(frame.name, frame.place, frame.spin)


def test_every_shipped_airframe_is_a_frame_of_the_catalogue_or_said_to_be_none() -> None:
    assert {*SHIPPED, *OWN} == {*vehicle.names()}
    for name, frame in SHIPPED.items():
        found = frame_of(vehicle.load(name))
        assert found is not None
        assert found.name == frame
    assert frame_of(vehicle.load("paper-octo")) is None


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_a_file_agrees_with_its_frame_of_either_firmware(name: str, frame: str) -> None:
    known = catalogue.by_name(frame)
    assert known.ardupilot
    assert known.px4
    for one in (known, as_px4(known)):
        assert contradictions_of_frame(vehicle.load(name), one) == []


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_places_a_tenth_off_and_a_centre_of_mass_beside_the_middle_agree(
    name: str, frame: str, rng: np.random.Generator
) -> None:
    loaded, known = vehicle.load(name), catalogue.by_name(frame)
    arm = np.hypot(*loaded.position_m.T)
    for _ in range(200):
        toward, off = rng.uniform(0.0, 2.0 * np.pi, loaded.motors), 0.1 * arm * rng.uniform(0.0, 1.0, loaded.motors)
        place = loaded.position_m + (off * [np.cos(toward), np.sin(toward)]).T
        angle = rng.uniform(0.0, 2.0 * np.pi)
        place = place + 0.05 * arm.max() * np.array([np.cos(angle), np.sin(angle)])
        for one in (known, as_px4(known)):
            assert contradictions_of_frame(altered(loaded, place), one) == []


@pytest.mark.parametrize("name", [n for n, f in catalogue.frames().items() if f.ardupilot and not f.without])
def test_length_and_width_are_not_compared_with_each_other_where_the_mixer_does_not(name: str) -> None:
    frame, loaded = catalogue.by_name(name), vehicle.load("octo-x")
    for stretch in ([1.0, 1.0], [1.6, 1.0], [1.0, 1.6]):
        assert agrees(altered(loaded, frame.place * stretch, frame.spin), frame)


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_all_spins_reversed_is_one_sentence(name: str, frame: str) -> None:
    loaded, known = vehicle.load(name), catalogue.by_name(frame)
    for one in (known, as_px4(known)):
        (text,) = contradictions_of_frame(altered(loaded, spin=-loaded.spin), one, "what flies")
        assert text.startswith("all spins are reversed: motor 1 is ")
        ours, theirs = (catalogue.SPIN_NAMES[int(s)] for s in (-loaded.spin[0], known.spin[0]))
        assert f"motor 1 is {ours}" in text
        assert f"what flies has it {theirs}" in text


def test_spins_reversed_that_are_another_frame_name_it() -> None:
    quad = vehicle.load("h250")
    frame, reversed_one = catalogue.by_name("quad-x"), catalogue.by_name("quad-h")
    (text,) = contradictions_of_frame(altered(quad, reversed_one.place, reversed_one.spin), frame)
    assert "as of quad-h (FRAME_CLASS 1, FRAME_TYPE 3)" in text


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_two_motors_that_changed_places_are_named_and_no_others(name: str, frame: str) -> None:
    loaded, known = vehicle.load(name), catalogue.by_name(frame)
    for one in (known, as_px4(known)):
        for first, second in combinations(range(loaded.motors), 2):
            wrong = contradictions_of_frame(swapped(loaded, first, second), one)
            assert named(wrong) == [first + 1, second + 1], (first + 1, second + 1)
            assert f"and its motor {second + 1} there" in next(t for t in wrong if t.startswith(f"motor {first + 1}:"))


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_one_motor_that_turns_the_other_way_is_named_alone(name: str, frame: str) -> None:
    loaded, known = vehicle.load(name), catalogue.by_name(frame)
    for motor in range(loaded.motors):
        spin = loaded.spin.copy()
        spin[motor] *= -1.0
        assert named(contradictions_of_frame(altered(loaded, spin=spin), known)) == [motor + 1]


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_a_nose_that_is_turned_is_seen(name: str, frame: str) -> None:
    loaded, known = vehicle.load(name), catalogue.by_name(frame)
    for turns in (1, 2, 3):
        angle = 0.5 * np.pi * turns
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        wrong = named(contradictions_of_frame(altered(loaded, loaded.position_m @ turn), known))
        assert len(wrong) >= loaded.motors // 2


@pytest.mark.parametrize("name", [*SHIPPED, *OWN])
def test_every_other_frame_is_seen_to_be_another(name: str) -> None:
    loaded, mine = vehicle.load(name), SHIPPED.get(name)
    for frame in catalogue.frames().values():
        wrong = contradictions_of_frame(loaded, frame)
        assert bool(wrong) != (mine is not None and _equal(frame, catalogue.by_name(mine))), frame.name
        if frame.motors != loaded.motors and not frame.without:
            assert wrong == [f"the airframe file has {loaded.motors} motors, {frame.name} has {frame.motors}"]


def _equal(one: Frame, other: Frame) -> bool:
    return one.motors == other.motors and bool(np.all(one.spin == other.spin)) and np.allclose(one.place, other.place)


def test_the_coaxial_file_on_the_flat_frame_is_named_with_both_places_of_each_motor() -> None:
    wrong = contradictions_of_frame(
        vehicle.load("coax-x8"), catalogue.by_name("octo-x"), "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)"
    )
    assert wrong[0] == (
        "the airframe file's motors are those of coax-x8 (FRAME_CLASS 4, FRAME_TYPE 1),"
        " not of FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)"
    )
    assert wrong[1] == (
        "motor 1: the airframe file has it at 45 deg, ccw; FRAME_CLASS 3, FRAME_TYPE 1 (octo-x) at 22.5 deg, cw"
    )
    assert named(wrong) == list(range(1, 9))


def test_a_coaxial_pair_whose_motors_changed_places_is_seen_by_spin() -> None:
    wrong = contradictions_of_frame(swapped(vehicle.load("coax-x8"), 0, 5), catalogue.by_name("coax-x8"))
    assert wrong == [
        "motor 1: the airframe file has it at 45 deg, cw; coax-x8 at 45 deg, ccw, and its motor 6 there",
        "motor 6: the airframe file has it at 45 deg, ccw; coax-x8 at 45 deg, cw, and its motor 1 there",
    ]


def test_arms_of_unequal_length_are_compared() -> None:
    frame = catalogue.by_name("quad-x-clockwise")
    place = frame.place.copy()
    place[2] *= 0.5
    (text,) = contradictions_of_frame(altered(vehicle.load("h250"), place, frame.spin), as_px4(frame))
    assert text.startswith("motor 3: the airframe file has it at -135 deg, ccw, at 0.50 of the longest arm")
    assert text.endswith("at -135 deg, ccw, at 1.00 of the longest arm")


@pytest.mark.parametrize("name", ["quad-v-tail", "quad-x-no-yaw"])
def test_a_frame_without_a_model_agrees_with_nothing(name: str) -> None:
    (text,) = contradictions_of_frame(vehicle.load("h250"), catalogue.by_name(name))
    assert "there is no model of it" in text


def test_motors_at_the_centre_are_no_place_and_no_number_breaks() -> None:
    frame = catalogue.by_name("quad-x-clockwise")
    nowhere = Frame("none", np.zeros((4, 2)), frame.spin)
    assert named(contradictions_of_frame(vehicle.load("h250"), nowhere)) == [1, 2, 3, 4]
    line = Frame("line", frame.place * [1.0, 0.0], frame.spin, ((1, 1),))
    assert named(contradictions_of_frame(vehicle.load("h250"), line)) == [1, 2, 3, 4]
