"""The catalogue of frames says what both firmwares say: motor order, places and spins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import DATA
from numpy.typing import NDArray

from nff_companion.autopilots.ardupilot import factors
from nff_companion.core import vehicle
from nff_companion.errors import ConfigError
from nff_companion.frames import catalogue

Table = dict[str, NDArray[np.float64]]


def golden(path: Path, word: str) -> Table:
    """Rows of numbers under each heading that begins with ``word``."""
    out: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        if line.startswith(word):
            rows = out[line.removeprefix(word).strip()] = []
        else:
            rows.append([float(number) for number in line.split()])
    return {key: np.array(rows) for key, rows in out.items()}


ARDUPILOT = golden(DATA / "frames_ardupilot.txt", "frame")
PX4 = golden(DATA / "frames_px4.txt", "airframe")
TILTED = {"quad-v-tail", "quad-a-tail"}  # ArduPilot takes no roll from the motors behind, which are tilted


def share(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the largest magnitude, as ArduPilot scales each torque by itself."""
    largest = np.abs(values).max()
    return values / largest if largest else values


@pytest.mark.parametrize("key", ARDUPILOT)
def test_a_frame_of_ardupilot_has_its_motors_in_its_order_at_its_places_with_its_spins(key: str) -> None:
    frame_class, *types = map(int, key.split())
    roll, pitch, yaw, order = ARDUPILOT[key].T
    for frame_type in types:
        frame = catalogue.of_ardupilot(frame_class, 99 if frame_type == catalogue.ANY_TYPE else frame_type)
        assert frame is not None
        assert frame.motors == len(order)
        assert (frame.spin == np.sign(yaw)).all()
        forward, right = frame.place.T
        assert share(forward) == pytest.approx(share(pitch), abs=2e-3)
        rolls = np.ones(frame.motors, bool) if frame.name not in TILTED else frame.spin == 0.0
        assert share(-right[rolls]) == pytest.approx(share(roll[rolls]), abs=2e-3)


@pytest.mark.parametrize("key", PX4)
def test_a_frame_of_px4_has_its_motors_in_its_order_at_its_places_with_its_spins(key: str) -> None:
    frame = catalogue.of_px4(int(key))
    assert frame is not None
    place, drag = PX4[key][:, :2], PX4[key][:, 3]
    assert (frame.spin == np.sign(drag)).all()
    off = np.hypot(*(frame.place - catalogue.scaled(place)).T)
    slip = [5, 11] if key == "24001" else []  # -0.344 where all others of the ring have 0.433
    assert np.delete(off, slip) == pytest.approx(0.0, abs=0.015)  # written there with two digits
    if slip:
        assert off[slip] == pytest.approx(0.178, abs=0.01), "PX4 has changed: is the note in the catalogue still true?"


def test_no_frame_of_the_catalogue_is_unknown_to_both_firmwares() -> None:
    pairs = {(int(key.split()[0]), int(kind)) for key in ARDUPILOT for kind in key.split()[1:]}
    for frame in catalogue.frames().values():
        assert frame.ardupilot or frame.px4
        assert set(frame.ardupilot) <= pairs
        assert {str(autostart) for autostart in frame.px4} <= set(PX4)


def test_names_and_numbers_stand_for_one_frame_each() -> None:
    known = catalogue.frames().values()
    assert [f.name for f in known] == list(catalogue.frames())
    for numbers in ([p for f in known for p in f.ardupilot], [p for f in known for p in f.px4]):
        assert len(numbers) == len(set(numbers))


@pytest.mark.parametrize("name", catalogue.frames())
def test_a_frame_is_balanced_with_the_farthest_motor_at_one(name: str) -> None:
    frame = catalogue.by_name(name)
    assert np.hypot(*frame.place.T).max() == pytest.approx(1.0)
    assert frame.place[:, 1].sum() == pytest.approx(0.0, abs=1e-9)
    assert frame.spin.sum() == 0.0
    assert bool(frame.without) == bool((frame.spin == 0.0).any())


@pytest.mark.parametrize(("shipped", "name"), [(n, n) for n in ("octo-x", "octo-plus", "hexa-x", "coax-x8")])
def test_a_shipped_airframe_is_the_frame_of_its_name(shipped: str, name: str) -> None:
    loaded, frame = vehicle.load(shipped), catalogue.by_name(name)
    assert (loaded.spin == frame.spin).all()
    assert catalogue.scaled(loaded.position_m) == pytest.approx(frame.place, abs=1e-9)
    found = catalogue.alike(loaded.position_m, loaded.spin)
    assert found is not None
    assert found.name == name


def test_a_place_that_is_no_frames_is_said_to_be_none() -> None:
    assert (
        catalogue.alike(np.array([[1.0, 0.1], [-1.0, 0.4], [0.0, 1.0], [0.0, -1.0]]), np.array([1, 1, -1, -1])) is None
    )


@pytest.mark.parametrize(("frame_class", "frame_type"), [(0, 0), (6, 0), (7, 0), (15, 1), (17, 1), (3, 99), (-1, -1)])
def test_numbers_that_are_no_frames_are_said_to_be_none(frame_class: int, frame_type: int) -> None:
    assert catalogue.of_ardupilot(frame_class, frame_type) is None


@pytest.mark.parametrize("autostart", [0, -1, 14001, 16001, 99999])
def test_px4_airframes_that_are_no_frames_are_said_to_be_none(autostart: int) -> None:
    assert catalogue.of_px4(autostart) is None


@pytest.mark.parametrize("name", ["octa-x", "", "quad", "[red]quad-x[/red]", "x" * 500])
def test_an_unknown_name_is_refused_with_those_like_it(name: str) -> None:
    with pytest.raises(ConfigError, match="nff airframe list") as refused:
        catalogue.by_name(name)
    assert len(str(refused.value)) < 300


def test_coaxial_motors_share_a_site() -> None:
    assert [[m + 1 for m in site] for site in catalogue.by_name("coax-x8").sites()] == [[1, 6], [2, 5], [3, 8], [4, 7]]
    assert all(len(site) == 1 for site in catalogue.by_name("octo-x").sites())


def test_the_stock_mixer_of_a_shipped_airframe_is_that_of_ardupilots_frame() -> None:
    for name, key in (("octo-x", "3 1"), ("octo-plus", "3 0"), ("hexa-x", "2 1"), ("coax-x8", "4 1")):
        roll, pitch, yaw, _ = ARDUPILOT[key].T
        stock = factors.stock(vehicle.load(name))
        assert stock[:, 1:] == pytest.approx(0.5 * np.column_stack([share(roll), share(pitch), yaw]), abs=1e-6)
