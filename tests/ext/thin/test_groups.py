"""Groups of commands: what may be in one, and what its copies are."""

import pytest

from pebble.contract import DRIVE, LIGHTS_SOLID, MCU_COMMAND, OUTLET_COMMAND, codec, groups
from pebble.errors import PayloadError
from pebble.extensions.thin.group_gate import copy_of, encoded, is_marked

GROUP = (
    b'{"drive-values": {"x": -0.25, "z": 0.5, "valid_ms": 400}, "lights-solid": {"r": 0.5},'
    b' "outlets/lamp/power": {"on": true}, "mcu/abc/arm": {"angle": 3}, "soundboard-command": {"action": "stop"}}'
)


def test_members_have_their_values() -> None:
    members = {member.metric: member for member in groups.decode(GROUP)}
    assert members["drive-values"].value == codec.decode(DRIVE, b'{"x": -0.25, "z": 0.5, "valid_ms": 400}')
    assert members["lights-solid"].channel is LIGHTS_SOLID
    assert members["outlets/lamp/power"].channel is OUTLET_COMMAND
    assert members["mcu/abc/arm"].channel is MCU_COMMAND
    assert [metric for metric, member in members.items() if member.channel.ends(member.value)] == ["soundboard-command"]


def test_a_mark_that_is_none_is_as_good_as_absent() -> None:
    assert codec.decode(LIGHTS_SOLID, b'{"r": 1, "group": 5}') == codec.decode(LIGHTS_SOLID, b'{"r": 1}')


def test_what_is_encoded_is_the_same_group() -> None:
    members = groups.decode(GROUP)
    assert groups.decode(encoded(members)) == members


def test_copies_are_marked_where_the_owner_of_a_line_takes_the_group() -> None:
    copies = {member.metric: copy_of(member) for member in groups.decode(GROUP)}
    marked = {metric for metric, copy in copies.items() if is_marked(copy)}
    assert marked == {"drive-values", "lights-solid", "mcu/abc/arm"}
    assert copies["outlets/lamp/power"] == b'{"on":true}'


def test_the_sender_is_in_each_member_and_no_claim() -> None:
    raw = b'{"by": "otto", "drive-values": {"z": 1, "by": "eve", "group": true}, "lights-solid": {}}'
    assert [member.payload for member in groups.decode(raw)] == [b'{"z":1,"by":"otto"}', b'{"by":"otto"}']


@pytest.mark.parametrize(
    "raw",
    [
        b'{"drive-values": {"z": 0.1}, "drive-values": {"z": 0.9}}',
        b'{"drive-values": {"z": 0.1}, "\\u0064rive-values": {"z": 0.9}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"z": 0.1, "\\u007a": 0.9}}',
        b'{"drive-values": {"z": 0.5}, "estop": {}}',
        b'{"drive-values": {"z": 0.5}, "estop-reset": {"boot": "a", "count": 1}}',
        b'{"drive-values": {"z": 0.5}, "control/take": {"id": "0badf00d"}}',
        b'{"drive-values": {"z": 0.5}, "group": {"lights-solid": {}}}',
        b'{"drive-values": {"z": 0.5}, "warp": {}}',
        b'{"drive-values": {"z": 0.5}, "mcu/a/b/c": {}}',
        b'{"drive-values": {"z": 0.5}, "mcu//b": {}}',
        b'{"drive-values": {"z": 0.5}, "outlets/1/power": {"on": 1}}',
        b'{"drive-values": {"z": 0.5, "valid_ms": 0}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"z": 0.5, "source": "autonomy"}}',
        b'{"drive-values": {"x": NaN}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"x": 1e999}, "lights-solid": {"r": 1}}',
        b'{"drive-values": {"x": 1' + b"0" * 400 + b"}}",
        b'{"drive-values": {"value": {"z": 0.5}}}',
        b'{"drive-values": true}',
        b'{"lights-solid": {"r": 1}, "lights-flash": {"r": 1}}',
        b'{"by": "otto"}',
        b"{}",
        b"[1]",
        b"",
        b" ",
        b'{"drive-values":' + b"[" * 500 + b"]" * 500 + b"}",
        b'{"lights-solid": {"r": 1' + b" " * 2048 + b"}}",
        b'{"lights-solid": {"r": 1}',
        bytes(range(128, 208)),
        b"{" + b", ".join(b'"outlets/%d/power": {"on": true}' % number for number in range(9)) + b"}",
    ],
)  # fmt: skip
def test_a_group_with_a_bad_member_is_refused(raw: bytes) -> None:
    with pytest.raises(PayloadError):
        groups.decode(raw)


@pytest.mark.parametrize(
    ("raw", "marked"),
    [
        (b'{"z": 1, "group": true}', True),
        (b'{"z": 1, "gr\\u006fup": true}', True),
        (b'{"value": {"z": 1, "group": true}}', True),
        (b'{"z": 1, "group": false}', False),
        (b'{"z": 1}', False),
        (b'{"group": ', False),
    ],
)
def test_marks_are_found_however_they_are_written(raw: bytes, marked: bool) -> None:
    assert is_marked(raw) is marked
