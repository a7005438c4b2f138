"""The frame that ArduPilot flies, or flew before the applet's mixer, against the airframe file: parameters, adapter."""

from __future__ import annotations

import pytest
from other_airframes import PAIRS, SHIPPED, parameters_of, wrong_files

from nff_companion.allocation import allocator, tables
from nff_companion.autopilots.ardupilot import checks, factors, tunnel
from nff_companion.autopilots.ardupilot.adapter import ArduPilotAdapter
from nff_companion.autopilots.ardupilot.tunnel import Flag, Kind, TunnelMessage
from nff_companion.autopilots.base import Permit
from nff_companion.condition import Reason
from nff_companion.core import vehicle
from nff_companion.core.vehicle import Vehicle
from nff_companion.frames import catalogue
from nff_companion.mavlink.codec import Message, dialect

TYPES = {c: {t for f in catalogue.frames().values() for k, t in f.ardupilot if k == c and t >= 0} for c in range(20)}


def scripted(values: dict[str, float]) -> dict[str, float]:
    """The same vehicle with the applet's mixer."""
    before = checks.frame_number(round(values["FRAME_CLASS"]), round(values["FRAME_TYPE"]))
    return {**values, "FRAME_CLASS": 17.0, checks.FRAME_BEFORE: float(before)}


@pytest.mark.parametrize("name", SHIPPED)
def test_the_file_of_the_frame_that_flies_is_not_contradicted(name: str) -> None:
    loaded, values = vehicle.load(name), parameters_of(name)
    assert "FRAME_TYPE" in checks.names(loaded)
    assert checks.contradictions(values, loaded) == []
    assert checks.contradictions(scripted(values), loaded) == []


@pytest.mark.parametrize("name", SHIPPED)
def test_reversed_spins_and_any_two_motors_that_changed_numbers_are_contradicted(name: str) -> None:
    values = parameters_of(name)
    for what, file in wrong_files(vehicle.load(name)).items():
        for told in (values, scripted(values)):
            found = checks.contradictions(told, file)
            assert found, what
            assert f"FRAME_CLASS {values['FRAME_CLASS']}, FRAME_TYPE {values['FRAME_TYPE']} (" in found[0]
            begins = "all spins are reversed" if what == "all spins" else f"motor {what.split()[0]}: "
            assert any(text.startswith(begins) for text in found), what


@pytest.mark.parametrize(("name", "frame"), PAIRS)
def test_another_type_of_the_frames_class_is_contradicted(name: str, frame: str) -> None:
    loaded, (mine, _) = vehicle.load(name), catalogue.by_name(frame).ardupilot[0]
    like = {"coax-x8": {2}}.get(frame, set())  # V of the class: in the firmware the same numbers
    agreeing = set()
    for kind in TYPES[mine]:
        values = parameters_of(name, (mine, kind))
        if not checks.contradictions(values, loaded) and not checks.contradictions(scripted(values), loaded):
            agreeing.add(kind)
    assert agreeing == {catalogue.by_name(frame).ardupilot[0][1]} | like


@pytest.mark.parametrize("name", SHIPPED)
def test_a_class_of_another_number_of_motors_or_of_no_known_frame_is_contradicted(name: str) -> None:
    loaded = vehicle.load(name)
    for kind in range(18):
        values = parameters_of(name, (kind, 1))
        if kind == 17 or catalogue.motors_of_ardupilot(kind) == loaded.motors:
            continue
        found = checks.contradictions(values, loaded)
        assert found[0] == f"FRAME_CLASS is {kind}, the airframe has {loaded.motors} motors"
    assert "no frame that is known here" in checks.contradictions(parameters_of("octo-x", (3, 99)), OCTO)[0]


def test_the_coaxial_file_on_a_flat_octa_x_is_named_whether_or_not_the_applet_flies_it() -> None:
    values = parameters_of("octo-x")
    for told in (values, scripted(values)):
        found = checks.contradictions(told, vehicle.load("coax-x8"))
        assert "those of coax-x8 (FRAME_CLASS 4, FRAME_TYPE 1), not of FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in found[0]
        assert "motor 3: the airframe file has it at -135 deg, ccw; FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in found[3]


def test_the_type_alone_says_nothing_where_a_script_makes_the_frame() -> None:
    values = {**scripted(parameters_of("octo-x")), "FRAME_TYPE": 0.0}
    assert checks.contradictions(values, OCTO) == []
    del values[checks.FRAME_BEFORE]
    assert checks.contradictions(values, OCTO) == []
    assert checks.compared_with(values) == ""


def test_what_was_flown_before_is_asked_for_where_the_frame_is_the_applets() -> None:
    assert checks.FRAME_BEFORE in checks.further({"FRAME_CLASS": 17.0})
    assert checks.FRAME_BEFORE not in checks.further({"FRAME_CLASS": 3.0})


# -- the adapter ------------------------------------------------------------------------------------------------------

OCTO = vehicle.load("octo-x")
PLANS = {8: tables.compute(OCTO, allocator("pinv"))}  # of no matter here
_IDS = {"applet's": True, "firmware's": False}


def heard(file: Vehicle, values: dict[str, float], *, card: Vehicle) -> ArduPilotAdapter:
    """An adapter with an airframe file, on the ground; the applet is healthy and has the ``card`` of an airframe."""
    adapter = ArduPilotAdapter(file, (1, 1), PLANS[file.motors], 7)
    adapter.observe(dialect.MAVLink_heartbeat_message(14, 3, 0, 4, 4, 3), 9.0)
    for name, value in values.items():
        adapter.observe(dialect.MAVLink_param_value_message(name.encode(), value, 9, 100, 0), 9.0)
    adapter.observe(applied(file, card), 10.0)
    return adapter


def applied(file: Vehicle, card: Vehicle, sequence: int = 1) -> Message:
    """What a healthy applet says whose card is that of an airframe."""
    packed = {m: tunnel.table_bytes(table) for m, table in factors.of_plans(card, PLANS[file.motors]).items()}
    said = dict.fromkeys(tunnel._LAYOUTS[Kind.APPLIED][1], 0)
    said |= {"sequence": sequence, "time_ms": 20_000, "boot_ms": 1000, "owner": 7, "motors": card.motors}
    said |= {"tables": len(packed), "stock_check": tunnel.check(packed[0]), "tables_check": 1}
    said["flags"] = Flag.MATRIX | Flag.WATCHDOG | Flag.LINK
    return tunnel.wrap(TunnelMessage(Kind.APPLIED, said).pack(), (1, 191), tunnel.TO_COMPANION)


@pytest.mark.parametrize("applets", _IDS.values(), ids=_IDS.keys())
def test_a_wrong_file_that_the_card_agrees_with_is_observed_with_the_reason_and_nothing_is_sent(
    applets: bool,
) -> None:
    values = parameters_of("octo-x")
    values = scripted(values) if applets else values
    right = heard(OCTO, values, card=OCTO)
    assert right.condition(10.0).command is None
    wrong = {name: file for name, file in wrong_files(OCTO).items() if name in ("all spins", "1 and 2", "3 and 8")}
    for what, file in {**wrong, "coaxial": vehicle.load("coax-x8")}.items():
        adapter = heard(file, values, card=file)
        obstacle = adapter.condition(10.0).command
        assert obstacle is not None, what
        assert obstacle.reason == Reason.CONTRADICTION
        assert "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in obstacle.text
        assert obstacle in adapter.condition(10.0).notes
        sent = [m for k in range(40) for m in adapter.due(10.0 + 0.02 * k, Permit.ACT) if m.get_type() == "TUNNEL"]
        kinds = {inner.kind for inner in (tunnel.unwrap(m, tunnel.TO_AUTOPILOT) for m in sent) if inner is not None}
        assert kinds == {Kind.HEARTBEAT}
        parameters = next(f for f in adapter.findings() if f.name == "parameters")
        assert parameters.ok is False
        assert "FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)" in parameters.detail


def test_the_doctor_says_what_the_mixer_was_compared_with() -> None:
    values = parameters_of("octo-x")
    for told, when in ((scripted(values), " at the installation"), (values, "")):
        card = next(f for f in heard(OCTO, told, card=OCTO).findings() if f.name == "card")
        text = f"the mixer is that of octo-x, which was compared{when} with FRAME_CLASS 3, FRAME_TYPE 1 (octo-x)"
        assert (card.ok, card.detail) == (True, text)


def test_a_mixer_that_was_compared_with_nothing_is_not_commanded() -> None:
    values = scripted(parameters_of("octo-x"))
    del values[checks.FRAME_BEFORE]
    adapter, now_s = heard(OCTO, values, card=OCTO), 10.0
    assert adapter.condition(now_s).command is not None, "it is being asked for"
    for _ in range(8):
        now_s += 0.3
        requests = [m.param_id for m in adapter.due(now_s, Permit.ACT) if m.get_type() == "PARAM_REQUEST_READ"]
        assert set(requests) <= {checks.FRAME_BEFORE.encode(), checks.FRAME_BEFORE}
    silent = adapter.condition(now_s).command
    assert silent is not None
    assert silent.reason == Reason.SILENT, "an applet that is not there is no older one"
    adapter.observe(applied(OCTO, OCTO, sequence=2), now_s)
    obstacle = adapter.condition(now_s).command
    assert obstacle is not None
    assert obstacle.reason == Reason.CONTRADICTION
    assert "install it again" in obstacle.text
    assert "install it again" in next(f.detail for f in adapter.findings() if f.name == "parameters")
