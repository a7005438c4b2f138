"""PX4: its allocator foreseen, what is told and what never, and the journal that outlives every crash."""

from __future__ import annotations

import itertools
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, talk

from nff_companion.autopilots.px4 import allocator, remedy_book
from nff_companion.autopilots.px4.adapter import Px4Adapter
from nff_companion.autopilots.px4.journal import Entry, Journal
from nff_companion.autopilots.px4.remedy import Advisor, NoRemedy, Remedy, geometry_of
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import JournalError
from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.services.parameter_reader import name_of
from nff_companion.pipeline import Mode, Output
from sitl.trials.fly import px4 as px4_flights

# Both motors told dead drove all eight outputs of a flown PX4 v1.16 to zero.
COLLAPSE = {(1, 7), (1, 8), (2, 7), (2, 8), (3, 4), (3, 5), (4, 6), (5, 6)}


def octo(ratio: float = 2.56) -> Vehicle:
    return vehicle.load("px4-octo-x", thrust_to_weight=ratio)


def geometry(model: Vehicle) -> allocator.Geometry:
    px4 = FakePx4(model)
    return geometry_of({name: px4.value(name) for name in px4.names}, model.motors)


def without(model: Vehicle, motors: tuple[int, ...]) -> np.ndarray:
    eta = np.ones(model.motors)
    eta[[motor - 1 for motor in motors]] = 0.0
    return eta


def output(model: Vehicle, failed: tuple[int, ...], time_s: float = 10.0, mode: Mode = Mode.ALLOCATE, **changes):
    m = model.motors
    values = {
        "time_s": time_s,
        "mode": mode,
        "reason": "",
        "flying": True,
        "failed": without(model, failed) == 0.0,
        "effectiveness": without(model, failed),
        "deviation": np.zeros(m),
        "degraded": np.zeros(m, bool),
        "events": [],
        "plan": None,
        "override": None,
        "estimate": None,
        "unallocated": np.zeros(4),
        "rejected": 0,
        "bad_samples": 0,
    }
    return Output(**{**values, **changes})


def ready(folder: Path, model: Vehicle, px4: FakePx4, *, armed: bool = True) -> tuple[Px4Adapter, float]:
    adapter = Px4Adapter(model, (1, 1), folder / "journal")
    px4.armed = False
    now = talk(adapter, px4, 0.0, 4.0)
    px4.armed = armed
    return adapter, talk(adapter, px4, now, 0.1)


# -- foreseeing its allocator -----------------------------------------------------------------------------------------


def test_the_pairs_that_collapse_are_those_that_did_in_flight() -> None:
    model = octo()
    advisor = Advisor(model, geometry(model))
    found = set()
    for pair in itertools.combinations(range(1, 9), 2):
        eta = without(model, pair)
        if advisor.predict(eta, eta, yaw_released=False).thrust_ratio < 0.1:
            found.add(pair)
    assert found == COLLAPSE


@pytest.mark.parametrize("ratio", [1.55, 2.56])
def test_no_remedy_ever_triggers_a_collapse(ratio: float) -> None:
    model = octo(ratio)
    advisor = Advisor(model, geometry(model))
    for pair in itertools.combinations(range(1, 9), 2):
        remedy = advisor.remedy(without(model, pair))
        if isinstance(remedy, NoRemedy):
            continue
        told = advisor.predict(remedy.effectiveness, without(model, pair), yaw_released=remedy.yaw_released)
        assert told.thrust_ratio >= 1.0
        assert pair not in COLLAPSE or remedy.yaw_released


def test_a_hexarotor_is_told_together_with_its_yaw() -> None:
    model = vehicle.load("hexa-x", thrust_to_weight=2.56)
    advisor = Advisor(model, geometry(model))
    for motor in range(1, 7):
        remedy = advisor.remedy(without(model, (motor,)))
        assert isinstance(remedy, Remedy)
        assert remedy.yaw_released


def test_a_healthy_hover_is_even_and_balanced() -> None:
    model = octo()
    g = geometry(model)
    hover = allocator.allocate(allocator.mix_matrix(g), np.array([0, 0, 0, 0, 0, -0.4]), g)
    assert hover == pytest.approx(np.full(8, 0.4), abs=1e-6)
    for axis in range(3):
        demand = np.array([0, 0, 0, 0, 0, -0.5])
        demand[axis] = 0.1
        wrench = model.effectiveness @ allocator.allocate(allocator.mix_matrix(g), demand, g)
        assert wrench[1 + axis] > 0.01
        assert np.delete(wrench[1:], axis) == pytest.approx(np.zeros(2), abs=1e-6)


# -- what is told -----------------------------------------------------------------------------------------------------


def test_a_failed_motor_is_told_after_the_journal_is_on_disk(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    assert adapter.blocked(now, Mode.ALLOCATE) == ""
    sets = adapter.act(output(model, (3,)))
    assert (tmp_path / "journal").exists()
    assert [name_of(m) for m in sets] == ["CA_ROTOR2_CT"]
    talk(adapter, px4, now, 0.5)
    assert px4.scales() == [6.5, 6.5, 0.0, 6.5, 6.5, 6.5, 6.5, 6.5]
    assert list(np.flatnonzero(adapter.applied.failed)) == [2]
    assert adapter.act(output(model, (3,), 11.0)) == []


@pytest.mark.parametrize("pair", sorted(COLLAPSE))
def test_a_collapse_pair_is_never_sent(pair: tuple[int, int], tmp_path: Path) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    for time_s, failed in ((10.0, pair[:1]), (10.5, pair)):
        for message in adapter.act(output(model, failed, time_s)):
            px4.answer(message)
        now = talk(adapter, px4, now, 0.5)
    dead = {i + 1 for i, scale in enumerate(px4.scales()) if scale == 0.0}
    assert dead != set(pair)
    assert dead == set(pair[:1])  # what could be told stays told
    assert "not told to PX4" in adapter.complaints()[0]


def test_a_pair_that_needs_it_releases_yaw_first(tmp_path: Path) -> None:
    model = octo(2.56)
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    for message in adapter.act(output(model, (1, 8))):
        px4.answer(message)
    names = [name for name, _ in px4.sets]
    remedy = Advisor(model, geometry(model)).remedy(without(model, (1, 8)))
    assert isinstance(remedy, Remedy)
    first = [] if remedy.first is None else [f"CA_ROTOR{remedy.first}_CT"]
    rest = [n for n in ("CA_ROTOR0_CT", "CA_ROTOR7_CT") if n not in first]
    assert names == [*first, *(f"CA_ROTOR{i}_KM" for i in range(8)), *rest]
    talk(adapter, px4, now, 0.2)
    assert "yaw given up" in adapter.complaints()


def test_a_partial_loss_is_scaled_and_small_changes_are_not_sent(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    eta = np.ones(8)
    eta[4] = 0.5
    degraded = eta < 1.0
    for message in adapter.act(output(model, (), 10.0, effectiveness=eta, degraded=degraded)):
        for reply in px4.answer(message):
            adapter.observe(reply)
    assert px4.value("CA_ROTOR4_CT") == pytest.approx(3.25)
    count = len(px4.sets)
    talk(adapter, px4, now, 0.2)
    eta = eta.copy()
    eta[4] = 0.45
    assert adapter.act(output(model, (), 15.0, effectiveness=eta, degraded=degraded)) == []
    assert len(px4.sets) == count


def test_restored_on_disarm_and_the_journal_is_gone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = ready(tmp_path, model, px4)
    for message in adapter.act(output(model, (1, 8))):
        px4.answer(message)
    now = talk(adapter, px4, now, 0.3)
    assert not np.array_equal(px4.stored, found)
    px4.armed = False
    talk(adapter, px4, now, 1.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()
    assert not adapter.unfinished


def test_what_was_sent_but_not_confirmed_is_restored_too(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = ready(tmp_path, model, px4)
    for message in adapter.act(output(model, (3,))):
        px4.answer(message)  # it arrives, its confirmation does not
    assert px4.value("CA_ROTOR2_CT") == 0.0
    px4.armed = False
    talk(adapter, px4, now, 1.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()


def test_the_users_own_tuning_is_not_undone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4, armed=False)
    px4.stored[:] = np.where([n.endswith("_CT") for n in px4.names], 7.0, px4.stored)
    for name in px4.names:  # the ground station's changes are announced to all
        adapter.observe(px4._through([px4._param(name)])[0])
    now = talk(adapter, px4, now, 0.5)
    px4.armed = True
    now = talk(adapter, px4, now, 0.2)
    px4.armed = False
    now = talk(adapter, px4, now, 0.5)
    assert px4.scales() == [7.0] * 8
    px4.armed = True
    now = talk(adapter, px4, now, 0.2)
    eta = np.ones(8)
    eta[0] = 0.5
    for message in adapter.act(output(model, (), 20.0, effectiveness=eta, degraded=eta < 1.0)):
        px4.answer(message)
    assert px4.value("CA_ROTOR0_CT") == pytest.approx(3.5)


def test_a_refused_remedy_is_not_sought_again_at_every_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, _ = ready(tmp_path, model, px4)
    sought = []
    real = Advisor.remedy
    monkeypatch.setattr(Advisor, "remedy", lambda self, eta: sought.append(1) or real(self, eta))
    for k in range(200):
        eta = without(model, (1, 7))
        eta[4] = 0.5 + 0.05 * rng.uniform(-1, 1)
        degraded = (eta < 1.0) & (eta > 0.0)
        adapter.act(output(model, (1, 7), 10.0 + 0.004 * k, effectiveness=eta, degraded=degraded))
    assert len(sought) <= 2


def test_the_operators_word_is_passed_on_while_observing(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    for message in adapter.act(output(model, (3,))):
        px4.answer(message)
    now = talk(adapter, px4, now, 0.2)
    for message in adapter.declare(np.zeros(8, bool), 12.0):
        px4.answer(message)
    assert px4.scales() == [6.5] * 8


def test_in_the_air_a_new_start_takes_over_what_was_told(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    for message in adapter.act(output(model, (3,))):
        px4.answer(message)
    count = len(px4.sets)
    again = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(again, px4, now, 5.0)
    assert list(np.flatnonzero(again.applied.failed)) == [2]
    assert again.act(output(model, (3,), 20.0)) == []
    assert len(px4.sets) == count
    px4.armed = False
    talk(again, px4, now, 1.0)
    assert px4.scales() == [6.5] * 8


def test_nothing_is_told_when_observing_disarmed_or_on_the_ground(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    assert adapter.act(output(model, (3,), mode=Mode.OBSERVE)) == []
    assert adapter.act(output(model, (3,), flying=False)) == []
    px4.armed = False
    talk(adapter, px4, now, 0.1)
    assert adapter.act(output(model, (3,))) == []
    assert px4.sets == []


@pytest.mark.parametrize(
    ("version", "changes", "reason"),
    [
        (0x01080000, {}, "PX4 1.8.0"),
        (0x01200000, {}, "PX4 1.32.0"),
        (0x011000FF, {"CA_ROTOR_COUNT": 6}, "CA_ROTOR_COUNT is 6"),
        (0x011000FF, {"CA_ROTOR3_PX": 0.4}, "motor order"),
        (0x011000FF, {"CA_ROTOR3_KM": -0.05}, "turns the other way"),
        (0x011000FF, {"PWM_MAIN_FUNC4": 105}, "PWM_MAIN_FUNC4"),
        (0x011000FF, {"THR_MDL_FAC": 0.0}, "THR_MDL_FAC is 0"),
        (0x011000FF, {"PWM_MAIN_MIN3": 1100}, "PWM_MAIN_MIN3"),
        (0x011000FF, {"PWM_MAIN_TIM0": -4}, "DShot"),
        (0x011000FF, {"CA_ROTOR2_CT": 0.0}, "was a journal lost"),
        (0x011000FF, {"CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}, "use inject"),
    ],
)
def test_what_is_not_understood_is_observed_with_a_reason(
    version: int, changes: dict[str, float], reason: str, tmp_path: Path
) -> None:
    model = octo()
    px4 = FakePx4(model, version, **changes)
    adapter, now = ready(tmp_path, model, px4)
    assert reason in adapter.blocked(now, Mode.ALLOCATE)
    if "PX4" not in reason:
        assert adapter.act(output(model, (3,))) == []


def test_asked_to_override_it_allocates_and_says_why(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = ready(tmp_path, model, px4)
    assert adapter.blocked(now, Mode.OVERRIDE) == ""
    assert "allocating instead" in adapter.hands_off()
    assert adapter.drive(np.full(8, 0.5), now) == []


def test_rotors_that_are_no_numbers_are_observed(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model, CA_ROTOR3_PX=float("nan"))
    adapter, now = ready(tmp_path, model, px4)
    assert "CA_ROTOR3_PX" in adapter.blocked(now, Mode.ALLOCATE)
    assert adapter.act(output(model, (3,))) == []


def test_a_journal_that_cannot_be_written_stops_the_change(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    (tmp_path / "file").write_text("in the way")
    adapter = Px4Adapter(model, (1, 1), tmp_path / "file" / "journal")
    now = talk(adapter, px4, 0.0, 4.0)
    px4.armed = True
    talk(adapter, px4, now, 0.1)
    adapter.act(output(model, (3,)))
    talk(adapter, px4, now, 0.5)
    assert px4.sets == []


# -- injection --------------------------------------------------------------------------------------------------------

NEEDS = {"SYS_FAILURE_EN": 1.0, "CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}


def injecting(folder: Path, px4: FakePx4) -> tuple[Px4Adapter, float]:
    adapter = Px4Adapter(octo(), (1, 1), folder / "journal", "inject")
    now = talk(adapter, px4, 0.0, 4.0)
    px4.armed = True
    return adapter, talk(adapter, px4, now, 0.1)


@pytest.mark.parametrize(("version", "kind"), [(0x011000FF, "OFF"), (0x011100FF, "STUCK")])
def test_injection_means_what_the_version_says_and_changes_no_parameter(
    version: int, kind: str, tmp_path: Path
) -> None:
    px4 = FakePx4(octo(), version, **NEEDS)
    adapter, now = injecting(tmp_path, px4)
    assert adapter.blocked(now, Mode.ALLOCATE) == ""
    (command,) = adapter.act(output(octo(), (3,)))
    assert command.command == dialect.MAV_CMD_INJECT_FAILURE
    assert (command.param1, command.param3) == (dialect.FAILURE_UNIT_SYSTEM_MOTOR, 3.0)
    assert command.param2 == getattr(dialect, f"FAILURE_TYPE_{kind}")
    again = [m for m in adapter.tick(now + 0.2) if m.get_type() == "COMMAND_LONG"]
    assert [m.param3 for m in again] == [3.0], "unanswered: sent again"
    acknowledged = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_INJECT_FAILURE, 0)
    adapter.observe(acknowledged)
    assert list(np.flatnonzero(adapter.applied.failed)) == [2]
    assert adapter.tick(now + 0.4) == []
    assert adapter.act(output(octo(), (3, 6), 11.0)) == []
    assert "one injected failure" in adapter.complaints()[0]
    (lifted,) = adapter.act(output(octo(), (), 12.0))
    assert lifted.param2 == dialect.FAILURE_TYPE_OK
    assert px4.sets == []
    assert not (tmp_path / "journal").exists()


def test_an_injected_failure_is_undone_when_the_vehicle_disarms(tmp_path: Path) -> None:
    px4 = FakePx4(octo(), **NEEDS)
    adapter, now = injecting(tmp_path, px4)
    adapter.act(output(octo(), (3,)))
    adapter.observe(dialect.MAVLink_command_ack_message(dialect.MAV_CMD_INJECT_FAILURE, 0))
    px4.armed = False
    for message in px4.heartbeat():
        adapter.observe(message)
    undone = [m for m in adapter.tick(now + 1.0) if m.get_type() == "COMMAND_LONG"]
    assert [(m.param2, m.param3) for m in undone] == [(dialect.FAILURE_TYPE_OK, 3.0)]
    assert adapter.unfinished
    adapter.observe(dialect.MAVLink_command_ack_message(dialect.MAV_CMD_INJECT_FAILURE, 0))
    assert not adapter.unfinished


@pytest.mark.parametrize(
    ("version", "changes", "reason"),
    [(0x010F00FF, NEEDS, "does not reallocate"), (0x011000FF, {**NEEDS, "CA_FAILURE_MODE": 0.0}, "CA_FAILURE_MODE")],
)
def test_injection_that_would_do_nothing_is_refused_with_a_reason(
    version: int, changes: dict[str, float], reason: str, tmp_path: Path
) -> None:
    px4 = FakePx4(octo(), version, **changes)
    adapter, now = injecting(tmp_path, px4)
    assert reason in adapter.blocked(now, Mode.ALLOCATE)
    assert adapter.act(output(octo(), (3,))) == []


# -- journal ----------------------------------------------------------------------------------------------------------


def test_a_journal_of_another_autopilot_or_a_spoilt_one_is_refused(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    assert journal.read("a") == []
    journal.write("a", [Entry("CA_ROTOR0_CT", 6.5, 9)])
    assert journal.read("a") == [Entry("CA_ROTOR0_CT", 6.5, 9)]
    with pytest.raises(JournalError, match="is of autopilot a"):
        journal.read("b")
    journal.path.write_bytes(journal.path.read_bytes()[:20])
    with pytest.raises(JournalError, match="cannot be understood"):
        journal.read("a")


def _fly_until_killed(folder: Path, model: Vehicle, px4: FakePx4, kill_at: int) -> None:
    """A child's life: two declarations, landing, restoring; SIGKILL at its n-th step on disk or wire."""
    steps = 0

    def step() -> None:
        nonlocal steps
        steps += 1
        if steps == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    def hooked(function):
        def call(*arguments, **options):
            step()
            result = function(*arguments, **options)
            step()
            return result

        return call

    os.fsync = hooked(os.fsync)
    for name in ("replace", "unlink", "open"):
        setattr(Path, name, hooked(getattr(Path, name)))
    adapter, now = ready(folder, model, px4)
    for time_s, failed in ((10.0, (3,)), (11.0, (1, 3)), (12.0, (1, 8))):
        for message in adapter.act(output(model, failed, time_s)):
            step()
            px4.answer(message, step)
        now = talk(adapter, px4, now, 0.3, step)
    px4.armed = False
    talk(adapter, px4, now, 1.0, step)


def test_killed_at_any_step_the_next_start_restores_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What is computed ahead takes time and changes nothing here.
    monkeypatch.setattr(remedy_book, "sets_ahead", lambda motors: [])
    model = octo()
    completed = False
    kill_at = 0
    while not completed:
        kill_at += 1
        folder = tmp_path / str(kill_at)
        folder.mkdir()
        px4 = FakePx4(model)
        found = px4.stored.copy()
        child = os.fork()
        if child == 0:
            try:
                _fly_until_killed(folder, model, px4, kill_at)
            finally:
                os._exit(0)
        _, status = os.waitpid(child, 0)
        completed = os.WIFEXITED(status)
        # The next start, on the ground.
        adapter = Px4Adapter(model, (1, 1), folder / "journal")
        talk(adapter, px4, 0.0, 5.0)
        assert np.array_equal(px4.stored, found), f"killed at step {kill_at}"
        assert not (folder / "journal").exists()
        assert adapter.complaints() == []
    print(f"killed at each of {kill_at - 1} steps")
    assert kill_at > 30


# -- real firmware ----------------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_a_real_px4_keeps_its_height_and_gets_its_parameters_back() -> None:
    if not os.environ.get(px4_flights.ENVIRONMENT):
        print(f"{px4_flights.ENVIRONMENT} is not set: no real PX4 was flown")
        return
    options = px4_flights.FlyOptions(binary=px4_flights.binary_from(None), kill_and_land=True)
    flown = px4_flights.run(options, baseline=False)["companion"]
    print(flown)
    assert not flown["crashed"]
    assert flown["height_lost_m"] < 1.0
    assert flown["changed_parameters"] > 0
    assert flown["not_restored"] == []
