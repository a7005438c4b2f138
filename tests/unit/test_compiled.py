"""The emulated vehicle's compiled code: what it takes, what it leaves alone, and when it is compiled anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nff_companion.core import vehicle
from sitl import airframe, compiled, fleet, plant, sensors, wind
from sitl.autopilot import autopilot
from sitl.faults import Fault, FaultSchedule
from sitl.fleet import Fleet, FleetOptions
from sitl.noise import NormalBlocks, vehicle_generators
from sitl.serve.physics import Physics, PhysicsOptions
from sitl.trials.warm_up import compile_all

KERNELS: tuple[Any, ...] = (
    fleet._fly,
    autopilot._cycle,
    autopilot._begin,
    sensors._settle,
    plant._advance_all,
    plant._specific_forces,
    wind._blow_all,
)


def flying(name: str = "octo-x", vehicles: int = 1, **options: Any) -> Fleet:
    parameters = airframe.load(vehicle.path_of(name), vehicles=vehicles)
    return Fleet(parameters, FleetOptions(seeds=list(range(vehicles)), height_m=5.0, **options))


def test_every_airframe_and_number_of_vehicles_flies_by_the_same_machine_code() -> None:
    compile_all()
    gusts = np.array([[0.0, 0.0, 1.0, 1.0, 2.0, 3.0]])
    flying("coax-x8", 3, turbulence_m_s=1.0, gusts=gusts).step()
    flying("hexa-x", 2, wind_m_s=[1.0, 2.0], turbulence_m_s=[0.0, 1.0]).step()
    physics = Physics(airframe.load(vehicle.path_of("h250")), PhysicsOptions())
    physics.step(np.full(4, 0.5), 0.004)
    physics.inertial()
    assert {kernel.__name__: len(kernel.signatures) for kernel in KERNELS} == {k.__name__: 1 for k in KERNELS}


def test_what_others_set_may_be_of_any_layout_and_kind() -> None:
    one, other = flying(vehicles=2), flying(vehicles=2)
    one.autopilot.position.goal = np.array([[1.0, 2.0, -6.0], [-2.0, 0.0, -5.0]])
    other.autopilot.position.goal = np.asfortranarray([[1, 2, -6], [-2, 0, -5]])
    one.autopilot.position.goal_yaw_rate = np.array([0.25, 0.25])
    other.autopilot.position.goal_yaw_rate = np.broadcast_to(np.float32(0.25), (2,))
    for _ in range(40):
        one.step()
        other.step()
    np.testing.assert_array_equal(one.state.position_m, other.state.position_m)
    assert np.abs(one.autopilot.position.goal_yaw - one.autopilot.position.goal_yaw[0]).max() < 0.2


def test_arguments_of_another_type_are_refused_instead_of_compiled_in_flight() -> None:
    craft = flying()
    craft.autopilot.armed = craft.autopilot.armed.astype(np.int64)
    with pytest.raises(TypeError):
        craft.step()


def test_who_keeps_an_array_keeps_what_it_was() -> None:
    craft = flying(wind_m_s=3.0, turbulence_m_s=1.0)
    pilot = craft.autopilot
    pilot.position.goal[0, 0] = 3.0
    for _ in range(5):
        craft.step()
    owners = (craft.state, craft.sensors.measured, pilot.position, pilot.attitude, pilot, craft)
    kept = [
        (owner, name, value, value.copy())
        for owner in owners
        for name in (getattr(owner, "__slots__", None) or vars(owner))
        if not name.startswith("_") and isinstance(value := getattr(owner, name), np.ndarray)
    ]
    for _ in range(5):
        craft.step()
    for _, name, value, was in kept:
        np.testing.assert_array_equal(value, was, err_msg=name)
    changed = {name for owner, name, value, _ in kept if not np.array_equal(getattr(owner, name), value)}
    assert changed >= {"position_m", "quaternion", "thrust_n", "gyro_rad_s", "path", "target", "output", "max_tilt_rad"}


def test_draws_are_the_same_taken_one_by_one_or_several_at_once() -> None:
    one = NormalBlocks(vehicle_generators([1, 2], 0), 3, block=8)
    several = NormalBlocks(vehicle_generators([1, 2], 0), 3, block=8)
    drawn = np.stack([one.next() for _ in range(30)], axis=1)
    expected = np.stack([generator.standard_normal((32, 3)) for generator in vehicle_generators([1, 2], 0)])
    np.testing.assert_array_equal(drawn, expected[:, :30])
    for k in range(0, 30, 3):
        place = several.take(3)
        np.testing.assert_array_equal(several.buffer[:, place : place + 3], drawn[:, k : k + 3])


def test_faults_over_some_steps_are_those_at_each() -> None:
    faults = [
        Fault(vehicle=0, motor=1, start_s=0.01, until_s=0.03),
        Fault(vehicle=1, motor=2, start_s=0.02, kind="ramp", duration_s=0.02),
        Fault(vehicle=1, motor=1, start_s=0.05, kind="stuck"),
    ]
    together, each = FaultSchedule(2, 4, faults), FaultSchedule(2, 4, faults)
    for cycle in range(30):
        times = [0.0025 * cycle + k / 1200 for k in range(3)]
        over = together.over(times)
        for k, time_s in enumerate(times):
            for values, at in zip(over, each.at(time_s), strict=True):
                np.testing.assert_array_equal(values[k], at)
    together.add(Fault(vehicle=0, motor=3, start_s=0.0))
    assert together.over([0.08])[0][0, 0, 2] == 0.0
    together.clear(0, 3)
    assert together.over([0.08])[0][0, 0, 2] == 1.0


def test_a_change_of_any_file_with_compiled_parts_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(compiled.__file__).parent
    with_parts = [p for p in folder.rglob("*.py") if "sitl.compiled import" in p.read_text(encoding="utf-8")]
    assert {p.name for p in with_parts} >= {"plant.py", "rotation.py", "mixer.py", "fleet.py"}
    assert {p.parent for p in with_parts} <= {folder, folder / "autopilot"}, "else their sources must be looked at too"
    (tmp_path / "autopilot").mkdir()
    names = set()
    monkeypatch.setattr(compiled, "_FOLDER", tmp_path)
    for text in ("a = 1", "a = 2"):
        (tmp_path / "autopilot" / "part.py").write_text(text, encoding="utf-8")
        names.add(compiled._sources.__wrapped__())
    assert len(names) == 2


def test_without_a_folder_for_it_the_code_is_compiled_in_each_process(monkeypatch: pytest.MonkeyPatch) -> None:
    for locator in (compiled.Provided, compiled.InTree, compiled.UserWide):
        monkeypatch.setattr(locator, "from_function", classmethod(lambda cls, function, file: None))
    assert compiled.kernel(_twice)(2.5) == 5.0


def _twice(value: float) -> float:
    return 2.0 * value
