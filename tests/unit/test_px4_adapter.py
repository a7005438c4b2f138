"""PX4's adapter: what is told and when, what is said to be in force, and who is listened to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fake_px4 import FakePx4, Link, from_another, in_flight, octo, on_ground, talk, tell, without
from numpy.typing import NDArray
from px4_told import NEEDS, held, names, output, untold
from test_px4_allocator import COLLAPSE, geometry

from nff_companion.autopilots.base import Permit
from nff_companion.autopilots.px4.adapter import Method, Px4Adapter
from nff_companion.autopilots.px4.remedy import Advisor, NoRemedy, Remedy
from nff_companion.autopilots.schedule import Drive, Release, ScheduleState, steps
from nff_companion.condition import Mode, Reason, Source
from nff_companion.mavlink.codec import dialect
from nff_companion.mavlink.services.parameter_reader import name_of
from nff_companion.mavlink.services.streams import interval

pytestmark = pytest.mark.usefixtures("nothing_ahead")


# -- what is told ------------------------------------------------------------------------------------------------------


def test_a_failed_motor_is_told_by_its_thrust_coefficient(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    assert adapter.condition(now).command is None
    assert names(tell(adapter, px4, without(model, (3,)), now)) == ["CA_ROTOR2_CT"]
    now = talk(adapter, px4, now, 0.5)
    assert px4.scales() == [6.5, 6.5, 0.0, 6.5, 6.5, 6.5, 6.5, 6.5]
    assert held(adapter.condition(now)) == [3]
    assert adapter.condition(now).in_force.source == Source.DECLARATION
    assert tell(adapter, px4, without(model, (3,)), now) == []


@pytest.mark.parametrize("pair", sorted(COLLAPSE))
def test_a_collapse_pair_is_never_sent(pair: tuple[int, int], tmp_path: Path) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    for failed in (pair[:1], pair):
        tell(adapter, px4, without(model, failed), now)
        now = talk(adapter, px4, now, 0.5)
    dead = [i + 1 for i, scale in enumerate(px4.scales()) if scale == 0.0]
    assert dead == list(pair[:1]), "what could be told stays told"
    assert held(adapter.condition(now)) == dead
    assert untold(adapter.condition(now))[0] == Reason.NOT_TOLD


def test_a_pair_that_needs_it_releases_yaw_first(tmp_path: Path) -> None:
    model = octo(2.56)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    sent = names(tell(adapter, px4, without(model, (1, 8)), now))
    remedy = Advisor(model, geometry(model)).remedy(without(model, (1, 8)))
    assert isinstance(remedy, Remedy)
    first = [] if remedy.first is None else [f"CA_ROTOR{remedy.first}_CT"]
    rest = [n for n in ("CA_ROTOR0_CT", "CA_ROTOR7_CT") if n not in first]
    assert sent == [*first, *(f"CA_ROTOR{i}_KM" for i in range(8)), *rest]
    now = talk(adapter, px4, now, 0.2)
    assert held(adapter.condition(now)) == [1, 8]
    assert adapter.condition(now).in_force.yaw_released


def test_a_partial_loss_is_scaled_and_small_changes_are_not_sent(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    eta = np.ones(8)
    eta[4] = 0.5
    tell(adapter, px4, eta, now)
    now = talk(adapter, px4, now, 0.2)
    assert px4.value("CA_ROTOR4_CT") == pytest.approx(3.25)
    assert adapter.condition(now).in_force.source == Source.DECLARATION
    assert held(adapter.condition(now)) == []
    now = talk(adapter, px4, now, 2.0)
    eta[4] = 0.45
    assert tell(adapter, px4, eta, now) == []
    eta[4] = 0.3
    assert names(tell(adapter, px4, eta, now)) == ["CA_ROTOR4_CT"]


def test_a_loss_that_grew_too_soon_to_be_sent_is_sent_later(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    eta = without(model, (3,))
    tell(adapter, px4, eta, now)
    now = talk(adapter, px4, now, 0.2)
    eta[4] = 0.5
    assert tell(adapter, px4, eta, now) == []
    talk(adapter, px4, now, 1.0)
    assert px4.value("CA_ROTOR4_CT") == pytest.approx(3.25)


def test_what_was_put_off_is_not_told_after_the_permit_is_gone(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    eta = without(model, (3,))
    tell(adapter, px4, eta, now)
    now = talk(adapter, px4, now, 0.2)
    eta[4] = 0.5
    tell(adapter, px4, eta, now)
    now = talk(adapter, px4, now, 2.0, permit=Permit.TIDY)
    talk(adapter, px4, now, 1.0)  # and when it comes again, what was believed then is no longer
    assert px4.value("CA_ROTOR4_CT") == 6.5


def test_a_declaration_repeated_every_50_ms_sends_only_what_is_not_confirmed(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(drops=lambda m: m.get_type() == "PARAM_VALUE" and name_of(m) == "CA_ROTOR7_CT")
    assert len(tell(adapter, px4, without(model, (1, 8)), now)) == 10
    sent: list[str] = []
    for _ in range(100):
        for reply in px4.due(now):
            adapter.observe(reply, now)
        now += 0.01
        sent += names(tell(adapter, px4, without(model, (1, 8)), now))
    assert set(sent) == {"CA_ROTOR7_CT"}
    assert 15 <= len(sent) <= 20


def test_a_refused_remedy_is_not_sought_again_at_every_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    sought = []
    real = Advisor.remedy

    def counted(advisor: Advisor, eta: NDArray[np.float64]) -> Remedy | NoRemedy:
        sought.append(1)
        return real(advisor, eta)

    monkeypatch.setattr(Advisor, "remedy", counted)
    for k in range(200):
        eta = without(model, (1, 7))
        eta[4] = 0.5 + 0.05 * rng.uniform(-1, 1)
        tell(adapter, px4, eta, now + 0.004 * k)
    assert len(sought) <= 2


def test_the_schedule_brings_a_declaration_through_a_link_that_loses_and_delays(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    model = octo()
    px4 = FakePx4(model)
    found = px4.stored.copy()
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(delay_s=0.1, part=12, pause_s=1.0, drops=lambda m: bool(rng.uniform() < 0.3))
    state = ScheduleState.start(8)
    for _ in range(400):
        state, commands = steps(state, output(model, (1, 8)), adapter.condition(now), now)
        for message in [m for command in commands for m in adapter.encode(command)]:
            px4.receive(message, now)
        now = talk(adapter, px4, now, 0.02)
    assert adapter.condition(now).in_force.holds(output(model, (1, 8)).failed)
    assert adapter.condition(now).in_force.yaw_released
    assert adapter.condition(now).untold is None
    px4.armed = False
    now = talk(adapter, px4, now, 15.0)
    assert np.array_equal(px4.stored, found)
    assert not adapter.condition(now).unfinished


def test_nothing_is_told_disarmed_or_on_the_ground_and_no_outputs_ever(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = on_ground(tmp_path, px4, model)
    assert tell(adapter, px4, without(model, (3,)), now) == []
    px4.armed = True
    now = talk(adapter, px4, now, 0.1)
    assert adapter.encode(Drive(now, np.full(8, 0.5))) == []
    drive = adapter.condition(now).drive
    assert drive is not None
    assert drive.reason == Reason.NO_OUTPUTS_TAKEN
    assert not adapter.condition(now).takes_matrix
    assert "PARAM_SET" not in px4.kinds_received()


def test_the_operators_word_lifts_a_declaration(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2, permit=Permit.TIDY)
    tell(adapter, px4, np.ones(8), now)
    now = talk(adapter, px4, now, 0.2, permit=Permit.TIDY)
    assert px4.scales() == [6.5] * 8
    assert adapter.condition(now).in_force.source == Source.STOCK


# -- what is said to be in force ---------------------------------------------------------------------------------------


def test_yaw_is_given_up_when_px4_has_said_so_and_not_before(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.deaf = True  # none of it arrives
    assert tell(adapter, px4, without(model, (1, 8)), now)
    condition = adapter.condition(now)
    assert not condition.in_force.yaw_released
    assert held(condition) == []
    assert condition.in_force.source == Source.STOCK
    now = talk(adapter, px4, now, 1.0)
    assert not adapter.condition(now).in_force.yaw_released
    assert untold(adapter.condition(now))[0] == Reason.NOT_CONFIRMED


def test_yaw_that_all_rotors_but_one_gave_up_is_not_given_up(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(drops=lambda m: m.get_type() == "PARAM_SET" and name_of(m) == "CA_ROTOR4_KM")
    tell(adapter, px4, without(model, (1, 8)), now)
    now = talk(adapter, px4, now, 0.3)
    assert held(adapter.condition(now)) == [1, 8]
    assert not adapter.condition(now).in_force.yaw_released
    px4.link = Link()
    now = talk(adapter, px4, now, 0.3)
    assert adapter.condition(now).in_force.yaw_released


def test_a_pair_that_is_not_told_after_one_that_gave_yaw_up_is_not_said_to_be_in_force(tmp_path: Path) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (1, 8)), now)
    now = talk(adapter, px4, now, 0.3)
    condition = adapter.condition(now)
    assert (held(condition), condition.in_force.source, condition.in_force.yaw_released) == ([], Source.STOCK, False)
    assert untold(condition)[0] == Reason.NOT_TOLD
    assert not condition.in_force.holds(without(model, (1, 8)) == 0.0)


def test_motors_that_cannot_carry_the_weight_are_said_so(tmp_path: Path) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (1, 2, 3, 5)), now)
    assert untold(adapter.condition(now)) == (Reason.NO_LIFT, "LAND: the motors left cannot carry the weight")


def test_what_was_untold_is_forgotten_when_it_no_longer_is(tmp_path: Path) -> None:
    model = octo(1.55)
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (1, 7)), now)
    assert adapter.condition(now).untold is not None
    tell(adapter, px4, np.ones(8), now + 0.1)
    assert adapter.condition(now + 0.1).untold is None
    tell(adapter, px4, without(model, (1, 7)), now + 0.2)
    px4.armed = False
    now = talk(adapter, px4, now + 0.2, 0.5)
    assert adapter.condition(now).untold is None


def test_nothing_is_known_to_be_in_force_before_px4_has_said_its_parameters(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter = Px4Adapter(octo(), (1, 1), tmp_path / "journal")
    now = talk(adapter, px4, 0.0, 0.2)
    condition = adapter.condition(now)
    assert condition.in_force.failed is None
    assert condition.armed is False
    assert condition.command is not None
    assert condition.command.reason == Reason.READING


def test_a_condition_in_which_nothing_changed_is_not_made_anew(tmp_path: Path) -> None:
    px4 = FakePx4(octo())
    adapter, now = in_flight(tmp_path, px4, octo())
    first = adapter.condition(now)
    for k in range(5):
        (imu,) = px4.through([dialect.MAVLink_highres_imu_message(4000 * k, *[0.0] * 13, 0x3F)])
        assert adapter.observe(imu, now + 0.004 * k) is not None
        assert adapter.condition(now + 0.004 * k) is first


# -- who may what ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["scale", "inject"])
@pytest.mark.parametrize("permit", [Permit.LISTEN, Permit.TIDY])
def test_who_may_not_act_sends_requests_alone_from_boot_to_landing(
    permit: Permit, method: Method, tmp_path: Path
) -> None:
    model = octo()
    px4 = FakePx4(model, changes=(NEEDS if method == "inject" else {}))
    adapter = Px4Adapter(model, (1, 1), tmp_path / "journal", method)
    now = talk(adapter, px4, 0.0, 5.0, permit=permit)
    px4.armed = True
    now = talk(adapter, px4, now, 2.0, permit=permit)
    state = ScheduleState.start(8)
    for _ in range(50):  # a failure is believed in observe
        state, commands = steps(state, output(model, (3,), Mode.OBSERVE), adapter.condition(now), now)
        for message in [m for command in commands for m in adapter.encode(command)]:
            px4.receive(message, now)
        now = talk(adapter, px4, now, 0.02, permit=permit)
    px4.armed = False
    now = talk(adapter, px4, now, 2.0, permit=permit)
    adapter.encode(Release(now))
    talk(adapter, px4, now, 2.0, permit=permit)
    requests = {m.command for m in px4.received if m.get_type() == "COMMAND_LONG"}
    assert px4.kinds_received() == {"PARAM_REQUEST_READ", "COMMAND_LONG"}
    assert requests == {dialect.MAV_CMD_REQUEST_MESSAGE}
    assert list(tmp_path.iterdir()) == []


def test_listening_finishes_nothing_and_tidying_finishes_what_was_begun(tmp_path: Path) -> None:
    # Half of a declaration flies worse than all of it or none.
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.link = Link(drops=lambda m: m.get_type() == "PARAM_SET" and name_of(m).endswith("_KM"))
    tell(adapter, px4, without(model, (1, 8)), now)
    now = talk(adapter, px4, now, 0.1)
    px4.link = Link()
    px4.received.clear()
    now = talk(adapter, px4, now, 0.5, permit=Permit.LISTEN)
    assert "PARAM_SET" not in px4.kinds_received()
    talk(adapter, px4, now, 0.5, permit=Permit.TIDY)
    assert px4.moments() == [0.0] * 8


# -- who is listened to ------------------------------------------------------------------------------------------------


def test_heartbeats_of_others_neither_begin_nor_end_the_restoring(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    tell(adapter, px4, without(model, (3,)), now)
    now = talk(adapter, px4, now, 0.2)
    armed = int(dialect.MAV_MODE_FLAG_SAFETY_ARMED)
    for system, component in ((255, 190), (1, 191), (2, 1)):
        adapter.observe(from_another(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), system, component), now)
        assert adapter.condition(now).armed is True
    px4.armed = False
    for message in px4.heartbeat():
        adapter.observe(message, now)
    px4.deaf = True
    now = talk(adapter, px4, now, 0.5)
    for system, component in ((255, 190), (1, 191), (2, 1)):
        adapter.observe(from_another(dialect.MAVLink_heartbeat_message(6, 8, armed, 0, 4, 3), system, component), now)
        assert adapter.condition(now).armed is False
        assert adapter.condition(now).unfinished
    px4.deaf = False
    talk(adapter, px4, now, 0.5)
    assert px4.scales() == [6.5] * 8


def test_parameters_and_versions_of_others_are_not_the_autopilots(tmp_path: Path) -> None:
    model = octo()
    px4 = FakePx4(model)
    adapter, now = in_flight(tmp_path, px4, model)
    px4.deaf = True
    tell(adapter, px4, without(model, (3,)), now)
    zero = dialect.MAVLink_param_value_message(b"CA_ROTOR2_CT", 0.0, dialect.MAV_PARAM_TYPE_REAL32, 1, 0)
    strange = dialect.MAVLink_autopilot_version_message(0, 0x01200000, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 9)
    for message in (zero, strange):
        adapter.observe(from_another(message, 2, 1), now)
        adapter.observe(from_another(message, 1, 191), now)
    assert held(adapter.condition(now)) == []
    assert adapter.condition(now).command is None


# -- what is not understood --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "changes", "reason", "text"),
    [
        (0x01080000, {}, Reason.VERSION_UNKNOWN, "PX4 1.8.0"),
        (0x01120000, {}, Reason.VERSION_UNKNOWN, "PX4 1.18.0"),
        (0x01200000, {}, Reason.VERSION_UNKNOWN, "PX4 1.32.0"),
        (0x011000FF, {"CA_ROTOR_COUNT": 6}, Reason.CONTRADICTION, "CA_ROTOR_COUNT is 6"),
        (0x011000FF, {"CA_ROTOR3_PX": 0.4}, Reason.CONTRADICTION, "motor 4: the airframe file has it at 158 deg"),
        (0x011000FF, {"CA_ROTOR3_KM": -0.05}, Reason.CONTRADICTION, "ccw; CA_ROTORn of PX4 at 157 deg, cw"),
        (0x011000FF, {"PWM_MAIN_FUNC4": 105}, Reason.CONTRADICTION, "PWM_MAIN_FUNC4"),
        (0x011000FF, {"THR_MDL_FAC": 0.0}, Reason.CONTRADICTION, "THR_MDL_FAC is 0"),
        (0x011000FF, {"PWM_MAIN_MIN3": 1100}, Reason.CONTRADICTION, "PWM_MAIN_MIN3"),
        (0x011000FF, {"PWM_MAIN_TIM0": -4}, Reason.CONTRADICTION, "DShot"),
        (0x011000FF, {"CA_ROTOR2_CT": 0.0}, Reason.CONTRADICTION, "was a journal lost"),
        (0x011000FF, {"CA_FAILURE_MODE": 1.0, "FD_ACT_EN": 1.0}, Reason.CONTRADICTION, "use inject"),
        (0x011000FF, {"CA_ROTOR3_PX": float("nan")}, Reason.PARAMETER_SILENT, "CA_ROTOR3_PX"),
    ],
)
def test_what_is_not_understood_is_observed_with_a_reason(
    version: int, changes: dict[str, float], reason: Reason, text: str, tmp_path: Path
) -> None:
    model = octo()
    px4 = FakePx4(model, version, changes=changes)
    adapter, now = in_flight(tmp_path, px4, model)
    command = adapter.condition(now).command
    assert command is not None
    assert command.reason == reason
    assert text in command.text
    assert tell(adapter, px4, without(model, (3,)), now) == []
    assert "PARAM_SET" not in px4.kinds_received()


def test_a_px4_that_never_says_its_version_is_said_so(tmp_path: Path) -> None:
    px4 = FakePx4(octo(), link=Link(drops=lambda m: m.get_type() == "AUTOPILOT_VERSION"))
    adapter, now = in_flight(tmp_path, px4, octo())
    command = adapter.condition(now).command
    assert command is not None
    assert (command.reason, command.detail) == (Reason.PARAMETER_SILENT, "AUTOPILOT_VERSION")


# -- rates -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted_hz", "asked_hz"), [(50, 50), (125, 125), (126, 250), (200, 250), (250, 250), (400, 250)]
)
def test_the_rate_of_samples_that_is_stated_is_the_one_asked_for(
    wanted_hz: float, asked_hz: float, tmp_path: Path
) -> None:
    streams = Px4Adapter(octo(), (1, 1), tmp_path / "journal").streams(wanted_hz)
    (imu,) = [s for s in streams if s.message_id == dialect.MAVLINK_MSG_ID_HIGHRES_IMU]
    assert imu.rate_hz == asked_hz
    assert interval(imu, (1, 1)).param2 == 1e6 / asked_hz
    assert min(interval(s, (1, 1)).param2 for s in streams) >= 4000.0
