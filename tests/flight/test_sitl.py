"""The emulated vehicle: physics, wind, faults, the autopilot's door, and its honesty against stock ArduCopter."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nff_companion.core import vehicle
from nff_companion.mavlink.codec import dialect
from sitl import airframe, rotation
from sitl.autopilot.companion_port import CompanionPort
from sitl.autopilot.mixer import mix, normalised_effectiveness, stock_factors
from sitl.faults import Fault, FaultSchedule
from sitl.fleet import Fleet, FleetOptions
from sitl.link_model import LinkModel, LinkOptions
from sitl.noise import vehicle_generators
from sitl.plant import Plant, initial_state
from sitl.telemetry import Telemetry
from sitl.wind import Wind

OCTO = vehicle.path_of("octo-x")
STOCK = vehicle.path_of("arducopter-octa-x")
# Pairs that stock ArduCopter survives at thrust/weight 2.56; the other 16 of 28 hit the ground.
STOCK_SURVIVES = {(1, 2), (3, 6), (4, 5), (7, 8), (1, 4), (1, 6), (2, 3), (2, 5), (3, 7), (4, 7), (5, 8), (6, 8)}


def make(path: Path = OCTO, *, vehicles: int = 1, faults: list[Fault] | None = None, **options: Any) -> Fleet:
    seeds = options.pop("seeds", list(range(1, vehicles + 1)))
    return Fleet(airframe.load(path, vehicles=vehicles), FleetOptions(seeds=seeds, **options), faults)


def run(fleet: Fleet, seconds: float) -> None:
    for _ in range(int(400 * seconds)):
        fleet.step()


def test_a_thousand_vehicles_step_in_one_call_as_one_does_alone() -> None:
    options: dict[str, Any] = {"height_m": 10.0, "wind_m_s": 4.0, "turbulence_m_s": 1.0, "model_error": 0.1}
    many = make(vehicles=1000, **options)
    alone = make(vehicles=1, seeds=[517], **options)
    for _ in range(40):
        many.step()
        alone.step()
    np.testing.assert_array_equal(many.state.position_m[516], alone.state.position_m[0])
    np.testing.assert_array_equal(many.autopilot.output[516], alone.autopilot.output[0])


def test_free_fall_and_spin_follow_newton_and_euler() -> None:
    parameters = airframe.load(OCTO)
    plant = Plant(parameters, 1 / 1200)
    state = initial_state(parameters, height_m=100.0)
    state.rate_rad_s[:] = [0.3, -0.2, 0.5]
    momentum = parameters.inertia_kg_m2[0] * state.rate_rad_s[0]
    for _ in range(600):
        plant.step(state, np.zeros((1, 8)), np.zeros((1, 3)))
    # Drag of a fall from rest is below 2 % in half a second.
    assert state.velocity_m_s[0, 2] == pytest.approx(0.5 * 9.80665, rel=0.02)
    after = rotation.to_matrix(state.quaternion)[0] @ (parameters.inertia_kg_m2[0] * state.rate_rad_s[0])
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(momentum), rel=0.01)


def test_rotor_torques_have_the_signs_of_the_frame() -> None:
    parameters = airframe.load(OCTO)
    plant = Plant(parameters, 1 / 1200)
    for motor in range(8):
        state = initial_state(parameters, height_m=100.0)
        output = np.zeros((1, 8))
        output[0, motor] = 0.6
        for _ in range(60):
            plant.step(state, output, np.zeros((1, 3)))
        x, y = parameters.position_m[motor]
        assert np.sign(state.rate_rad_s[0]).tolist() == [-np.sign(y), np.sign(x), parameters.spin[motor]]


def test_dryden_turbulence_has_the_asked_deviation() -> None:
    seeds = list(range(40))
    wind = Wind(np.tile([4.0, 0, 0], (40, 1)), np.full(40, 1.0), 1 / 100, vehicle_generators(seeds, 1))
    rows = np.array([wind.step(k / 100) for k in range(6000)])
    assert rows[..., 0].mean() == pytest.approx(4.0, abs=0.15)
    assert rows[..., 0].std() == pytest.approx(1.0, abs=0.15)
    assert rows[..., 1].std() == pytest.approx(1.0, abs=0.3)


def test_faults_come_and_go_as_scheduled() -> None:
    faults = [
        Fault(vehicle=0, motor=1, start_s=1.0),
        Fault(vehicle=0, motor=2, start_s=1.0, kind="partial", effectiveness=0.4, until_s=2.0),
        Fault(vehicle=0, motor=3, start_s=1.0, kind="ramp", duration_s=2.0),
        Fault(vehicle=0, motor=4, start_s=1.0, kind="intermittent", duration_s=0.5),
        Fault(vehicle=0, motor=5, start_s=1.0, kind="stuck"),
        Fault(vehicle=0, motor=6, start_s=1.0, kind="high"),
        Fault(vehicle=0, motor=7, start_s=1.0, kind="slow", slower=5.0),
        Fault(vehicle=0, motor=8, start_s=1.0, kind="blade", effectiveness=0.6, until_s=3.0),
    ]
    schedule = FaultSchedule(1, 8, faults)
    seen = {t: tuple(a[0].tolist() for a in schedule.at(t)) for t in (0.5, 1.1, 1.3, 2.5, 3.5)}
    assert seen[0.5][0] == [1.0] * 8
    assert seen[1.1][0][5:] == [1.0, 1.0, 0.6]
    assert seen[1.1][2][5] == 1.0
    assert [seen[t][3][6] for t in (0.5, 1.1)] == [1.0, 5.0]
    assert [seen[t][4][7] > 1.0 for t in (0.5, 1.1, 3.5)] == [False, True, False]
    assert seen[1.1][0][:5] == pytest.approx([0.0, 0.4, 0.95, 0.0, 1.0])
    assert seen[1.3][0][3] == 1.0
    assert seen[2.5][0][:3] == pytest.approx([0.0, 1.0, 0.25])
    assert seen[3.5][0][2] == 0.0
    assert seen[1.1][1] == [False] * 4 + [True, True] + [False] * 2
    with pytest.raises(ValueError, match="no such motor"):
        FaultSchedule(1, 8, [Fault(vehicle=0, motor=9, start_s=0.0)])
    with pytest.raises(ValueError, match="choose one of"):
        Fault(vehicle=0, motor=1, start_s=0.0, kind="tired")
    with pytest.raises(ValueError, match="1 or more"):
        Fault(vehicle=0, motor=1, start_s=0.0, kind="slow", slower=0.5)


@pytest.mark.parametrize(
    ("fault", "share"),
    [
        (Fault(vehicle=0, motor=1, start_s=0.0, kind="high"), 1.0),
        (Fault(vehicle=0, motor=1, start_s=0.0, kind="reversed", effectiveness=0.5), -0.5),
        (Fault(vehicle=0, motor=1, start_s=0.0, kind="blade", effectiveness=0.6), 0.6),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_a_motor_does_what_its_fault_says(fault: Fault, share: float) -> None:
    """Thrust of motor 1 after a second, over that of a healthy one at the same output (high: at full output)."""
    parameters = airframe.load(OCTO)
    plant, schedule = Plant(parameters, 1 / 1200), FaultSchedule(1, 8, [fault])
    state = initial_state(parameters, height_m=1000.0)
    for k in range(1200):
        plant.step(state, np.full((1, 8), 0.6), np.zeros((1, 3)), schedule.at(k / 1200))
    full = state.thrust_n[0, 1] if fault.kind != "high" else parameters.max_thrust_n[0, 0] * state.battery[0] ** 2
    assert state.thrust_n[0, 0] == pytest.approx(share * full, rel=0.15 if fault.kind == "high" else 1e-6)
    assert np.isfinite(state.rate_rad_s).all()


def test_a_slow_motor_takes_its_times_as_long() -> None:
    parameters = airframe.load(OCTO)
    slow = Fault(vehicle=0, motor=1, start_s=0.0, kind="slow", slower=5.0)
    late_steps = []
    for motor in (0, 1):
        plant, schedule = Plant(parameters, 1 / 1200), FaultSchedule(1, 8, [slow])
        state, steps = initial_state(parameters, height_m=1000.0), 0
        while state.thrust_n[0, motor] < 0.2 * parameters.max_thrust_n[0, motor]:
            plant.step(state, np.full((1, 8), 0.6), np.zeros((1, 3)), schedule.at(0.0))
            steps += 1
        late_steps.append(steps)
    assert late_steps[0] == pytest.approx(5.0 * late_steps[1], rel=0.15)


def test_mixer_keeps_roll_and_pitch_over_yaw_when_saturated() -> None:
    p = airframe.load(OCTO)
    factors = stock_factors(p.position_m, p.spin)
    b = normalised_effectiveness(p.position_m, p.spin)
    unit, thrust, dead = np.diag(b @ factors), np.zeros(8), np.zeros(8, bool)
    limits = mix(factors, np.array([0.4, 0.2, -0.1, 0.1]), 0.4, dead, thrust)
    np.testing.assert_allclose(b @ thrust / unit, [0.4, 0.2, -0.1, 0.1], atol=1e-9)
    assert not limits.yaw
    limits = mix(factors, np.array([0.4, 0.5, 0.0, 1.0]), 0.4, dead, thrust)
    served = b @ thrust / unit
    assert served[1] == pytest.approx(0.5, abs=1e-6)
    assert served[3] < 0.6
    assert limits.yaw


class TestCompanionPort:
    """Dead-man and refusals on the autopilot's side."""

    @staticmethod
    def matrix(port: CompanionPort, **change: Any) -> str | None:
        arguments = {"sequence": 1, "sample_s": 10.0, "timeout_s": 0.5, "now_s": 10.01, **change}
        return port.receive_matrix(arguments.pop("value", np.ones((8, 4))), **arguments)

    @staticmethod
    def outputs(port: CompanionPort, **change: Any) -> str | None:
        arguments = {"sequence": 1, "sample_s": 10.0, "timeout_s": 0.05, "now_s": 10.01, "armed": True, **change}
        return port.receive_override(arguments.pop("value", np.full(8, 0.5)), **arguments)

    def test_commands_hold_while_fresh_and_then_expire(self) -> None:
        port = CompanionPort(8)
        assert self.matrix(port) is None
        assert self.outputs(port) is None
        assert port.override_at(10.05) is not None
        assert port.override_at(10.07) is None
        assert port.matrix_at(10.4) is not None
        assert port.matrix_at(10.6) is None

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"value": np.full((8, 4), np.nan)}, "nan"),
            ({"value": np.full((8, 4), 21.0)}, "range"),
            ({"value": np.ones((6, 4))}, "dimension"),
            ({"timeout_s": 10.0}, "range"),
            ({"sample_s": 9.0}, "stale"),
            ({"sample_s": 11.0}, "stale"),
        ],
    )
    def test_bad_matrices_are_refused_and_counted(self, change: dict[str, Any], reason: str) -> None:
        port = CompanionPort(8)
        assert self.matrix(port, **change) == reason
        assert port.refused[reason] == 1
        assert port.matrix_at(10.02) is None

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"value": np.full(8, 1.01)}, "range"),
            ({"value": np.full(8, -0.01)}, "range"),
            ({"value": np.full(8, np.inf)}, "nan"),
            ({"value": np.full(7, 0.5)}, "dimension"),
            ({"timeout_s": 0.11}, "range"),
            ({"timeout_s": 0.0}, "range"),
            ({"sample_s": 9.5}, "stale"),
            ({"armed": False}, "disarmed"),
        ],
    )
    def test_bad_outputs_are_refused_and_counted(self, change: dict[str, Any], reason: str) -> None:
        port = CompanionPort(8)
        assert self.outputs(port, **change) == reason
        assert port.refused[reason] == 1
        assert port.override_at(10.02) is None

    def test_replays_are_refused_while_in_force_and_a_restarted_companion_is_not(self) -> None:
        port = CompanionPort(8)
        assert self.outputs(port, sequence=500) is None
        assert self.outputs(port, sequence=500) == "replay"
        assert self.outputs(port, sequence=499) == "replay"
        assert self.outputs(port, sequence=1, sample_s=10.2, now_s=10.21) is None

    def test_nan_leaves_a_motor_to_the_autopilot(self) -> None:
        port = CompanionPort(8)
        value = np.full(8, np.nan)
        value[2] = 0.0
        assert self.outputs(port, value=value) is None
        held = port.override_at(10.02)
        assert held is not None
        assert np.isnan(held).sum() == 7

    def test_a_late_declaration_does_not_undo_a_newer_one_and_a_restarted_companion_is_obeyed(self) -> None:
        port = CompanionPort(8)
        one, two = np.arange(8) < 1, np.arange(8) < 2

        def declare(failed: NDArray[np.bool_], sequence: int, sample_s: float, now_s: float) -> str | None:
            return port.receive_declaration(failed, sequence=sequence, sample_s=sample_s, now_s=now_s, armed=True)

        assert declare(two, 8, 10.0, 10.01) is None
        for sequence in (8, 7, 2**32 - 1):
            assert declare(one, sequence, 10.0, 10.2) == "replay"
        assert port.failed.tolist() == two.tolist()
        assert port.refused["replay"] == 3
        assert declare(one, 9, 10.0, 10.2) is None
        assert declare(two, 1, 10.7, 10.71) is None, "what was overtaken is stale by now: this one began anew"
        port.disarmed()
        assert declare(one, 1, 10.72, 10.73) is None

    def test_a_declaration_of_most_motors_is_refused(self) -> None:
        port = CompanionPort(8)
        failed = np.array([True] * 5 + [False] * 3)
        assert port.receive_declaration(failed, sequence=1, sample_s=10.0, now_s=10.0, armed=True) == "range"
        one = np.eye(8, dtype=bool)[0]
        assert port.receive_declaration(one, sequence=1, sample_s=10.0, now_s=10.0, armed=False) == "disarmed"


def test_the_dead_man_returns_the_vehicle_to_stock_mixing_in_flight() -> None:
    fleet = make(height_m=10.0)
    run(fleet, 2.0)
    port = fleet.autopilot.ports[0]
    port.receive_override(
        np.full(8, 0.62), sequence=1, sample_s=fleet.time_s, timeout_s=0.1, now_s=fleet.time_s, armed=True
    )
    fleet.autopilot.port_changed()
    run(fleet, 0.05)
    assert fleet.autopilot.allocation[0] == 3
    run(fleet, 0.1)
    assert fleet.autopilot.allocation[0] == 0
    run(fleet, 5.0)
    assert not fleet.state.crashed[0]


def test_link_model_delays_loses_doubles_and_corrupts() -> None:
    perfect = LinkModel(LinkOptions(latency_s=0.05), 1)
    perfect.send(0.0, b"a")
    assert perfect.receive(0.04) == []
    assert perfect.receive(0.05) == [b"a"]
    bad = LinkModel(LinkOptions(jitter_s=0.02, loss=0.2, duplication=0.1, corruption=0.1), 2)
    for k in range(5000):
        bad.send(0.001 * k, b"12345678")
    got = bad.receive(100.0)
    assert 0.86 * 5000 < len(got) < 0.90 * 5000
    assert 0.08 < sum(d != b"12345678" for d in got) / len(got) < 0.12


@dataclass
class Flown:
    """A fleet after its flight, with each vehicle's largest tilt (deg) and excursion (m), (N,) each."""

    fleet: Fleet
    tilt: NDArray[np.float64]
    off: NDArray[np.float64]


@pytest.fixture(scope="module")
def singles() -> Flown:
    sets = [(motor, seed) for motor in range(1, 9) for seed in (1, 2, 3)]
    faults = [Fault(vehicle=k, motor=motor, start_s=5.0) for k, (motor, _) in enumerate(sets)]
    fleet = make(STOCK, vehicles=24, seeds=[s for _, s in sets], height_m=10.0, faults=faults)
    flown = Flown(fleet, np.zeros(24), np.zeros(24))
    for _ in range(400 * 25):
        fleet.step()
        if fleet.time_s > 5.0:
            tilt = np.degrees(rotation.tilt_of(fleet.state.quaternion))
            off = np.linalg.norm(fleet.state.position_m - fleet.autopilot.position.path, axis=1)
            flown.tilt, flown.off = np.maximum(flown.tilt, tilt), np.maximum(flown.off, off)
    return flown


def test_single_failures_end_as_on_stock_arducopter(singles: Flown) -> None:
    print(f"median tilt {np.median(singles.tilt):.2f} deg, excursion {np.median(singles.off):.2f} m")
    assert not singles.fleet.state.crashed.any()
    assert np.median(singles.tilt) == pytest.approx(13.5, rel=0.3)
    assert np.median(singles.off) == pytest.approx(0.94, rel=0.3)


def test_pairs_end_as_on_stock_arducopter() -> None:
    sets = list(itertools.combinations(range(1, 9), 2))
    faults = [Fault(vehicle=k, motor=m, start_s=5.0) for k, pair in enumerate(sets) for m in pair]
    fleet = make(STOCK, vehicles=28, seeds=[1] * 28, height_m=10.0, wind_m_s=3.0, turbulence_m_s=0.3, faults=faults)
    run(fleet, 25.0)
    survived = {pair for pair, crashed in zip(sets, fleet.state.crashed, strict=True) if not crashed}
    agree = 28 - len(survived ^ STOCK_SURVIVES)
    print(f"{agree} of 28 pairs end as on stock")
    assert agree >= 26


@pytest.mark.parametrize(("name", "kind"), [("h250", 2), ("hexa-x", 13), ("octo-x", 14), ("coax-x8", 14)])
def test_the_heartbeat_says_how_many_motors_there_are(name: str, kind: int) -> None:
    telemetry = Telemetry(make(vehicle.path_of(name)))
    assert telemetry.makers[dialect.MAVLINK_MSG_ID_HEARTBEAT]().type == kind
