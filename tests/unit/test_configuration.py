"""What is absurd is refused where it is loaded, with file, key, value and what is allowed: airframes, configurations,
networks. Anything at all either loads or is refused: no file makes a traceback."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from nff_companion.core import basis_network, vehicle
from nff_companion.daemon import configuration
from nff_companion.errors import NffError

AIRFRAME = vehicle.path_of("octo-x").read_text(encoding="utf-8")
UNLIKE = (  # each rotor with all the keys that may be left out
    AIRFRAME.replace("[airframe]\n", "[airframe]\ncentre_of_mass_m = [0.01, 0.02, 0.0]\n")
    .replace("[telemetry]\n", "[telemetry]\noutput_delay_s = 0.01\n")
    .replace(
        "[[rotor]]\n",
        "[[rotor]]\nz_m = -0.1\naxis = [0.05, 0.1, -1.0]\nthrust = 1.1\n"
        "time_constant_up_s = 0.03\ntime_constant_down_s = 0.06\n",
    )
)
NETWORK = basis_network.path_of("octo-x").read_bytes()
CONFIGURATION = """[link]
endpoint = "udpin:127.0.0.1:14561"
more_endpoints = []
autopilot = "auto"
system = 0
px4_method = "scale"
rate_hz = 200.0
stream_timeout_s = 0.25
component = 191

[vehicle]
airframe = "octo-x"
network = "airframe"
thrust_to_weight = 2.5

[companion]
mode = "observe"
allocation = "trim"
status_socket = ""
state_folder = ""

[tuning.decision]
explained_min = 0.7

[tuning.disturbance]
floor = [0.20, 0.35, 0.35, 0.10]
"""


def written(path: Path, data: str | bytes) -> Path:
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def having(text: str, **values: str) -> str:
    """``text`` with the first line of each key given another value."""
    for key, value in values.items():
        line = f"{key} = {value}".replace("\\", r"\\")
        text, count = re.subn(rf"(?m)^{key} = .*$", line, text, count=1)
        assert count == 1, key
    return text


# -- airframes --------------------------------------------------------------------------------------------------------

AIRFRAME_VALUES = [
    ("mass_kg", "5000"),
    ("mass_kg", "0.01"),
    ("mass_kg", "2999"),
    ("mass_kg", "nan"),
    ("mass_kg", "-6.0"),
    ("mass_kg", '"6 kg"'),
    ("mass_kg", "true"),
    ("mass_kg", "1" + "0" * 400),
    ("mass_kg", "0x" + "f" * 8000),
    ("mass_kg", "1979-05-27T07:32:00Z"),
    ("inertia_kg_m2", "[1e-300, 1e-300, 1e-300]"),
    ("inertia_kg_m2", "[0.17, 0.17]"),
    ("inertia_kg_m2", "[0.17, nan, 0.32]"),
    ("inertia_kg_m2", "[0.17, 0.17, 1e6]"),
    ("inertia_kg_m2", "0.17"),
    ("inertia_kg_m2", "[0.17, 0.17, 0.5]"),
    ("inertia_kg_m2", "[0.001, 0.001, 0.002]"),
    ("inertia_kg_m2", "[30.0, 30.0, 50.0]"),
    ("name", '""'),
    ("name", '"a\\u0000b"'),
    ("name", '"line\\nbreak"'),
    ("name", f'"{"x" * 300}"'),
    ("network", '"a\\u0007b"'),
    ("max_thrust_n", "inf"),
    ("max_thrust_n", "0"),
    ("max_thrust_n", "7.5"),
    ("max_thrust_n", "1000"),
    ("max_thrust_n", "30000"),
    ("max_thrust_n", "true"),
    ("time_constant_up_s", "-0.1"),
    ("time_constant_up_s", "1.5"),
    ("time_constant_up_s", "3"),
    ("time_constant_down_s", "nan"),
    ("time_constant_down_s", "3.0"),
    ("time_constant_down_s", '"45 ms"'),
    ("torque_per_thrust_m", "0"),
    ("torque_per_thrust_m", "-0.018"),
    ("torque_per_thrust_m", "1.5"),
    ("torque_per_thrust_m", "0.4"),
    ("torque_per_thrust_m", "0.0002"),
    ("torque_per_thrust_m", "[0.018]"),
    ("rotor_inertia_kg_m2", "inf"),
    ("rotor_inertia_kg_m2", "-1e-5"),
    ("rotor_inertia_kg_m2", "20"),
    ("rotor_inertia_kg_m2", '"none"'),
    ("max_speed_rad_s", "0"),
    ("max_speed_rad_s", "15000"),
    ("max_speed_rad_s", "false"),
    ("thrust_expo", "1.5"),
    ("thrust_expo", "-0.2"),
    ("thrust_expo", "[0.65]"),
    ("spin_min", "0.95"),
    ("spin_min", "nan"),
    ("spin_min", "-0.1"),
    ("spin_min", "0.6"),
    ("spin_min", '"low"'),
    ("spin_max", "0.1"),
    ("spin_max", "0.4"),
    ("spin_max", "95"),
    ("spin_max", "{}"),
    ("pwm_min", "2000"),
    ("pwm_min", "1800"),
    ("pwm_min", "0"),
    ("pwm_min", "-inf"),
    ("pwm_min", "true"),
    ("pwm_max", "1050"),
    ("pwm_max", "1200"),
    ("pwm_max", "65535"),
    ("pwm_max", '"2000 us"'),
    ("gyro_filter_hz", "0.5"),
    ("gyro_filter_hz", '"off"'),
    ("gyro_filter_hz", "1e9"),
    ("gyro_filter_hz", "nan"),
    ("accelerometer_filter_hz", "-20"),
    ("accelerometer_filter_hz", "5000"),
    ("accelerometer_filter_hz", "[]"),
    ("drag_area_forward_m2", "[nan, 0, 0]"),
    ("angle_deg", "nan"),
    ("angle_deg", "1e300"),
    ("arm_m", "0.001"),
    ("arm_m", "50"),
    ("arm_m", "inf"),
    ("arm_m", '"0.5 m"'),
    ("angle_deg", "true"),
    ("spin", '"clockwise"'),
    ("source", "[]"),
]


@pytest.mark.parametrize(("key", "value"), AIRFRAME_VALUES, ids=lambda text: text[:24])
def test_an_airframe_with_an_absurd_value_is_refused_by_file_key_and_value(
    tmp_path: Path, key: str, value: str
) -> None:
    path = written(tmp_path / "absurd.toml", having(AIRFRAME, **{key: value}))
    with pytest.raises(NffError) as refused:
        vehicle.load(str(path))
    message = str(refused.value)
    assert str(path) in message
    assert key in message
    assert len(message) < 500


def vehicle_of(arm_m: float, mass_kg: float, inertia: float, thrust_n: float, drag_m: float, lag_s: float) -> str:
    """octo-x in the size of another vehicle; ``inertia`` about roll and pitch, twice that about yaw."""
    text = having(
        AIRFRAME,
        mass_kg=str(mass_kg),
        inertia_kg_m2=f"[{inertia}, {inertia}, {2 * inertia}]",
        max_thrust_n=str(thrust_n),
        torque_per_thrust_m=str(drag_m),
        time_constant_up_s=str(lag_s),
    )
    return text.replace("arm_m = 0.5", f"arm_m = {arm_m}")


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(vehicle_of(0.046, 0.027, 1.6e-5, 0.08, 0.006, 0.03), id="an indoor quadrotor of 27 g"),
        pytest.param(vehicle_of(0.11, 0.7, 0.003, 6.0, 0.013, 0.02), id="a racer with 5 inch propellers"),
        pytest.param(vehicle_of(1.1, 66.0, 15.0, 160.0, 0.06, 0.15), id="a sprayer with 38 inch propellers"),
        pytest.param(vehicle_of(1.6, 360.0, 130.0, 800.0, 0.1, 0.2), id="one that carries a person"),
        pytest.param(vehicle_of(3.5, 2200.0, 5000.0, 5000.0, 0.2, 0.3), id="one that carries four"),
    ],
)
def test_the_smallest_and_the_largest_that_fly_are_admitted(tmp_path: Path, text: str) -> None:
    assert vehicle.load(str(written(tmp_path / "extreme.toml", text))).motors == 8


def _all_at_one_place(text: str) -> str:
    return re.sub(r"(?m)^angle_deg = .*$", "angle_deg = 0", text)


def _behind_the_nose(text: str) -> str:
    """Eight rotors that could span all axes, but all ahead of the centre of mass."""
    angles = iter((60, 50, 40, 30, -30, -40, -50, -60))
    return re.sub(r"(?m)^angle_deg = .*$", lambda _: f"angle_deg = {next(angles)}", text)


def _in_a_row(text: str) -> str:
    angles = iter(range(8))
    return re.sub(
        r"(?m)^angle_deg = .*\narm_m = .*$",
        lambda _: f"x_m = {0.3 * (next(angles) - 3.5):.2f}\ny_m = 0.0",
        text,
    )


AIRFRAME_SHAPES: dict[str, tuple[Callable[[str], str | bytes], str]] = {
    "all clockwise": (lambda t: t.replace('"ccw"', '"cw"'), "spin"),
    "all counter-clockwise": (lambda t: t.replace('"cw"', '"ccw"'), "spin"),
    "all at one place": (_all_at_one_place, "rotor"),
    "all in a row": (_in_a_row, "rotor"),
    "all before the centre of mass": (_behind_the_nose, "rotor"),
    "two alike at one place": (lambda t: t.replace("angle_deg = -157.5", "angle_deg = 22.5"), r"rotor\[2\]"),
    "three rotors": (lambda t: "\n[[rotor]]".join(t.split("\n[[rotor]]")[:4]), "3"),
    "no rotors": (lambda t: t.split("\n[[rotor]]")[0], "rotor"),
    "thirteen rotors": (lambda t: t + 5 * '[[rotor]]\nangle_deg = 3\narm_m = 0.2\nspin = "cw"\n', "13"),
    "heavier than its arms can be": (
        lambda t: having(t, mass_kg="2000", max_thrust_n="5000", inertia_kg_m2="[60, 60, 110]"),
        "mass_kg.*farthest",
    ),
    "lighter than its arms can be": (
        lambda t: having(t, mass_kg="0.1", max_thrust_n="0.3", inertia_kg_m2="[0.003, 0.003, 0.005]"),
        "mass_kg.*farthest",
    ),
    "no arm": (lambda t: t.replace("arm_m = 0.5\n", "", 1), "arm_m"),
    "a key nobody knows": (lambda t: t.replace("mass_kg", "weight_kg"), "weight_kg|mass_kg"),
    "a table missing": (lambda t: t.replace("[telemetry]", "[other]"), "other|telemetry"),
    "a log without a place for the motor": (
        lambda t: t + '\n[log]\ntopic = "t"\nfield = "thrust"\n',
        r"log\.field",
    ),
    "a log with a name in braces": (
        lambda t: t + '\n[log]\ntopic = "t"\nfield = "thrust[{}]{motor}"\n',
        r"log\.field",
    ),
    "not UTF-8": (lambda t: t.encode() + b"# \xff\xfe\n", "UTF-8"),
    "a NUL byte": (lambda t: t.encode() + b"\x00", "cannot be read"),
    "nested without end": (lambda t: t + "x = " + 20000 * "[", "cannot be read"),
    "a directory of digits": (lambda t: having(t, mass_kg="9" * 5000), "cannot be read"),
    "empty": (lambda t: "", "airframe"),
}


@pytest.mark.parametrize("name", AIRFRAME_SHAPES)
def test_an_airframe_that_cannot_fly_or_be_read_is_refused(tmp_path: Path, name: str) -> None:
    spoil, word = AIRFRAME_SHAPES[name]
    path = written(tmp_path / "absurd.toml", spoil(AIRFRAME))
    with pytest.raises(NffError, match=word) as refused:
        vehicle.load(str(path))
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("ratio", [float("nan"), float("inf"), -1.0, 0.0, 0.9, 1.0, 50.0, 1e300])
def test_a_thrust_to_weight_that_no_vehicle_flies_with_is_refused(ratio: float) -> None:
    with pytest.raises(NffError, match="thrust_to_weight"):
        vehicle.load("octo-x", thrust_to_weight=ratio)


@pytest.mark.parametrize("name", ["\0.toml", "/.toml", "nowhere.toml", "", "octo-y"])
def test_an_airframe_that_is_not_there_is_refused(name: str) -> None:
    with pytest.raises(NffError):
        vehicle.load(name)


@pytest.mark.parametrize("name", vehicle.names())
def test_shipped_airframes_load(name: str) -> None:
    assert np.isfinite(vehicle.load(name).effectiveness).all()


# -- configurations ---------------------------------------------------------------------------------------------------

CONFIGURATION_VALUES = [
    ("rate_hz", "nan"),
    ("rate_hz", "0"),
    ("rate_hz", "1e6"),
    ("rate_hz", '"fast"'),
    ("stream_timeout_s", "-1"),
    ("stream_timeout_s", "nan"),
    ("system", "256"),
    ("system", "1.5"),
    ("component", "1"),
    ("endpoint", '""'),
    ("endpoint", "14561"),
    ("endpoint", '"udpin:127.0.0.1:99999999"'),
    ("endpoint", '"udpin:a\\u0000b:14561"'),
    ("endpoint", f'"/dev/ttyAMA0:{"9" * 5000}"'),
    ("endpoint", '"/dev/ttyAMA0:0"'),
    ("more_endpoints", '["carrier pigeon"]'),
    ("more_endpoints", '"udpin:127.0.0.1:14562"'),
    ("autopilot", '"betaflight"'),
    ("px4_method", '"magic"'),
    ("thrust_to_weight", "nan"),
    ("thrust_to_weight", "0.9"),
    ("thrust_to_weight", "1e300"),
    ("airframe", "[]"),
    ("network", "1"),
    ("network", '"a\\u0000b"'),
    ("mode", '"fly"'),
    ("mode", "2"),
    ("allocation", '"best"'),
    ("status_socket", '"a\\u0000b"'),
    ("status_socket", f'"/{"x" * 200}"'),
    ("state_folder", '"a\\u0000b"'),
    ("explained_min", "70"),
    ("explained_min", "nan"),
    ("floor", "[0.20, 0.35, 0.35]"),
    ("floor", "[0.20, 0.35, 0.35, nan]"),
    ("floor", "[0.20, 0.35, 0.35, -1]"),
]


@pytest.mark.parametrize(("key", "value"), CONFIGURATION_VALUES, ids=lambda text: text[:24])
def test_a_configuration_with_an_absurd_value_is_refused_by_file_key_and_value(
    tmp_path: Path, key: str, value: str
) -> None:
    path = written(tmp_path / "absurd.toml", having(CONFIGURATION, **{key: value}))
    with pytest.raises(NffError) as refused:
        configuration.load(path)
    message = str(refused.value)
    assert str(path) in message
    assert key in message
    assert len(message) < 500


CONFIGURATION_SHAPES: dict[str, tuple[Callable[[str], str | bytes], str]] = {
    "not UTF-8": (lambda t: t.encode() + b"# \xff\xfe\n", "UTF-8"),
    "a NUL byte": (lambda t: t.encode() + b"\x00", "cannot be read"),
    "no link": (lambda t: t.replace("[link]", "[links]"), "link"),
    "no endpoint": (lambda t: t.replace("endpoint =", "endpoints =", 1), r"link\.endpoint"),
    "a key nobody knows": (
        lambda t: t.replace("explained_min", "explained"),
        r"tuning\.decision\.explained .*explained_min",
    ),
    "a subject nobody knows": (lambda t: t + "\n[tuning.magic]\nx = 1\n", r"tuning\.magic"),
    "a research switch": (lambda t: t + "\n[tuning.estimator]\nidentify = false\n", r"tuning\.estimator\.identify"),
    "the old table of the network": (lambda t: t + '\n[estimator]\nnetwork = "none"\n', r"\[vehicle\] network"),
    "the old table of gamma": (lambda t: t + "\n[estimator]\ngamma = 20.0\n", r"tuning\.sparse\.gamma"),
    "the old table of gamma_onset": (lambda t: t + "\n[estimator]\ngamma_onset = 1.0\n", r"tuning\.onset\.gamma_onset"),
    "the old research switches": (lambda t: t + "\n[estimator]\njoint = 1.0\n", r"estimator\.joint.*trials"),
    "the old decision": (
        lambda t: t + "\n[estimator.decision]\nconfirm_s = 0.01\n",
        r"tuning\.decision\.confirm_s",
    ),
    "the old adaptation": (lambda t: t + "\n[estimator.adaptation]\nfollow_s = 2\n", r"tuning\.adaptation\.follow_s"),
    "the old table empty": (lambda t: t + "\n[estimator]\n", r"\[tuning"),
    "the old table no table": (lambda t: "estimator = 3\n" + t, r"\[tuning"),
    "thresholds that cross": (
        lambda t: t + "\n[tuning.planner]\nshape_full_at = 0.3\nshape_none_below = 0.5\n",
        "shape_",
    ),
}


@pytest.mark.parametrize("name", CONFIGURATION_SHAPES)
def test_a_configuration_that_is_wrong_as_a_whole_is_refused(tmp_path: Path, name: str) -> None:
    spoil, word = CONFIGURATION_SHAPES[name]
    path = written(tmp_path / "absurd.toml", spoil(CONFIGURATION))
    with pytest.raises(NffError, match=word) as refused:
        configuration.load(path)
    assert str(path) in str(refused.value)


def test_a_message_names_file_dotted_key_value_and_range(tmp_path: Path) -> None:
    path = written(tmp_path / "companion.toml", having(CONFIGURATION, explained_min="70"))
    with pytest.raises(NffError) as refused:
        configuration.load(path)
    expected = (
        f"configuration {path}: tuning.decision.explained_min = 70 is not allowed: give a number from 0.5 to 0.99"
    )
    assert str(refused.value) == expected


def test_without_a_companion_table_or_a_mode_the_companion_observes(tmp_path: Path) -> None:
    without = re.sub(r"(?s)\[companion\].*?(?=\[tuning)", "", CONFIGURATION)
    assert "[companion]" not in without
    for text in (without, CONFIGURATION.replace('mode = "observe"\n', "")):
        assert configuration.load(written(tmp_path / "c.toml", text)).companion.mode == "observe"


def test_the_configuration_reaches_the_pipeline(tmp_path: Path) -> None:
    text = """[link]
endpoint = "udpin:127.0.0.1:14561"
[vehicle]
airframe = "octo-x"
network = "none"
[tuning.decision]
explained_min = 0.8
[tuning.sparse]
gamma = 25.0
[tuning.onset]
gamma_onset = 2.0
[tuning.adaptation]
follow_s = 3.0
[tuning.planner]
catch_s = 3.0
[tuning.flight_phase]
height_m = 1.0
[tuning.companion]
gap_max_s = 0.2
"""
    config = configuration.load(written(tmp_path / "c.toml", text))
    tuning = config.tuning
    assert tuning.decision.explained_min == 0.8
    assert tuning.sparse.gamma == 25.0
    assert tuning.onset.gamma_onset == 2.0
    assert tuning.adaptation.follow_s == 3.0
    assert config.vehicle.network == "none"
    assert tuning.planner.catch_s == 3.0
    assert tuning.flight_phase.height_m == 1.0
    assert tuning.companion.gap_max_s == 0.2


# -- networks ---------------------------------------------------------------------------------------------------------


def arrays_of(data: bytes) -> dict[str, NDArray[np.float64]]:
    with np.load(io.BytesIO(data)) as file:
        return {name: file[name] for name in file.files}


def packed(arrays: dict[str, NDArray[np.float64]]) -> bytes:
    out = io.BytesIO()
    np.savez(out, allow_pickle=True, **arrays)
    return out.getvalue()


def changed(name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> bytes:
    arrays = arrays_of(NETWORK)
    arrays[name] = change(arrays[name])
    return packed(arrays)


def without(name: str) -> bytes:
    arrays = arrays_of(NETWORK)
    del arrays[name]
    return packed(arrays)


def with_metadata(old: str, new: str) -> bytes:
    return changed("metadata", lambda a: np.array(re.sub(old, lambda _: new, str(a), count=1)))


def _huge() -> bytes:
    """A header that promises more than any memory holds."""
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }"
    header += b" " * (118 - len(header) - 1) + b"\n"
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, value in arrays_of(NETWORK).items():
            one = io.BytesIO()
            np.lib.format.write_array(one, value)
            body = one.getvalue()
            if name == "weight_0":
                body = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
            file.writestr(f"{name}.npy", body)
    return out.getvalue()


def _npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


def _pickle() -> bytes:
    import pickle

    return pickle.dumps({"weight_0": [1.0]})


def _encrypted() -> bytes:
    """The bit that says that a password is needed, set in every entry."""
    data = bytearray(NETWORK)
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        for found in re.finditer(re.escape(mark), NETWORK):
            data[found.start() + at] |= 1
    return bytes(data)


NETWORKS: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "network"),
    "text": (lambda: b"weights\n", "network"),
    "a pickle": (_pickle, "network"),
    "a lone array": (_npy, "network"),
    "a zip of nothing": (lambda: packed({}), "network"),
    "encrypted": (_encrypted, "network"),
    "half of it": (lambda: NETWORK[: len(NETWORK) // 2], "network"),
    "its last byte missing": (lambda: NETWORK[:-1], "network"),
    "a promise of terabytes": (_huge, "weight_0"),
    "objects": (lambda: changed("weight_0", lambda a: a.astype(object)), "weight_0"),
    "complex numbers": (lambda: changed("weight_1", lambda a: a.astype(complex)), "weight_1"),
    "whole numbers": (lambda: changed("bias_0", lambda a: a.astype(np.int64)), "bias_0"),
    "words": (lambda: changed("mean", lambda a: a.astype(str)), "mean"),
    "truths": (lambda: changed("scale", lambda a: a > 0), "scale"),
    "dates": (lambda: changed("low", lambda a: a.astype("datetime64[s]")), "low"),
    "a bias that is one number": (lambda: changed("bias_0", lambda a: a[0]), "bias_0"),
    "a bias in columns": (lambda: changed("bias_0", lambda a: a[:, None]), "bias_0"),
    "a layer too narrow": (lambda: changed("weight_1", lambda a: a[:, :-1]), "weight_1"),
    "a prior for other axes": (lambda: changed("prior", lambda a: a[:, :-1]), "prior"),
    "no axes": (lambda: changed("axis_scale", lambda a: a[0]), "axis_scale"),
    "not finite": (lambda: changed("weight_2", lambda a: a * np.float32(np.nan)), "weight_2"),
    "beyond all bounds": (lambda: changed("weight_2", lambda a: a.astype(float) * 1e300), "weight_2"),
    "a scale of zero": (lambda: changed("scale", lambda a: a * 0), "scale"),
    "a negative scale": (lambda: changed("axis_scale", lambda a: -a), "axis_scale"),
    "a scale of 1e-30": (lambda: changed("scale", lambda a: a * np.float32(1e-30)), "scale"),
    "a range turned round": (lambda: changed("low", lambda a: a + 1000), "low"),
    "a layer missing": (lambda: without("weight_1"), "weight_1"),
    "a bias missing": (lambda: without("bias_3"), "bias_3"),
    "no metadata": (lambda: without("metadata"), "metadata"),
    "an array too many": (lambda: packed({**arrays_of(NETWORK), "more": np.zeros(3, np.float32)}), "more"),
    "metadata that are numbers": (lambda: changed("metadata", lambda _: np.zeros(3)), "metadata"),
    "metadata that are no JSON": (lambda: changed("metadata", lambda _: np.array("{")), "metadata"),
    "metadata nested without end": (lambda: changed("metadata", lambda _: np.array("[" * 100000)), "metadata"),
    "metadata that are a list": (lambda: changed("metadata", lambda _: np.array("[]")), "metadata"),
    "another format": (lambda: with_metadata('"format": 1', '"format": 2'), "format"),
    "other inputs": (lambda: with_metadata('"velocity_x"', '"velocity"'), "inputs"),
    "axes that are a number": (lambda: with_metadata(r'"covers": \[[^]]*\]', '"covers": 4'), "covers"),
    "axes nobody has": (lambda: with_metadata(r'"covers": \[[^]]*\]', '"covers": ["up"]'), "covers"),
    "a name that is a number": (lambda: with_metadata('"airframe": "octo-x"', '"airframe": 3'), "airframe"),
    "a sum that is a number": (lambda: with_metadata('"data_sha256": "[^"]*"', '"data_sha256": 3'), "data_sha256"),
    "minutes that are none": (lambda: with_metadata('"minutes": 44.8', '"minutes": NaN'), "minutes"),
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.filterwarnings("error")
def test_a_network_that_is_none_is_refused_by_file_and_array(tmp_path: Path, name: str) -> None:
    spoil, word = NETWORKS[name]
    path = written(tmp_path / "absurd.npz", spoil())
    with pytest.raises(NffError, match=word) as refused:
        basis_network.load(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value)) < 500


def test_a_network_is_a_file_of_its_own(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere.npz", Path("\0.npz")):
        with pytest.raises(NffError, match="network"):
            basis_network.load(path)


# -- anything at all --------------------------------------------------------------------------------------------------

VALUES = ("nan", "inf", "-inf", "-1", "0", "1e300", "1e-300", '"x"', "[]", "{}", "true", "0x" + "f" * 300, "'\\'")
ANYTHING = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def mutations(draw: st.DrawFn, text: str) -> bytes:
    """``text`` with up to three lines changed, left out or doubled, or some of its bytes replaced."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(("value", "value", "value", "drop", "double")))
        if how == "value" and " = " in lines[at]:
            lines[at] = f"{lines[at].split(' = ')[0]} = {draw(st.sampled_from(VALUES))}"
        elif how == "drop":
            lines[at] = ""
        elif how == "double":
            lines.insert(at, lines[at])
    data = "\n".join(lines).encode()
    return draw(spliced(data)) if draw(st.integers(0, 3)) == 0 else data


@st.composite
def spliced(draw: st.DrawFn, data: bytes) -> bytes:
    """``data`` with some bytes replaced by others, or cut off."""
    at = draw(st.integers(0, len(data)))
    if draw(st.booleans()):
        return data[:at]
    return data[:at] + draw(st.binary(min_size=1, max_size=8)) + data[at + draw(st.integers(0, 8)) :]


@ANYTHING
@given(data=mutations(AIRFRAME) | mutations(UNLIKE))
def test_any_airframe_file_loads_or_is_refused(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path / "any.toml", data)
    try:
        loaded = vehicle.load(str(path))
    except NffError as error:
        assert str(path) in str(error)
        return
    assert np.isfinite(loaded.acceleration_effectiveness).all()
    assert np.linalg.matrix_rank(loaded.effectiveness) == 4
    assert 0.05 < loaded.hover < 0.95


@ANYTHING
@given(data=mutations(CONFIGURATION))
def test_any_configuration_loads_or_is_refused(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path / "any.toml", data)
    try:
        config = configuration.load(path)
    except NffError as error:
        assert str(path) in str(error)
        return
    assert 25.0 <= config.link.rate_hz <= 1000.0


@ANYTHING
@given(data=spliced(NETWORK))
def test_any_network_file_loads_or_is_refused(tmp_path: Path, data: bytes) -> None:
    path = written(tmp_path / "any.npz", data)
    try:
        basis = basis_network.load(path)
    except NffError as error:
        assert str(path) in str(error)
        return
    assert np.isfinite(basis(np.zeros(11))).all()
