"""Parameters that PX4 was told: restored in full, and not sent for ever where it does not take them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, Link, in_flight, octo, on_ground, talk, tell, without
from px4_told import held, untold

from nff_companion.autopilots.base import Permit
from nff_companion.autopilots.px4.adapter import Px4Adapter
from nff_companion.autopilots.schedule import Declare, Release
from nff_companion.condition import Reason
from nff_companion.core import vehicle as vehicles
from nff_companion.mavlink.codec import Message


def changed_by_another(adapter: Px4Adapter, px4: FakePx4, name: str, value: float, now: float) -> None:
    px4.stored[px4.names.index(name)] = value
    (said,) = px4.through([px4.announce(name)])
    adapter.observe(said, now)


pytestmark = pytest.mark.usefixtures("nothing_ahead")


# -- restoring ---------------------------------------------------------------------------------------------------------


def test_restored_on_disarm_and_the_journal_is_gone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (1, 8)), now)
    now = talk(adapter, px4, now, 0.3)
    assert not np.array_equal(px4.stored, found)
    assert not adapter.condition(now).unfinished, "in the air nothing is to be undone"
    px4.armed = False
    for message in px4.heartbeat():
        adapter.observe(message, now)
    assert adapter.condition(now).unfinished
    now = talk(adapter, px4, now, 2.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()
    assert not adapter.condition(now).unfinished


@pytest.mark.parametrize("armed", [True, False])
def test_released_on_the_ground_everything_is_restored_and_in_the_air_nothing(armed: bool, tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    px4.armed = armed
    for message in px4.heartbeat():
        adapter.observe(message, now)
    assert adapter.encode(Release(now)) == []
    talk(adapter, px4, now, 1.0, permit=Permit.TIDY)
    assert px4.scales()[2] == (0.0 if armed else 6.5)
    assert (tmp_path / "journal").exists() == armed


def test_what_was_sent_but_not_confirmed_is_restored_too(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    px4.due(now)  # it arrives, its confirmation does not
    assert px4.value("CA_ROTOR2_CT") == 0.0
    px4.armed = False
    talk(adapter, px4, now, 2.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()


def test_a_word_of_before_does_not_confirm_what_was_not_sent_yet(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    (before,) = px4.through([px4.announce("CA_ROTOR2_CT")])
    tell(adapter, px4, without(model, (3,)), now)
    px4.armed = False
    for message in px4.heartbeat():
        adapter.observe(message, now)
    adapter.observe(before, now)  # 6.5, said before the declaration was taken
    talk(adapter, px4, now, 1.0)
    assert np.array_equal(px4.stored, found)


def test_a_parameter_that_turns_out_changed_on_the_ground_is_restored_again(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(delay_s=0.5)
    tell(adapter, px4, without(model, (3,)), now)  # on its way for half a second
    (before,) = px4.through([px4.announce("CA_ROTOR2_CT")])
    px4.armed = False
    px4.link = Link(drops=lambda m: m.get_type() == "PARAM_SET")
    now = talk(adapter, px4, now, 0.1)
    adapter.observe(before, now)  # as if it confirmed the restoring, which was lost
    px4.link = Link()
    talk(adapter, px4, now, 3.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()


def test_the_users_own_tuning_is_not_undone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = on_ground(tmp_path, px4, model)
    px4.stored[:] = np.where([n.endswith("_CT") for n in px4.names], 7.0, px4.stored)
    for name in px4.names:  # the ground station's changes are announced to all
        adapter.observe(px4.through([px4.announce(name)])[0], now)
    now = talk(adapter, px4, now, 0.5)
    for armed in (True, False):
        px4.armed = armed
        now = talk(adapter, px4, now, 0.5)
    assert px4.scales() == [7.0] * 8
    px4.armed = True
    now = talk(adapter, px4, now, 0.2)
    eta = np.ones(8)
    eta[0] = 0.5
    tell(adapter, px4, eta, now)
    talk(adapter, px4, now, 0.2)
    assert px4.value("CA_ROTOR0_CT") == pytest.approx(3.5)


def test_in_the_air_a_new_start_takes_over_what_was_told(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    count = len(px4.sets)
    again = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(again, px4, now, 5.0)
    assert held(again.condition(now)) == [3]
    assert tell(again, px4, without(model, (3,)), now) == []
    assert len(px4.sets) == count
    px4.armed = False
    talk(again, px4, now, 1.0)
    assert px4.scales() == [6.5] * 8


# -- parameters that are locked ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["locked", "refusing"])
def test_a_parameter_that_is_not_taken_is_named_and_not_sent_for_ever(how: str, tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    getattr(px4, how).add("CA_ROTOR2_CT")
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 1.0)
    reason, text = untold(adapter.condition(now))
    assert reason == Reason.NOT_TOLD
    assert "CA_ROTOR2_CT" in text
    assert held(adapter.condition(now)) == []
    px4.received.clear()
    for _ in range(20):
        now += 0.05
        tell(adapter, px4, without(model, (3,)), now)
        now = talk(adapter, px4, now, 0.1)
    assert "PARAM_SET" not in px4.kinds_received()
    px4.armed = False
    now = talk(adapter, px4, now, 1.0)
    assert adapter.condition(now).untold is None
    assert px4.scales() == [6.5] * 8


@pytest.mark.parametrize("how", ["locked", "refusing"])
def test_half_of_a_declaration_whose_other_half_is_not_taken_is_taken_back(how: str, tmp_path: Path) -> None:
    # Motors 1 and 8 told dead without giving up yaw take all outputs of a PX4 to zero.
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (1,)), now)
    now = talk(adapter, px4, now, 0.2)
    getattr(px4, how).update(f"CA_ROTOR{i}_KM" for i in range(8))
    tell(adapter, px4, without(model, (1, 8)), now)
    now = talk(adapter, px4, now, 1.0)
    assert px4.scales() == [0.0] + [6.5] * 7
    assert held(adapter.condition(now)) == [1]
    assert "CA_ROTOR0_KM" in untold(adapter.condition(now))[1]


def test_values_of_before_that_come_late_are_not_taken_for_a_lock(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(delay_s=0.3, part=4, pause_s=1.0)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.8)  # many copies are on their way when the vehicle disarms
    px4.armed = False
    now = talk(adapter, px4, now, 8.0)
    assert np.array_equal(px4.stored, found)
    assert not (tmp_path / "journal").exists()
    assert not adapter.condition(now).unfinished


def test_a_parameter_that_is_not_restored_is_said_and_its_journal_kept(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    px4.locked.add("CA_ROTOR2_CT")
    px4.armed = False
    now = talk(adapter, px4, now, 4.0)
    notes = [n.text for n in adapter.condition(now).notes if n.reason == Reason.STILL_CHANGED]
    assert len(notes) == 1
    assert "CA_ROTOR2_CT" in notes[0]
    assert (tmp_path / "journal").exists()
    px4.received.clear()
    now = talk(adapter, px4, now, 2.0)
    assert "PARAM_SET" not in px4.kinds_received()
    px4.locked.clear()
    changed_by_another(adapter, px4, "CA_ROTOR2_CT", 6.5, now)
    now = talk(adapter, px4, now, 2.0)
    assert adapter.condition(now).notes == ()
    assert not (tmp_path / "journal").exists()


def test_late_answers_to_an_earlier_declaration_do_not_take_the_next_one_back(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(delay_s=0.4)
    eta = np.ones(8)
    for left in (0.5, 0.2):
        eta[4] = left
        tell(adapter, px4, eta, now)
        now = talk(adapter, px4, now, 1.0)
    now = talk(adapter, px4, now, 1.0)
    assert px4.value("CA_ROTOR4_CT") == pytest.approx(1.3)
    assert adapter.condition(now).untold is None


# -- what others change -----------------------------------------------------------------------------------------------


def test_a_motor_that_a_ground_station_tunes_after_a_declaration_is_left_alone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    changed_by_another(adapter, px4, "CA_ROTOR7_CT", 7.0, now)
    tell(adapter, px4, without(model, (3, 5)), now)
    now = talk(adapter, px4, now, 0.2)
    assert px4.scales() == [6.5, 6.5, 0.0, 6.5, 0.0, 6.5, 6.5, 7.0]
    px4.armed = False
    now = talk(adapter, px4, now, 2.0)
    assert px4.scales() == [6.5] * 7 + [7.0]
    assert not (tmp_path / "journal").exists()
    assert not adapter.condition(now).unfinished
    px4.armed = True  # and the next flight starts from what was tuned
    now = talk(adapter, px4, now, 0.2)
    eta = np.ones(8)
    eta[7] = 0.5
    tell(adapter, px4, eta, now)
    talk(adapter, px4, now, 0.2)
    assert px4.value("CA_ROTOR7_CT") == pytest.approx(3.5)


def test_an_output_changed_after_a_declaration_is_looked_at_after_landing(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    changed_by_another(adapter, px4, "PWM_MAIN_FUNC4", 105.0, now)
    assert adapter.condition(now).command is None
    px4.armed = False
    now = talk(adapter, px4, now, 3.0)
    assert px4.scales() == [6.5] * 8
    command = adapter.condition(now).command
    assert command is not None
    assert command.reason == Reason.CONTRADICTION


def test_two_that_had_the_same_command_make_yaw_again_only_after_one_is_told_dead(tmp_path: Path) -> None:
    """PX4 takes a burst in parts, up to a second apart: with the moments back first it made yaw of a dead motor."""
    coax = vehicles.load("coax-x8")
    px4 = FakePx4(coax)
    adapter, now = in_flight(tmp_path, px4, coax)
    either = np.where(np.isin(np.arange(8), (2, 7)), 0.5, 1.0)
    first = sent(adapter.encode(Declare(now, np.zeros(8, bool), either)))
    assert set(first) == {"CA_ROTOR2_KM", "CA_ROTOR7_KM", "CA_ROTOR2_CT", "CA_ROTOR7_CT"}
    assert set(first[:2]) == {"CA_ROTOR2_KM", "CA_ROTOR7_KM"}
    now = talk(adapter, px4, now, 2.5)
    dead = np.arange(8) == 7
    adapter.condition(now)
    then = sent(adapter.encode(Declare(now, dead, np.where(dead, 0.0, 1.0))))
    assert then[0] == "CA_ROTOR7_CT"
    assert set(then[:2]) == {"CA_ROTOR7_CT", "CA_ROTOR2_CT"}
    assert set(then[2:]) == {"CA_ROTOR2_KM", "CA_ROTOR7_KM"}


def sent(messages: Sequence[Message]) -> list[str]:
    """Names of the parameters set, in order."""
    return [str(m.param_id).rstrip("\0") for m in messages if m.get_type() == "PARAM_SET"]
