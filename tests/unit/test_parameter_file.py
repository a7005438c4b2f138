"""Parameter files of either autopilot, in every form that ground stations write; what is none is refused in a line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nff_companion.errors import ConfigError
from nff_companion.frames import parameter_file

FORMS = {
    "Mission Planner's": "#NOTE: 25.11.2026\nFRAME_CLASS,3\nMOT_SPIN_MIN,0.15\n",
    "Mission Planner's of Windows": "\ufeffFRAME_CLASS,3\r\nMOT_SPIN_MIN,0.15\r\n",
    "MAVProxy's": "FRAME_CLASS      3.000000\nMOT_SPIN_MIN     0.150000  # default 0.15\n\n",
    "ArduPilot's own": "FRAME_CLASS\t3\nMOT_SPIN_MIN\t1.5e-1\n",
    "QGroundControl's": "# Onboard\n#\n1\t1\tFRAME_CLASS\t3\t2\n1\t1\tMOT_SPIN_MIN\t0.150000005960464478\t9\n",
    "QGroundControl's with more": "1\t1\tFRAME_CLASS\t3\t2\n1\t100\tFRAME_CLASS\t9\t2\n1\t1\tMOT_SPIN_MIN\t.15\t9\n",
    "said twice": "FRAME_CLASS 3\nMOT_SPIN_MIN 0.15\nFRAME_CLASS 3.0\n",
    "with a NaN that nobody asks for": "FRAME_CLASS 3\nMOT_SPIN_MIN 0.15\nBARO_THING nan\nOTHER -inf\n",
}
BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "no parameters"),
    "comments alone": (b"# nothing\n\n", "no parameters"),
    "of another component alone": (b"1\t100\tCAM_MODE\t1\t2\n", "no parameters"),
    "not UTF-8": (b"FRAME_CLASS 3\n\xff\xfe", "byte 15 is not UTF-8"),
    "NUL bytes": (b"\x00" * 50, "line 1"),
    "garbage": (b"<html><body>not found</body></html>", "line 1"),
    "a line of garbage": (b"FRAME_CLASS 3\n?!?\n", "line 2"),
    "no number": (b"FRAME_CLASS three\n", "FRAME_CLASS = 'three'"),
    "a number of Python alone": (b"FRAME_CLASS 1_0\n", "FRAME_CLASS"),
    "a number without end": (b"FRAME_CLASS " + b"9" * 5000, "FRAME_CLASS"),
    "a name without end": (b"F" * 5000 + b" 1", "line 1"),
    "a name alone": (b"FRAME_CLASS\n", "line 1"),
    "two at odds": (b"FRAME_CLASS 3\nX 1\nFRAME_CLASS 4\n", "line 3.*line 1 says 3"),
    "huge": (b"A 1\n" * 1_100_000, "4000000 bytes"),
    "binary": (bytes(range(128)) * 20, "line 1"),
}


def written(folder: Path, data: bytes) -> Path:
    path = folder / "vehicle.param"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_read_to_the_same(tmp_path: Path, form: str) -> None:
    parameters = parameter_file.read(written(tmp_path, FORMS[form].encode()))
    assert parameters.whole("FRAME_CLASS") == 3
    assert parameters.get("MOT_SPIN_MIN") == pytest.approx(0.15)
    assert parameters.get("MOT_SPIN_MAX") is None
    assert parameter_file.autopilot(parameters) == "ardupilot"


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_parameter_file_is_refused_with_file_and_place(tmp_path: Path, name: str) -> None:
    data, words = BAD[name]
    path = written(tmp_path, data)
    with pytest.raises(ConfigError, match=words) as refused:
        parameter_file.read(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize("name", ["nowhere.param", "", "a\0b"])
def test_a_file_that_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        parameter_file.read(tmp_path / name)


def test_a_pipe_that_nobody_writes_to_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigError, match="no file"):
        parameter_file.read(tmp_path / "pipe")


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN", "1e999"])
def test_a_value_that_is_asked_for_is_a_finite_number(tmp_path: Path, value: str) -> None:
    parameters = parameter_file.read(written(tmp_path, f"MOT_SPIN_MIN {value}\n".encode()))
    with pytest.raises(ConfigError, match=r"MOT_SPIN_MIN.*finite"):
        parameters.get("MOT_SPIN_MIN")


@pytest.mark.parametrize("value", ["1.5", "1e30"])
def test_a_number_of_an_enumeration_is_whole(tmp_path: Path, value: str) -> None:
    parameters = parameter_file.read(written(tmp_path, f"FRAME_CLASS {value}\n".encode()))
    with pytest.raises(ConfigError, match=r"FRAME_CLASS.*whole"):
        parameters.whole("FRAME_CLASS")


@pytest.mark.parametrize(
    ("text", "whose"),
    [("FRAME_CLASS 3", "ardupilot"), ("MOT_PWM_MIN 1000", "ardupilot"), ("CA_AIRFRAME 0", "px4"), ("SYS_ID 1", "px4")],
)
def test_names_tell_whose_parameters_they_are(tmp_path: Path, text: str, whose: str) -> None:
    assert parameter_file.autopilot(parameter_file.read(written(tmp_path, text.encode()))) == whose


@pytest.mark.parametrize("text", ["FRAME_CLASS 3\nCA_AIRFRAME 0", "SOMETHING 1"])
def test_parameters_of_nobody_or_of_both_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ConfigError, match="ArduPilot's"):
        parameter_file.autopilot(parameter_file.read(written(tmp_path, text.encode())))


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=200) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace")))
def test_any_bytes_are_read_or_refused(tmp_path: Path, data: bytes) -> None:
    try:
        parameters = parameter_file.read(written(tmp_path, data))
    except ConfigError as error:
        assert "vehicle.param" in str(error)
        return
    assert parameters.values
