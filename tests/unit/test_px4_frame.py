"""The rotors that PX4 is configured with against the airframe file: place, order and spin."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, in_flight, octo, tell, without
from other_airframes import OWN, SHIPPED, wrong_files

from nff_companion.autopilots.px4.remedy import disagreement, geometry_of
from nff_companion.condition import Reason
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.frames import catalogue

pytestmark = pytest.mark.usefixtures("nothing_ahead")


def rotors(model: Vehicle, scale: float = 1.0) -> dict[str, float]:
    """What PX4 is configured with for an airframe, in any unit of length."""
    px4 = FakePx4(model)
    values = {name: px4.value(name) for name in px4.names}
    return {name: scale * value if name.endswith(("_PX", "_PY")) else value for name, value in values.items()}


@pytest.mark.parametrize("name", [*SHIPPED, *OWN])
def test_the_file_of_the_rotors_that_are_configured_agrees_in_any_scale(name: str) -> None:
    model = vehicle.load(name)
    for scale in (1.0, 0.3, 7.0):
        assert disagreement(geometry_of(rotors(model, scale), model.motors), model) == ""


@pytest.mark.parametrize("name", SHIPPED)
def test_the_file_of_px4s_own_frame_agrees(name: str) -> None:
    model, frame = vehicle.load(name), catalogue.by_name(SHIPPED[name])
    values = rotors(model)
    for i, (x, y) in enumerate(frame.place):
        values |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_KM": 0.05 * frame.spin[i]}
    assert frame.px4
    assert disagreement(geometry_of(values, model.motors), model) == ""


@pytest.mark.parametrize("name", [*SHIPPED, *OWN])
def test_reversed_spins_and_any_two_motors_that_changed_numbers_are_named(name: str) -> None:
    model = vehicle.load(name)
    geometry = geometry_of(rotors(model), model.motors)
    for what, file in wrong_files(model).items():
        found = disagreement(geometry, file)
        if what == "all spins":
            assert found.startswith("all spins are reversed: motor 1 is ")
        else:
            for motor, other in (what.split(" and "), what.split(" and ")[::-1]):
                assert f"motor {motor}: the airframe file has it at " in found, what
                assert f"and its motor {other} there" in found, what


def test_every_other_frame_of_px4_is_named() -> None:
    for name in SHIPPED:
        model = vehicle.load(name)
        for frame in catalogue.frames().values():
            if not frame.px4 or frame.motors != model.motors or frame.name == SHIPPED[name]:
                continue
            values = rotors(model)
            for i, (x, y) in enumerate(frame.place):
                values |= {f"CA_ROTOR{i}_PX": x, f"CA_ROTOR{i}_PY": y, f"CA_ROTOR{i}_KM": 0.05 * frame.spin[i]}
            assert disagreement(geometry_of(values, model.motors), model), (name, frame.name)


def test_the_coaxial_file_on_a_flat_px4_is_said_to_be_that() -> None:
    found = disagreement(geometry_of(rotors(octo()), 8), vehicle.load("coax-x8"))
    assert found.startswith("the airframe file's motors are those of coax-x8 (FRAME_CLASS 4, FRAME_TYPE 1), not of CA_")


def test_a_wrong_file_is_observed_with_the_reason_and_nothing_is_told(tmp_path: Path, rng: np.random.Generator) -> None:
    model = octo()
    wrong = wrong_files(model)
    for k, what in enumerate(["all spins", *rng.choice(list(wrong)[1:], 2, replace=False)]):
        folder = tmp_path / str(k)
        folder.mkdir()
        px4 = FakePx4(model)
        adapter, now = in_flight(folder, px4, wrong[what])
        command = adapter.condition(now).command
        assert command is not None, what
        assert command.reason == Reason.CONTRADICTION
        assert ("all spins are reversed" if k == 0 else f"motor {what.split()[0]}: ") in command.text
        assert tell(adapter, px4, without(model, (3,)), now) == []
        assert "PARAM_SET" not in px4.kinds_received()
