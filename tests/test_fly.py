"""Flights on real firmware, as far as they can be tried without it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nff_companion.core import vehicle
from sitl.trials.fly import px4
from sitl.trials.fly.px4_parameters import default_of, parameters

PREFIX = "PX4_PARAM_"
EPSILON = 1.2e-7  # FLT_EPSILON: what PX4 takes for equal


def written(name: str) -> dict[str, float]:
    model = vehicle.load(name, thrust_to_weight=1.55)
    options = px4.FlyOptions(binary=Path("px4"), airframe=name)
    found = parameters(model, options.height_m)
    assert all(key.startswith(PREFIX) for key in found)
    return {key.removeprefix(PREFIX): float(value) for key, value in found.items()}


@pytest.mark.parametrize("name", vehicle.names())
def test_no_parameter_is_passed_to_px4_at_its_default_where_the_start_script_would_win(name: str) -> None:
    """PX4 drops from its environment what equals a default, and the airframe's start script then sets its own."""
    for parameter, value in written(name).items():
        assert abs(np.float32(value) - np.float32(default_of(parameter))) > EPSILON, f"{parameter} = {value}"


@pytest.mark.parametrize("name", vehicle.names())
def test_px4_is_told_every_rotor_where_it_is(name: str) -> None:
    model, told = vehicle.load(name), written(name)
    assert told["CA_ROTOR_COUNT"] == model.motors
    for i in range(model.motors):
        place = [told[f"CA_ROTOR{i}_PX"], told[f"CA_ROTOR{i}_PY"]]
        assert place == pytest.approx(model.position_m[i].tolist(), abs=2e-4)
        assert told[f"CA_ROTOR{i}_KM"] == pytest.approx(model.motor.torque_per_thrust_m * model.spin[i], abs=2e-4)
        assert told[f"PWM_MAIN_FUNC{i + 1}"] == 101 + i


def test_a_drag_that_is_px4s_default_is_passed_too(tmp_path: Path) -> None:
    text = vehicle.path_of("hexa-x").read_text(encoding="utf-8")
    changed = text.replace("torque_per_thrust_m = 0.018", "torque_per_thrust_m = 0.05")
    assert changed != text
    (tmp_path / "hexa.toml").write_text(changed, encoding="utf-8")
    told = written(str(tmp_path / "hexa.toml"))
    drags = [told[f"CA_ROTOR{i}_KM"] for i in range(6)]
    assert all(abs(drag - 0.05) > 1e-6 for drag in drags)
    assert np.abs(drags) == pytest.approx(np.full(6, 0.05), abs=2e-4)


@pytest.mark.parametrize(("name", "kind"), [("h250", 2), ("hexa-x", 13), ("octo-plus", 14)])
def test_px4_is_told_what_kind_of_vehicle_it_is(name: str, kind: int) -> None:
    assert written(name)["MAV_TYPE"] == kind
