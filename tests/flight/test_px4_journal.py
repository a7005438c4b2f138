"""The journal of changed parameters: on disk before anything can change, and trusted by nobody's leave."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_px4 import FakePx4, in_flight, octo, on_ground, talk, tell, without

from nff_companion.autopilots.base import Finding, Permit
from nff_companion.autopilots.px4.adapter import Px4Adapter
from nff_companion.autopilots.px4.journal import Entry, Journal
from nff_companion.condition import Reason
from nff_companion.core.vehicle import Vehicle
from nff_companion.errors import JournalError

CT0 = [Entry("CA_ROTOR0_CT", 6.5, 9)]


def finding(adapter: Px4Adapter, name: str) -> Finding:
    (found,) = [f for f in adapter.findings() if f.name == name]
    return found


def no_space(*arguments: object, **options: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


pytestmark = pytest.mark.usefixtures("nothing_ahead")


# -- the file ---------------------------------------------------------------------------------------------------------


def test_a_journal_of_another_autopilot_or_a_spoilt_one_is_refused(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    assert journal.read("a") == []
    journal.write("a", CT0)
    assert journal.read("a") == CT0
    with pytest.raises(JournalError, match="is of autopilot a"):
        journal.read("b")
    journal.path.write_bytes(journal.path.read_bytes()[:20])
    with pytest.raises(JournalError, match="cannot be understood"):
        journal.read("a")


def test_only_its_owner_can_read_it_whatever_the_mask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        Journal(tmp_path / "journal").write("a", CT0)
    finally:
        os.umask(before)
    assert (tmp_path / "journal").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("name", ["journal", "journal.new"])
def test_a_symlink_in_its_place_is_refused_by_name_and_its_target_kept(name: str, tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_text("keep me")
    (tmp_path / name).symlink_to(target)
    with pytest.raises(JournalError, match=f"{name} is a symbolic link"):
        Journal(tmp_path / "journal").write("a", CT0)
    assert target.read_text() == "keep me"
    assert (tmp_path / name).is_symlink()


def test_a_dangling_symlink_writes_nothing_where_it_points(tmp_path: Path) -> None:
    (tmp_path / "journal.new").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(JournalError, match=r"journal\.new is a symbolic link"):
        Journal(tmp_path / "journal").write("a", CT0)
    assert not (tmp_path / "elsewhere").exists()


def test_a_symlink_is_not_read_through(tmp_path: Path) -> None:
    Journal(tmp_path / "other").write("a", CT0)
    (tmp_path / "journal").symlink_to(tmp_path / "other")
    with pytest.raises(JournalError, match="journal is a symbolic link"):
        Journal(tmp_path / "journal").read("a")


def test_a_link_that_takes_the_files_place_after_a_look_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal, precious = Journal(tmp_path / "journal"), tmp_path / "precious"
    Journal(precious).write("a", CT0)
    kept = precious.read_bytes()
    links = [tmp_path / name for name in ("journal", "journal.new", "journal.probe")]
    for link in links:
        link.symlink_to(precious)
    seen = os.stat

    def a_moment_ago(path: Any, **options: Any) -> os.stat_result:
        if path in links[1:]:
            raise FileNotFoundError(path)
        return seen(precious if path == links[0] else path, **options)

    monkeypatch.setattr(os, "stat", a_moment_ago)
    with pytest.raises(JournalError, match="cannot be read"):
        journal.read("a")
    with pytest.raises(JournalError, match="cannot be written"):
        journal.write("a", [])
    with pytest.raises(JournalError, match="cannot be written"):
        journal.probe()
    assert precious.read_bytes() == kept


@pytest.mark.parametrize("name", ["journal", "journal.new"])
@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo], ids=["folder", "fifo"])
def test_what_is_no_regular_file_is_refused_by_name(make: Callable[[Path], None], name: str, tmp_path: Path) -> None:
    make(tmp_path / name)
    journal = Journal(tmp_path / "journal")
    with pytest.raises(JournalError, match=f"{name} is not a regular file"):
        journal.write("a", CT0)
    with pytest.raises(JournalError, match=f"{name} is not a regular file"):
        journal.probe()
    if name == "journal":
        with pytest.raises(JournalError, match="journal is not a regular file"):
            journal.read("a")


def test_what_a_crash_left_half_written_is_removed(tmp_path: Path) -> None:
    (tmp_path / "journal.new").write_bytes(b"half")
    journal = Journal(tmp_path / "journal")
    journal.write("a", CT0)
    assert journal.read("a") == CT0
    assert [p.name for p in tmp_path.iterdir()] == ["journal"]


def test_a_temporary_file_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "journal.new").write_bytes(b"not ours")
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    with pytest.raises(JournalError, match=r"journal\.new belongs to user"):
        Journal(tmp_path / "journal").write("a", CT0)
    assert (tmp_path / "journal.new").read_bytes() == b"not ours"


def test_a_full_disk_keeps_the_journal_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = Journal(tmp_path / "journal")
    journal.write("a", CT0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", no_space)
        with pytest.raises(JournalError, match="No space left"):
            journal.write("a", [Entry("CA_ROTOR0_CT", 0.0, 9)])
        with pytest.raises(JournalError, match="No space left"):
            journal.probe()
    assert journal.read("a") == CT0
    assert [p.name for p in tmp_path.iterdir()] == ["journal"]


def test_a_probe_leaves_nothing_behind(tmp_path: Path) -> None:
    Journal(tmp_path / "state" / "journal").probe()
    assert list((tmp_path / "state").iterdir()) == []
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(JournalError, match="cannot be written"):
        Journal(tmp_path / "file" / "journal").probe()


# -- when it is written -----------------------------------------------------------------------------------------------


def test_it_is_on_disk_when_the_vehicle_arms(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter, now = on_ground(tmp_path, px4, octo())
    assert not (tmp_path / "journal").exists()
    px4.armed = True
    for message in px4.heartbeat():
        adapter.observe(message, now)
    assert (tmp_path / "journal").exists()


def test_no_disk_is_touched_between_a_declaration_and_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    touched: list[str] = []
    for name in ("open", "fsync", "replace", "unlink"):
        monkeypatch.setattr(os, name, lambda *_, name=name, **__: touched.append(name))
    assert tell(adapter, px4, without(model, (3,)), now)
    assert touched == []


def test_a_permit_that_comes_in_flight_writes_it_then(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 4.0, permit=Permit.TIDY)
    px4.armed = True
    now = talk(adapter, px4, now, 1.0, permit=Permit.TIDY)
    assert not (tmp_path / "journal").exists()
    assert tell(adapter, px4, without(model, (3,)), now) == []
    untold = adapter.condition(now).untold
    assert untold is not None
    assert untold.reason == Reason.NOT_TOLD
    assert px4.sets == []
    adapter.due(now, Permit.ACT)
    assert (tmp_path / "journal").exists()
    assert tell(adapter, px4, without(model, (3,)), now + 0.05), "told when the schedule repeats it"
    now = talk(adapter, px4, now + 0.05, 0.2)
    assert adapter.condition(now).untold is None
    assert px4.scales()[2] == 0.0


def test_a_companion_started_in_the_air_writes_it_as_soon_as_it_knows_the_vehicle(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    px4.armed = True
    adapter = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 5.0)
    assert (tmp_path / "journal").exists()
    assert tell(adapter, px4, without(model, (3,)), now)


def test_a_flight_in_which_nothing_was_changed_clears_it_without_a_word(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter, now = in_flight(tmp_path, px4, octo())
    assert (tmp_path / "journal").exists()
    px4.armed = False
    now = talk(adapter, px4, now, 0.5)
    assert not (tmp_path / "journal").exists()
    assert "PARAM_SET" not in px4.kinds_received()
    assert not adapter.condition(now).unfinished


def test_a_companion_that_observes_writes_none(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter = Px4Adapter(octo(), (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 4.0, permit=Permit.TIDY)
    px4.armed = True
    talk(adapter, px4, now, 1.0, permit=Permit.TIDY)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("permit", list(Permit))
def test_one_that_cannot_be_written_is_said_before_the_flight(permit: Permit, tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    (tmp_path / "file").write_text("in the way")
    adapter = Px4Adapter(model, (1, 1), tmp_path / "file" / "journal")
    now = talk(adapter, px4, 0.0, 4.0, permit=permit)
    command = adapter.condition(now).command
    assert command is not None
    assert command.reason == Reason.JOURNAL
    assert "cannot be written" in command.text
    assert finding(adapter, "state folder").ok is False
    px4.armed = True
    now = talk(adapter, px4, now, 0.1, permit=permit)
    assert tell(adapter, px4, without(model, (3,)), now) == []
    talk(adapter, px4, now, 0.5, permit=permit)
    assert px4.sets == []


@pytest.mark.parametrize("permit", list(Permit))
def test_before_arming_it_is_only_tried(permit: Permit, tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter = Px4Adapter(octo(), (1, 1), tmp_path / "state" / "journal")
    now = talk(adapter, px4, 0.0, 4.0, permit=permit)
    assert list((tmp_path / "state").iterdir()) == []
    assert finding(adapter, "state folder").ok is True
    assert adapter.condition(now).command is None


def test_a_disk_that_fills_up_before_arming_stops_every_change_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = on_ground(tmp_path, px4, model)
    px4.armed = True
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", no_space)
        now = talk(adapter, px4, now, 7.0)
        command = adapter.condition(now).command
        assert command is not None
        assert command.reason == Reason.JOURNAL
        assert tell(adapter, px4, without(model, (3,)), now) == []
    now = talk(adapter, px4, now, 6.0)
    assert adapter.condition(now).command is None
    assert tell(adapter, px4, without(model, (3,)), now)


def test_tuning_by_a_ground_station_in_flight_is_neither_undone_nor_forgotten(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    for i in range(8):
        px4.stored[px4.names.index(f"CA_ROTOR{i}_CT")] = 7.0
        (said,) = px4.through([px4.announce(f"CA_ROTOR{i}_CT")])
        adapter.observe(said, now)
    now = talk(adapter, px4, now, 0.2)
    assert '"value": 7.0' in (tmp_path / "journal").read_text()
    eta = np.ones(8)
    eta[0] = 0.5
    tell(adapter, px4, eta, now)
    now = talk(adapter, px4, now, 0.2)
    assert px4.scales() == [3.5] + [7.0] * 7
    px4.armed = False
    talk(adapter, px4, now, 1.0)
    assert px4.scales() == [7.0] * 8
    assert not (tmp_path / "journal").exists()


def test_what_was_untold_for_want_of_a_journal_is_forgotten_when_it_is_lifted(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 4.0, permit=Permit.TIDY)
    px4.armed = True
    now = talk(adapter, px4, now, 0.1, permit=Permit.TIDY)
    tell(adapter, px4, without(model, (3,)), now)
    assert adapter.condition(now).untold is not None
    tell(adapter, px4, np.ones(8), now)
    assert adapter.condition(now).untold is None


# -- what is left over ------------------------------------------------------------------------------------------------


def crashed(folder: Path, px4: FakePx4) -> None:
    adapter, now = in_flight(folder, px4, octo())
    tell(adapter, px4, without(octo(), (3,)), now)
    talk(adapter, px4, now, 0.3)
    assert px4.scales()[2] == 0.0


def test_one_left_over_is_stated_while_listening_and_restored_by_who_may(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    crashed(tmp_path, px4)
    px4.armed = False
    px4.received.clear()
    doctor = Px4Adapter(octo(), (1, 1), tmp_path / "journal")
    now = talk(doctor, px4, 0.0, 5.0, permit=Permit.LISTEN)
    assert "PARAM_SET" not in px4.kinds_received()
    assert finding(doctor, "journal").ok is False
    assert finding(doctor, "journal").detail == "parameters are still changed: run the companion, it restores them"
    assert any(note.reason == Reason.STILL_CHANGED for note in doctor.condition(now).notes)
    assert (tmp_path / "journal").exists()
    now = talk(Px4Adapter(octo(), (1, 1), tmp_path / "journal"), px4, 0.0, 5.0, permit=Permit.TIDY)
    assert px4.scales() == [6.5] * 8
    assert not (tmp_path / "journal").exists()


def test_one_left_over_is_restored_in_full_whatever_px4_says_now(tmp_path: Path) -> None:
    # What was sent before the crash may still be on its way.
    px4 = FakePx4(octo())
    found = px4.stored.copy()
    crashed(tmp_path, px4)
    px4.stored[:] = found
    px4.armed = False
    px4.sets.clear()
    talk(Px4Adapter(octo(), (1, 1), tmp_path / "journal"), px4, 0.0, 5.0)
    assert sorted(name for name, _ in px4.sets) == sorted(n for n in px4.names if n.endswith(("_CT", "_KM")))
    assert not (tmp_path / "journal").exists()


def test_one_that_names_a_parameter_this_airframe_lacks_is_refused(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    crashed(tmp_path, px4)
    px4.armed = False
    journal = Journal(tmp_path / "journal")
    autopilot = journal.path.read_text().split('"autopilot": "')[1].split('"')[0]
    journal.write(autopilot, [*journal.read(autopilot), Entry("CA_ROTOR8_CT", 6.5, 9)])
    adapter = Px4Adapter(octo(), (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 5.0)
    command = adapter.condition(now).command
    assert command is not None
    assert command.reason == Reason.JOURNAL
    assert "CA_ROTOR8_CT" in command.text
    assert (tmp_path / "journal").exists()


def test_one_that_cannot_be_removed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    px4 = FakePx4(octo())
    adapter, now = in_flight(tmp_path, px4, octo())
    px4.armed = False
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", no_space)
        now = talk(adapter, px4, now, 1.0)
        assert any(note.reason == Reason.JOURNAL_STAYS for note in adapter.condition(now).notes)
    now = talk(adapter, px4, now, 6.0)
    assert adapter.condition(now).notes == ()
    assert not (tmp_path / "journal").exists()


def _fly_until_killed(folder: Path, model: Vehicle, px4: FakePx4, kill_at: int) -> None:
    """A child's life: declarations, landing, restoring; SIGKILL at its n-th step on disk or wire."""
    steps = 0

    def step() -> None:
        nonlocal steps
        steps += 1
        if steps == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    def hooked(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            step()
            result = function(*arguments, **options)
            step()
            return result

        return call

    for name in ("open", "write", "fsync", "replace", "unlink"):
        setattr(os, name, hooked(getattr(os, name)))
    adapter, now = in_flight(folder, px4, model)
    for failed in ((3,), (1, 3), (1, 8)):
        for message in tell(adapter, px4, without(model, failed), now):
            assert message.get_type() == "PARAM_SET"
            step()
        now = talk(adapter, px4, now, 0.3, step)
    px4.armed = False
    talk(adapter, px4, now, 1.0, step)


def test_killed_at_any_step_the_next_start_restores_everything(tmp_path: Path) -> None:
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
        now = talk(adapter, px4, 0.0, 5.0, permit=Permit.TIDY)
        assert np.array_equal(px4.stored, found), f"killed at step {kill_at}"
        assert {p.name for p in folder.iterdir()} <= {"journal.new"}, "half a file, removed by the next write"
        condition = adapter.condition(now)
        assert (condition.command, condition.untold, condition.notes) == (None, None, ())
    print(f"killed at each of {kill_at - 1} steps")
    assert kill_at > 30


def test_on_a_full_disk_one_that_is_there_still_allows_what_it_covers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = octo()
    px4 = FakePx4(model)
    crashed(tmp_path, px4)
    monkeypatch.setattr(os, "fsync", no_space)
    adapter = Px4Adapter(model, (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 5.0)
    assert adapter.condition(now).command is None
    tell(adapter, px4, without(model, (3, 6)), now)
    now = talk(adapter, px4, now, 0.2)
    assert [i + 1 for i, scale in enumerate(px4.scales()) if scale == 0.0] == [3, 6]
