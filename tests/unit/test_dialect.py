"""The dialect: XML and generated module agree, payloads fit, bytes on the wire never change."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from nff_companion.mavlink.codec import Codec, dialect

XML = Path(__file__).parents[2] / "mavlink_dialect" / "nff.xml"
MESSAGES = ElementTree.parse(XML).getroot().findall("messages/message")


@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: m.get("name"))
def test_module_holds_the_message_of_the_xml(message: ElementTree.Element) -> None:
    made = dialect.mavlink_map[int(message.attrib["id"])]
    assert made.msgname == message.get("name")
    fields = [f.get("name") for f in message.findall("field")]
    assert made.fieldnames == fields
    assert made.unpacker.size <= 255


def test_no_extension_fields_before_their_time() -> None:
    assert not [m.get("name") for m in MESSAGES if m.find("extensions") is not None]


def test_private_ids_are_in_the_unallocated_range() -> None:
    own = [int(m.attrib["id"]) for m in MESSAGES if m.attrib["name"].startswith("NFF_")]
    assert own
    assert all(54000 <= i <= 59999 for i in own)


def test_esc_messages_are_those_of_common() -> None:
    # CRC_EXTRA of common.xml: another layout would have another value.
    assert dialect.mavlink_map[290].crc_extra == 251
    assert dialect.mavlink_map[291].crc_extra == 10


def test_esc_telemetry_is_that_of_ardupilotmega() -> None:
    for ours in (dialect.mavlink_map[i] for i in (11030, 11031, 11032)):
        theirs = ardupilotmega.mavlink_map[ours.id]
        assert (ours.msgname, ours.crc_extra, ours.fieldnames) == (theirs.msgname, theirs.crc_extra, theirs.fieldnames)


def test_golden_bytes_of_every_private_message() -> None:
    golden = (Path(__file__).parents[1] / "data" / "golden_frames.txt").read_text(encoding="ascii").split("\n")
    expected = dict(line.split(" ") for line in golden if line)
    made = {name: Codec(1, 191).pack(message).hex() for name, message in examples().items()}
    assert made == expected


def test_every_example_survives_the_wire() -> None:
    for name, message in examples().items():
        (back,) = Codec(1, 1).parse(Codec(1, 191).pack(message))
        assert back.get_type() == name
        for field in back.get_fieldnames():
            assert repr(getattr(back, field)) == repr(getattr(Codec(1, 1).parse(Codec(1, 191).pack(back))[0], field))


def examples() -> dict[str, object]:
    half = [0.5] * 8 + [math.nan] * 8
    return {
        "ESC_INFO": dialect.MAVLink_esc_info_message(0, 5, 6, 8, 1, 255, [0] * 4, [1] * 4, [2500] * 4),
        "ESC_STATUS": dialect.MAVLink_esc_status_message(4, 5, [1000, -2, 3, 4], [22.5] * 4, [1.5] * 4),
        **{
            f"ESC_TELEMETRY_{name}": getattr(dialect, f"MAVLink_esc_telemetry_{name.lower()}_message")(
                [25] * 4, [2220] * 4, [150] * 4, [7] * 4, [0, 4000, 4100, 4200], [1, 2, 3, 65535]
            )
            for name in ("1_TO_4", "5_TO_8", "9_TO_12")
        },
        "NFF_ALLOCATION_MATRIX": dialect.MAVLink_nff_allocation_matrix_message(
            1234567, 7, 500, 1, 1, 4, 8, 1, [k / 4 for k in range(48)]
        ),
        "NFF_ACTUATOR_OVERRIDE": dialect.MAVLink_nff_actuator_override_message(1234567, 9, 100, 1, 1, 8, half),
        "NFF_EFFECTIVENESS": dialect.MAVLink_nff_effectiveness_message(1, 8, half, half, [0, 2] + [0] * 14),
        "NFF_COMPANION_STATUS": dialect.MAVLink_nff_companion_status_message(
            1, 2, 3, 4, 5, 6, 0b101, 200.0, 150.0, [0.0, 0.25, -0.5, 0.0], 1, 0, 2, b"time jumped"
        ),
        "NFF_FAULT_EVENT": dialect.MAVLink_nff_fault_event_message(1234567, 3, 1, 0.125, 0.75),
        "NFF_MOTOR_DECLARATION": dialect.MAVLink_nff_motor_declaration_message(1234567, 4, 0b100, 1, 1),
        "NFF_APPLIED": dialect.MAVLink_nff_applied_message(1234567, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 2),
    }
