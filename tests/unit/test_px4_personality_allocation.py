"""The emulated PX4's allocation, against the matrices that PX4 has and against what of it was flown."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from conftest import DATA
from numpy.typing import NDArray

from nff_companion.autopilots.px4 import allocator as foreseen
from nff_companion.autopilots.px4.remedy import geometry_of
from nff_companion.core import vehicle
from sitl import airframe
from sitl.autopilot.px4.allocation import PITCH, ROLL, THRUST_Z, YAW, Allocation, Rotors, allocation, thrusts
from sitl.autopilot.px4.mixer import Px4Mixer
from sitl.autopilot.px4.parameters import ParameterTable, hover_of, stock

SHIPPED = ("octo-x", "octo-plus", "px4-octo-x", "hexa-x", "coax-x8", "paper-octo", "arducopter-octa-x")
# Both motors told dead drove all eight outputs of a flown PX4 v1.16 to zero.
COLLAPSE = {(1, 7), (1, 8), (2, 7), (2, 8), (3, 4), (3, 5), (4, 6), (5, 6)}


def rotors(rows: NDArray[np.float64]) -> Rotors:
    """Of rows PX, PY, PZ, KM, with the CT and the axis that nobody has set."""
    count = len(rows)
    return Rotors(
        position_m=rows[:, :3],
        axis=np.tile([0.0, 0.0, -1.0], (count, 1)),
        thrust=np.full(count, 6.5),
        moment=rows[:, 3],
    )


def start_script(number: int) -> Rotors:
    """Rotors of one of PX4's own airframes."""
    blocks = (DATA / "frames_px4.txt").read_text(encoding="utf-8").split("airframe ")[1:]
    lines = next(block.splitlines() for block in blocks if block.startswith(f"{number}\n"))
    return rotors(np.array([[float(v) for v in line.split()] for line in lines[1:] if line.strip()]))


def table_of(name: str, **changes: float) -> tuple[ParameterTable, Px4Mixer]:
    nominal = airframe.load(vehicle.path_of(name))
    table = ParameterTable(stock(nominal, hover_of(nominal), 1) | changes)
    return table, Px4Mixer(table, nominal)


@pytest.mark.parametrize("number", [4001, 5001, 6001, 7001, 8001, 9001])
def test_gains_of_regular_frames_are_those_that_px4_normalises_to(number: int) -> None:
    """Roll by the sine of a motor's angle, pitch by its cosine, both over the larger of the two root mean squares over
    half of the motors that have one; yaw of 1, thrust of -1 for all."""
    found, place = allocation(start_script(number)), start_script(number).position_m
    angle = np.arctan2(place[:, 1], place[:, 0])
    columns = -np.sin(angle), np.cos(angle)
    spread = max(math.sqrt((c**2).sum() / (0.5 * (np.abs(c) > 1e-3).sum())) for c in columns)
    np.testing.assert_allclose(found.mix[:, ROLL], columns[0] / spread, atol=0.01)
    np.testing.assert_allclose(found.mix[:, PITCH], columns[1] / spread, atol=0.01)
    np.testing.assert_allclose(np.abs(found.mix[:, YAW]), 1.0, atol=0.01)
    np.testing.assert_allclose(found.mix[:, THRUST_Z], -1.0, atol=0.01)


def demands(rng: np.random.Generator) -> NDArray[np.float64]:
    """(n, 6) of which many saturate."""
    drawn = np.zeros((30, 6))
    drawn[:, :3] = rng.uniform(-1.0, 1.0, (30, 3)) * rng.choice([0.1, 1.0], (30, 1))
    drawn[:, THRUST_Z] = -rng.uniform(0.0, 1.0, 30)
    return drawn


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("airmode", [0, 1, 2])
def test_two_readings_of_px4s_source_allocate_alike(name: str, airmode: int, rng: np.random.Generator) -> None:
    """The companion's, which foresees it, and the emulation's, which flies it."""
    table, mixer = table_of(name, MC_AIRMODE=airmode)
    geometry = geometry_of({name: table[name] for name in table.names}, len(mixer.stopped))
    mine, theirs = mixer.allocation, foreseen.mix_matrix(geometry)
    np.testing.assert_allclose(mine.mix, theirs, atol=1e-9)
    for demand in demands(rng):
        one = thrusts(mine, demand, airmode=airmode, desaturate=True)
        np.testing.assert_allclose(one, foreseen.allocate(theirs, demand, geometry), atol=1e-9)


def hover(found: Allocation, throttle: float) -> NDArray[np.float64]:
    demand = np.zeros(6)
    demand[THRUST_Z] = -throttle
    return thrusts(found, demand, airmode=0, desaturate=True)


def test_the_pairs_that_collapse_are_those_that_did_in_flight() -> None:
    whole = start_script(8001)
    found = set()
    for pair in itertools.combinations(range(1, 9), 2):
        left = allocation(whole.without(np.isin(np.arange(1, 9), pair)))
        if all(hover(left, throttle).sum() < 0.1 for throttle in (0.3, 0.6, 1.0)):
            found.add(pair)
    assert found == COLLAPSE


def test_a_change_in_flight_is_looked_at_once_a_second_and_changes_the_outputs() -> None:
    table, mixer = table_of("px4-octo-x")

    def output(now_s: float) -> NDArray[np.float64]:
        return mixer.mix(0.5, np.zeros(3), armed=True, now_s=now_s).output

    healthy = output(0.0)
    assert np.ptp(healthy) < 1e-3
    table.set("CA_ROTOR2_CT", 0.0)
    first = output(0.1)
    assert first[2] == 0.0 < first[0]
    table.set("CA_ROTOR2_CT", 6.5)
    assert output(0.5)[2] == 0.0
    np.testing.assert_allclose(output(1.2), healthy, atol=1e-3)
    table.set("PWM_MAIN_FUNC3", 104)
    assert np.ptp(output(3.0)) < 1e-3, "functions change on the ground alone"


def test_outputs_are_those_of_the_functions_curve_and_pulses() -> None:
    plain = table_of("px4-octo-x", THR_MDL_FAC=0.0)[1].mix(0.36, np.zeros(3), armed=True, now_s=0.0).output
    np.testing.assert_allclose(plain, 0.36, atol=2e-3)
    curved = table_of("px4-octo-x", THR_MDL_FAC=1.0)[1].mix(0.36, np.zeros(3), armed=True, now_s=0.0).output
    np.testing.assert_allclose(curved, 0.6, atol=2e-3)
    mixer = table_of("px4-octo-x", THR_MDL_FAC=0.0, PWM_MAIN_MAX2=1500, PWM_MAIN_FUNC4=0, PWM_MAIN_FUNC1=103)[1]
    turned = mixer.mix(0.36, np.array([0.0, 0.0, 0.05]), armed=True, now_s=0.0).output
    assert turned[1] == pytest.approx(0.5 * mixer.mix(0.36, np.zeros(3), armed=True, now_s=0.0).output[4], abs=0.05)
    assert turned[3] == 0.0
    assert mixer.pulses_us[3] == 900.0
    assert mixer.mix(0.36, np.zeros(3), armed=False, now_s=0.0).output.max() == 0.0
    assert set(mixer.pulses_us) == {900.0}


def test_an_injected_failure_is_reallocated_once_and_the_geometry_then_stays() -> None:
    table, mixer = table_of("px4-octo-x", CA_FAILURE_MODE=1)
    stopped = np.zeros(8, bool)
    stopped[4] = True
    mixer.inject(stopped)
    two = stopped.copy()
    two[1] = True
    mixer.inject(two)
    table.set("CA_ROTOR7_CT", 0.0)
    output = mixer.mix(0.5, np.zeros(3), armed=True, now_s=0.0).output
    assert np.flatnonzero(output == 0.0).tolist() == [1, 4]
    assert np.flatnonzero(mixer.removed).tolist() == [4]
    mixer.inject(np.zeros(8, bool))
    assert mixer.mix(0.5, np.zeros(3), armed=True, now_s=0.1).output.min() > 0.4
    alone = table_of("px4-octo-x")[1]
    alone.inject(stopped)
    assert not alone.removed.any(), "CA_FAILURE_MODE is 0"
    assert alone.mix(0.5, np.zeros(3), armed=True, now_s=0.0).output[4] == 0.0
