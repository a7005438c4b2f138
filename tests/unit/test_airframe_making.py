"""Airframe files made of a frame's name or of parameters: what is read is kept, what is not is marked as guessed."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import DATA

from nff_companion.autopilots.ardupilot import checks
from nff_companion.autopilots.px4 import outputs
from nff_companion.core import vehicle
from nff_companion.errors import ConfigError
from nff_companion.frames import ardupilot, catalogue, draft, px4
from nff_companion.frames.parameter_file import Parameters
from nff_companion.frames.reading import Reading
from nff_companion.frames.servo_functions import function_of
from sitl import airframe as plant

FLYING = [name for name, frame in catalogue.frames().items() if not frame.without]


def octa(**changes: float) -> Parameters:
    """ArduCopter, octa X, motors on outputs 1 to 8."""
    values: dict[str, float] = {f"SERVO{n}_FUNCTION": 32 + n for n in range(1, 9)}
    values |= {"FRAME_CLASS": 3, "FRAME_TYPE": 1, "MOT_PWM_MIN": 1050, "MOT_PWM_MAX": 1950, "MOT_SPIN_MIN": 0.12}
    values |= {"MOT_SPIN_MAX": 0.9, "MOT_THST_EXPO": 0.7, "MOT_THST_HOVER": 0.33}
    values |= {"INS_GYRO_FILTER": 42, "INS_ACCEL_FILTER": 15}
    return Parameters(values | changes, "parameter file octa.param")


def hexa(*without: str, **changes: float) -> Parameters:
    """PX4, hexarotor X as SYS_AUTOSTART 6001 has it, all its parameters."""
    places = [(0, 0.5, -1), (0, -0.5, 1), (0.43, -0.25, -1), (-0.43, 0.25, 1), (0.43, 0.25, 1), (-0.43, -0.25, -1)]
    values: dict[str, float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 6, "SYS_AUTOSTART": 6001, "CA_R_REV": 0}
    for k, (x, y, spin) in enumerate(places):
        values |= {f"CA_ROTOR{k}_PX": x, f"CA_ROTOR{k}_PY": y, f"CA_ROTOR{k}_PZ": 0, f"CA_ROTOR{k}_KM": 0.05 * spin}
        values |= {f"CA_ROTOR{k}_AX": 0, f"CA_ROTOR{k}_AY": 0, f"CA_ROTOR{k}_AZ": -1, f"CA_ROTOR{k}_CT": 6.5}
        values |= {f"PWM_MAIN_FUNC{k + 1}": 101 + k, f"PWM_MAIN_MIN{k + 1}": 1100, f"PWM_MAIN_MAX{k + 1}": 1900}
    values |= {"THR_MDL_FAC": 0.3, "MPC_THR_HOVER": 0.45, "IMU_GYRO_CUTOFF": 30, "PWM_MAIN_TIM0": 400}
    values |= changes
    return Parameters({k: v for k, v in values.items() if k not in without}, "parameter file hexa.params")


def made(reading: Reading, folder: Path, arm_m: float = 0.4, mass_kg: float | None = 4.0) -> vehicle.Vehicle:
    path = folder / "made.toml"
    draft.write(draft.draft(reading, draft.Size(arm_m, mass_kg), "made", "a test").text, path)
    return vehicle.load(str(path))


# -- by name ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FLYING)
@pytest.mark.parametrize("read", [ardupilot.defaults, px4.defaults], ids=["ardupilot", "px4"])
def test_every_frame_makes_a_file_that_companion_and_plant_load(tmp_path: Path, name: str, read: Any) -> None:
    frame = catalogue.by_name(name)
    loaded = made(read(frame), tmp_path, 0.5, None)
    assert (loaded.spin == frame.spin).all()
    assert loaded.position_m == pytest.approx(0.5 * frame.place, abs=1e-4)
    assert loaded.hover == pytest.approx(0.4, rel=1e-3)
    flown = plant.load(tmp_path / "made.toml")
    assert flown.position_m == pytest.approx(loaded.position_m)


@pytest.mark.parametrize("arm_m", [0.04, 0.25, 1.0, 3.5, 6.0])
@pytest.mark.parametrize("name", ["quad-x", "hexa-h", "octo-x", "dodeca-plus", "y6"])
def test_a_file_is_sound_at_every_size(tmp_path: Path, name: str, arm_m: float) -> None:
    reading = ardupilot.defaults(catalogue.by_name(name))
    assert made(reading, tmp_path, arm_m, None).mass_kg == pytest.approx(30.0 * arm_m**2, rel=0.7)


def test_the_guesses_are_those_of_the_shipped_airframes_within_a_factor_of_two(tmp_path: Path) -> None:
    for name in ("octo-x", "octo-plus", "hexa-x", "coax-x8"):
        shipped = vehicle.load(name)
        arm_m = float(np.hypot(*shipped.position_m.T).max())
        folder = tmp_path / name
        folder.mkdir()
        guess = made(ardupilot.defaults(catalogue.by_name(name)), folder, arm_m, shipped.mass_kg)
        for ours, theirs in (
            (guess.motor.time_constant_up_s, shipped.motor.time_constant_up_s),
            (guess.motor.torque_per_thrust_m, shipped.motor.torque_per_thrust_m),
            (guess.motor.max_thrust_n, shipped.motor.max_thrust_n),
            *zip(guess.inertia_kg_m2, shipped.inertia_kg_m2, strict=True),
        ):
            assert 0.5 < ours / theirs < 2.0, name


def test_the_guess_of_the_mass_moves_no_acceleration(tmp_path: Path) -> None:
    reading = ardupilot.defaults(catalogue.by_name("octo-x"))
    accelerations = []
    for mass_kg in (3.0, 9.0):
        folder = tmp_path / str(mass_kg)
        folder.mkdir()
        accelerations.append(made(reading, folder, 0.5, mass_kg).acceleration_effectiveness)
    assert accelerations[0] == pytest.approx(accelerations[1], rel=1e-3)


def test_what_is_guessed_is_marked_and_named(tmp_path: Path) -> None:
    out = draft.draft(ardupilot.defaults(catalogue.by_name("octo-x")), draft.Size(0.5), "x", "y")
    assert {"airframe.mass_kg", "airframe.inertia_kg_m2", "motor.max_thrust_n", "command.spin_min"} <= set(out.guessed)
    marked = {line.split(" = ")[0] for line in out.text.splitlines() if "# guessed" in line}
    assert {key.split(".")[1] for key in out.guessed} <= marked
    known = draft.draft(ardupilot.read(octa(), None), draft.Size(0.5, 6.0), "x", "y")
    assert not {"airframe.mass_kg", "motor.max_thrust_n", "command.spin_min", "telemetry.gyro_filter_hz"} & set(
        known.guessed
    )


@pytest.mark.parametrize("name", [name for name, frame in catalogue.frames().items() if frame.without])
def test_a_frame_without_a_model_is_refused_with_the_reason(name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name} there is no model: .*yaw"):
        draft.draft(ardupilot.defaults(catalogue.by_name(name)), draft.Size(0.5), "x", "y")


@pytest.mark.parametrize("arm_m", [0.0, -0.5, 0.001, 50.0, float("nan"), float("inf")])
def test_an_arm_out_of_range_is_refused(arm_m: float) -> None:
    with pytest.raises(ConfigError, match=r"--arm .*0\.02 to 10 m"):
        draft.draft(ardupilot.defaults(catalogue.by_name("octo-x")), draft.Size(arm_m), "x", "y")


@pytest.mark.parametrize("mass_kg", [0.0, -1.0, 0.001, 5000.0, float("nan"), float("inf")])
def test_a_mass_out_of_range_is_refused(mass_kg: float) -> None:
    with pytest.raises(ConfigError, match=r"--mass .*0\.02 to 3000 kg"):
        draft.draft(ardupilot.defaults(catalogue.by_name("octo-x")), draft.Size(0.5, mass_kg), "x", "y")


def test_a_mass_that_the_arm_cannot_carry_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"mass_kg = 500.*farthest"):
        made(ardupilot.defaults(catalogue.by_name("octo-x")), tmp_path, 0.3, 500.0)
    assert not (tmp_path / "made.toml").exists()


def test_a_file_that_is_there_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "made.toml").write_text("mine")
    with pytest.raises(ConfigError, match="exists already"):
        made(ardupilot.defaults(catalogue.by_name("octo-x")), tmp_path)
    assert (tmp_path / "made.toml").read_text() == "mine"


@pytest.mark.parametrize(
    "name", ['quo"te', "back\\slash", "new\nline", "[red]", "\udcff", "ünïcode", "x" * 500, "\x7f"]
)
def test_any_name_makes_a_file_that_can_be_read(name: str) -> None:
    out = draft.draft(ardupilot.defaults(catalogue.by_name("quad-x")), draft.Size(0.2), name, f"file {name}")
    assert 1 <= len(tomllib.loads(out.text)["airframe"]["name"]) <= 200


# -- ArduPilot --------------------------------------------------------------------------------------------------------


def test_what_ardupilots_parameters_say_is_kept(tmp_path: Path) -> None:
    loaded = made(ardupilot.read(octa(), None), tmp_path)
    command = loaded.command
    assert (command.thrust_expo, command.spin_min, command.spin_max) == (0.7, 0.12, 0.9)
    assert (command.pwm_min, command.pwm_max) == (1050.0, 1950.0)
    assert (loaded.telemetry.gyro_filter_hz, loaded.telemetry.accelerometer_filter_hz) == (42.0, 15.0)
    assert loaded.hover == pytest.approx(0.33, rel=1e-3)
    assert (loaded.spin == catalogue.by_name("octo-x").spin).all()
    assert checks.contradictions(octa().values, loaded) == []


def test_pulses_of_zero_are_those_of_the_throttle_stick(tmp_path: Path) -> None:
    ends = {"MOT_PWM_MIN": 0.0, "MOT_PWM_MAX": 0.0, "RC3_MIN": 1102.0, "RC3_MAX": 1927.0}
    reading = ardupilot.read(octa(**ends), None)
    assert (reading.pwm_min.value, reading.pwm_max.value) == (1102.0, 1927.0)
    mapped = octa(**ends, RCMAP_THROTTLE=1, RC1_MIN=1010, RC1_MAX=2010)
    assert ardupilot.read(mapped, None).pwm_max.value == 2010.0
    with pytest.raises(ConfigError, match="RC3_MIN is missing"):
        ardupilot.read(octa(MOT_PWM_MIN=0.0), None)


@pytest.mark.parametrize("name", FLYING)
def test_every_frame_of_ardupilot_is_read_from_its_numbers(name: str) -> None:
    for frame_class, frame_type in catalogue.by_name(name).ardupilot:
        numbers: dict[str, float] = {"FRAME_CLASS": frame_class, "FRAME_TYPE": 1 if frame_type < 0 else frame_type}
        reading = ardupilot.read(Parameters(numbers, "x"), None)
        assert reading.frame is catalogue.by_name(name)


def test_a_frame_made_by_a_script_takes_its_name_from_the_owner() -> None:
    with pytest.raises(ConfigError, match=r"FRAME_CLASS = 17.*by name"):
        ardupilot.read(octa(FRAME_CLASS=17), None)
    reading = ardupilot.read(octa(FRAME_CLASS=17), catalogue.by_name("octo-v"))
    assert reading.frame is catalogue.by_name("octo-v")


ARDUPILOT_FAULTS: list[tuple[dict[str, float], str]] = [
    ({"FRAME_CLASS": 7}, "tricopter"),
    ({"FRAME_CLASS": 6}, "helicopter"),
    ({"FRAME_CLASS": 99}, "no frame of ArduPilot"),
    ({"FRAME_TYPE": 8}, "no frame of ArduPilot"),
    ({"FRAME_TYPE": 1.5}, "whole"),
    ({"FRAME_CLASS": float("nan")}, "finite"),
    ({"MOT_SPIN_MIN": 5.0}, "MOT_SPIN_MIN = 5.*0 to 0.5"),
    ({"MOT_SPIN_MAX": float("inf")}, "MOT_SPIN_MAX.*finite"),
    ({"MOT_THST_EXPO": -0.5}, "MOT_THST_EXPO = -0.5.*0 to 1"),
    ({"MOT_PWM_MAX": 65535.0}, "MOT_PWM_MAX.*us"),
    ({"MOT_PWM_MIN": 0.0, "RC3_MIN": 0.0}, "RC3_MIN.*us"),
    ({"MOT_THST_HOVER": 0.0}, "MOT_THST_HOVER = 0"),
    ({"MOT_THST_HOVER": 1.5}, "MOT_THST_HOVER = 1.5"),
    ({"INS_GYRO_FILTER": 1e9}, "INS_GYRO_FILTER.*Hz"),
    ({"INS_ACCEL_FILTER": -1.0}, "INS_ACCEL_FILTER.*Hz"),
    ({"SERVO3_FUNCTION": 0.0}, "motor 3 .*no output"),
    ({"SERVO3_FUNCTION": 33.0}, "SERVO3_FUNCTION is motor 1, and so is SERVO1_FUNCTION"),
    ({"SERVO9_FUNCTION": 82.0}, "motor 9, and octo-x has 8"),
]


@pytest.mark.parametrize(("changes", "words"), ARDUPILOT_FAULTS, ids=lambda part: str(part)[:40])
def test_a_fault_of_ardupilots_parameters_is_named(changes: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as refused:
        ardupilot.read(octa(**changes), None)
    assert str(refused.value).startswith("parameter file octa.param: ")


def test_a_name_that_the_parameters_contradict_is_refused() -> None:
    assert ardupilot.read(octa(), catalogue.by_name("octo-x")).frame is catalogue.by_name("octo-x")
    with pytest.raises(ConfigError, match="is octo-x, and octo-plus was given"):
        ardupilot.read(octa(), catalogue.by_name("octo-plus"))


def test_motors_on_other_outputs_are_a_note() -> None:
    assert ardupilot.read(octa(), None).notes == []
    swapped = ardupilot.read(octa(SERVO1_FUNCTION=34, SERVO2_FUNCTION=33), None).notes
    assert len(swapped) == 1
    assert "1 on 2, 2 on 1" in swapped[0]


def test_twelve_motors_have_functions_in_two_ranges() -> None:
    values: dict[str, float] = {f"SERVO{n}_FUNCTION": function_of(n) for n in range(1, 13)}
    reading = ardupilot.read(Parameters(values | {"FRAME_CLASS": 12, "FRAME_TYPE": 1}, "x"), None)
    assert reading.notes == []
    assert reading.motors == 12


# -- PX4 --------------------------------------------------------------------------------------------------------------


def test_what_px4s_parameters_say_is_kept(tmp_path: Path) -> None:
    reading = px4.read(hexa(), None)
    assert reading.frame is catalogue.by_name("hexa-x")
    loaded = made(reading, tmp_path)
    command = loaded.command
    assert (command.thrust_expo, command.spin_min, command.spin_max) == (0.3, 0.0, 1.0)
    assert (command.pwm_min, command.pwm_max) == (1100.0, 1900.0)
    assert loaded.hover == pytest.approx(0.45, rel=1e-3)
    assert np.hypot(*loaded.position_m.T).max() == pytest.approx(0.4, rel=1e-3)
    assert outputs.contradiction(hexa().values, loaded) == ""


def test_px4_sends_what_its_filters_have_not_touched(tmp_path: Path) -> None:
    """IMU_GYRO_CUTOFF filters what the controllers get, not HIGHRES_IMU."""
    telemetry = made(px4.read(hexa(IMU_GYRO_CUTOFF=30.0), None), tmp_path).telemetry
    assert (telemetry.gyro_filter_hz, telemetry.accelerometer_filter_hz) == (0.0, 0.0)


def rotors_of(key: str) -> Parameters:
    """An airframe of PX4's own files with all its CA_ROTOR* numbers."""
    text = (DATA / "frames_px4.txt").read_text(encoding="utf-8").split(f"airframe {key}\n")[1].split("airframe")[0]
    rows = [line.split() for line in text.splitlines()]
    values: dict[str, float] = {"CA_ROTOR_COUNT": len(rows)}
    for k, row in enumerate(rows):
        values |= {
            f"CA_ROTOR{k}_{what}": float(number) for what, number in zip(("PX", "PY", "PZ", "KM"), row, strict=True)
        }
    return Parameters(values, "x")


@pytest.mark.parametrize("key", ["4001", "4601", "4901", "5001", "6001", "7001", "8001", "9001", "11001", "12001"])
def test_the_rotors_of_px4s_own_airframes_are_known_again(key: str) -> None:
    assert px4.read(rotors_of(key), None).frame is catalogue.of_px4(int(key))


def test_rotors_that_are_no_frames_make_a_vehicle_of_their_own(tmp_path: Path) -> None:
    reading = px4.read(hexa(CA_ROTOR0_PX=0.1), None)
    assert reading.frame is None
    x, y = made(reading, tmp_path).position_m[0]
    assert x / y == pytest.approx(0.2, rel=1e-3)


@pytest.mark.parametrize("autostart", [6001, 8001, 12001, 24001])
def test_without_rotors_the_airframes_number_says_the_frame(autostart: int) -> None:
    reading = px4.read(Parameters({"SYS_AUTOSTART": autostart}, "x"), None)
    assert reading.frame is catalogue.of_px4(autostart)


def test_drag_that_somebody_has_set_is_read_over_the_arm(tmp_path: Path) -> None:
    drags = {f"CA_ROTOR{k}_KM": 0.02 * np.sign(hexa().values[f"CA_ROTOR{k}_KM"]) for k in range(6)}
    loaded = made(px4.read(hexa(**drags), None), tmp_path)
    assert loaded.motor.torque_per_thrust_m == pytest.approx(0.02 * 0.4 / 0.5, rel=1e-3)
    assert px4.read(hexa(), None).drag_per_arm is None


PX4_FAULTS: list[tuple[dict[str, float], str]] = [
    ({"CA_AIRFRAME": 8}, "CA_AIRFRAME = 8"),
    ({"CA_AIRFRAME": float("nan")}, "CA_AIRFRAME.*finite"),
    ({"CA_ROTOR_COUNT": 3}, "between 4 and 12"),
    ({"CA_ROTOR_COUNT": 13}, "between 4 and 12"),
    ({"CA_ROTOR_COUNT": 1e300}, "CA_ROTOR_COUNT"),
    ({"CA_ROTOR_COUNT": 6.5}, "CA_ROTOR_COUNT.*whole"),
    ({"CA_R_REV": 1}, "CA_R_REV"),
    ({"CA_ROTOR2_PX": 1e300}, "CA_ROTOR2_PX.*at most 100"),
    ({"CA_ROTOR2_PY": float("nan")}, "CA_ROTOR2_PY.*finite"),
    ({"CA_ROTOR2_KM": 0.0}, "CA_ROTOR2_KM = 0.*motor 3"),
    ({"CA_ROTOR2_AX": 0.5}, "motor 3 is not upright"),
    ({"CA_ROTOR2_AZ": 1.0}, "motor 3 is not upright"),
    ({"CA_ROTOR2_AZ": 0.0}, "motor 3 is not upright"),
    ({"CA_ROTOR2_TILT": 1}, "CA_ROTOR2_TILT"),
    ({"CA_ROTOR2_CT": 0.0}, "CA_ROTOR2_CT = 0.*journal"),
    ({"CA_ROTOR2_CT": 3.0}, "CT differ"),
    ({f"CA_ROTOR{k}_{axis}": 0.0 for k in range(6) for axis in ("PX", "PY")}, "all 0"),
    ({"PWM_MAIN_FUNC3": 0}, "motor 3 has no output"),
    ({"PWM_MAIN_FUNC3": 101}, "PWM_MAIN_FUNC3 is motor 1, and so is PWM_MAIN_FUNC1"),
    ({"PWM_MAIN_MIN3": 1000}, "PWM_MAIN_MIN3 = 1000 and PWM_MAIN_MIN1 = 1100"),
    ({f"PWM_MAIN_MAX{k}": 5000 for k in range(1, 7)}, "PWM_MAIN_MAX.*us"),
    ({"THR_MDL_FAC": 2.0}, "THR_MDL_FAC = 2.*0 to 1"),
    ({"MPC_THR_HOVER": 0.0}, "MPC_THR_HOVER = 0"),
    ({"MPC_THR_HOVER": float("inf")}, "MPC_THR_HOVER.*finite"),
]


@pytest.mark.parametrize(("changes", "words"), PX4_FAULTS, ids=lambda part: str(part)[:40])
def test_a_fault_of_px4s_parameters_is_named(changes: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as refused:
        px4.read(hexa(**changes), None)
    assert str(refused.value).startswith("parameter file hexa.params: ")


@pytest.mark.parametrize("missing", ["CA_ROTOR2_KM", "CA_ROTOR2_PX", "CA_ROTOR_COUNT"])
def test_a_file_of_changed_parameters_alone_does_not_mislead(missing: str) -> None:
    with pytest.raises(ConfigError, match=f"{missing} is missing.*save all"):
        px4.read(hexa(missing), None)


def test_an_airframe_number_that_is_not_known_wants_more() -> None:
    with pytest.raises(ConfigError, match="SYS_AUTOSTART = 14001"):
        px4.read(Parameters({"SYS_AUTOSTART": 14001}, "x"), None)
    with pytest.raises(ConfigError, match="are missing"):
        px4.read(Parameters({"THR_MDL_FAC": 0.3}, "x"), None)


def test_a_name_that_px4s_rotors_contradict_is_refused() -> None:
    assert px4.read(hexa(), catalogue.by_name("hexa-x")).frame is catalogue.by_name("hexa-x")
    with pytest.raises(ConfigError, match="those of hexa-x, and hexa-plus was given"):
        px4.read(hexa(), catalogue.by_name("hexa-plus"))


def test_outputs_that_the_companion_does_not_understand_are_notes() -> None:
    assert px4.read(hexa(), None).notes == []
    assert "DShot" in px4.read(hexa(PWM_MAIN_TIM0=-3), None).notes[0]
    assert "1 on 2, 2 on 1" in px4.read(hexa(PWM_MAIN_FUNC1=102, PWM_MAIN_FUNC2=101), None).notes[0]
    without = [f"PWM_MAIN_FUNC{k}" for k in range(1, 7)]
    other = {f"PWM_AUX_FUNC{k}": 100.0 + k for k in range(1, 7)}
    assert "PWM_AUX" in px4.read(hexa(*without, **other), None).notes[0]
