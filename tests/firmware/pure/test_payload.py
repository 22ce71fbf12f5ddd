"""Drive commands: what moves a robot, and what never does; the emergency stop, and who has control."""

import json

from common.latch import Latch
from common.lease import Lease, request_of
from common.payload import clamp, load, mix
from common.payload import parse as parse_all
from common.ticks import diff

with open(__file__[: max(0, __file__.rfind("/firmware/"))] + "/vectors/commands.json") as file:  # noqa: PTH123
    VECTORS = json.load(file)


def parse(raw: bytes, grouped: bool = False) -> "tuple | None":
    """The axes."""
    command = parse_all(raw, grouped)
    return command[:3] if command else None


def order(raw: bytes) -> "tuple | None":
    """Run and validity."""
    command = parse_all(raw)
    return command[3:5] if command else None


#: The axes of commands; None: they are none.
AXES = (
    (b'{"x": 0.5, "z": -0.25, "y": 1}', (0.5, -0.25, 1.0)),
    (b'{"value": {"x": 0.5, "z": -0.25}, "z": 1}', (0.5, -0.25, 0.0)),
    (b'{"value": 3, "z": 0.25}', (0.0, 0.25, 0.0)),
    (b'{"z": 1, "n": "\xc3\xab"}', (0.0, 1.0, 0.0)),
    (b"", None), (b" ", None), (b"[1, 1]", None), (b"null", None), (b'{"z": 1', None), (b'{"z": 1}}', None),
    (b"\xff\xfe\x00", None), (b'{"z": 1, "n": "\xff"}', None),
)  # fmt: skip


def test_the_axes_of_a_command() -> None:
    for raw, expected in AXES:
        assert parse(raw) == expected, raw
    assert mix(1.0, 1.0) == (1.0, 0.0)
    assert mix(-1.0, -1.0) == (-1.0, 0.0)
    assert (clamp(7.0), clamp(-7.0), clamp(0.25)) == (1.0, -1.0, 0.25)


def test_numbers_are_read_as_on_linux() -> None:
    for text, number in VECTORS["numbers"]:
        for axis in ("x", "z", "y"):
            wanted = None if number is None else tuple([number if one == axis else 0.25 for one in ("x", "z", "y")])
            axes = ", ".join(['"' + one + '": ' + (text if one == axis else "0.25") for one in ("x", "z", "y")])
            assert parse(("{" + axes + "}").encode()) == wanted, axes


def test_bytes_around_a_command_change_nothing() -> None:
    for before, after in VECTORS["around"]:
        for inner in (b'{"x": 0, "z": 0}', b'{"value": {"x": 0.5, "z": -1}}'):
            raw = bytes([ord(char) for char in before]) + inner + bytes([ord(char) for char in after])
            assert parse(raw) == parse(inner) is not None, raw
    assert load(b'\xef\xbb\xbf{"stop": "c9a9f10cc9a9f10c"}\0') == {"stop": "c9a9f10cc9a9f10c"}
    assert parse(bytes([byte for char in b'{"x": 0}' for byte in (char, 0)])) is None  # UTF-16


def test_length_and_depth_have_limits() -> None:
    body = b'{"z": 1, "pad": "%s"}'
    room = 512 - len(body % b"")
    assert parse(body % (b"x" * room)) == (0.0, 1.0, 0.0)
    assert parse(body % (b"x" * (room + 1))) is None
    assert parse(b"[" * 1000) is None
    assert parse(b'{"a":' * 40 + b"1" + b"}" * 40) is None
    assert parse(b'{"z": 1, "a":' + b"[" * 20 + b"]" * 20 + b"}") == (0.0, 1.0, 0.0)


#: Run and validity of commands; None: they move nothing, and are none.
ORDERS = (
    (b'{"z": 1, "source": "autonomy", "run": 17}', (17, -1)),
    (b'{"value": {"z": 1, "source": "autonomy", "run": 1073741823}}', (1073741823, -1)),
    (b'{"z": 0, "source": "autonomy", "run": 17, "valid_ms": 0}', (17, 0)),
    (b'{"z": 1, "valid_ms": 250.9}', (0, 250)),
    (b'{"z": 0, "valid_ms": 0.5}', (0, 0)),
    (b'{"z": 1, "valid_ms": 999999999999}', (0, 60_000)),
    (b'{"z": 0.5, "source": "autonomy"}', None),  # a script's without its run
    (b'{"source": "autonomy"}', (-1, -1)),
    (b'{"z": 0.5, "valid_ms": 0.5}', None),
)


def test_the_run_and_the_validity_of_a_command() -> None:
    for raw, expected in ORDERS:
        assert order(raw) == expected, raw


def test_a_command_may_name_the_control_it_is_sent_under() -> None:
    for text, moving, zero in (("", "", ""), (', "key": "0badf00d"', "0badf00d", "0badf00d"), (', "key": null', "", ""),
                               (', "key": 5', None, ""), (', "key": ["a"]', None, "")):  # fmt: skip
        command = parse_all(('{"z": 0.5' + text + "}").encode())
        assert (command[5] if command else None) == moving, text
        command = parse_all(('{"z": 0' + text + "}").encode())
        assert command is not None
        assert command[5] == zero, text


def test_a_wrong_field_refuses_what_moves_and_never_a_zero() -> None:
    signed = ', "source": "autonomy"'
    wrong = []
    for value in ("5", '["autonomy"]'):
        wrong.append(('"source": ' + value, (0, -1)))
    for value in ('"17"', "1.5", "true", "0", "1073741824"):
        wrong.append(('"run": ' + value + signed, (-1, -1)))
        wrong.append(('"run": ' + value, (0, -1)))
    for value in ('"400"', "-1", "true", "1e300", "1" + "0" * 300):
        wrong.append(('"valid_ms": ' + value + ', "run": 17' + signed, (17, -1)))
    for text, zero in wrong:
        assert order(('{"z": 0.5, ' + text + "}").encode()) is None, text
        assert order(('{"z": 0, ' + text + "}").encode()) == zero, text


def test_a_group_moves_with_a_drive_command_and_nothing_else_and_a_zero_always_stops() -> None:
    for group, axes in (
        (b'{"drive-values":{"x":0.5,"z":1}}', (0.5, 1.0, 0.0)),
        (b'\xef\xbb\xbf{"drive-values":{"z":0}}\0rest', (0.0, 0.0, 0.0)),
        (b'{"drive-values":{"z":1},"lights-solid":{"r":1}}', None),
        (b'{"lights-solid":{"r":1},"drive-values":{"z":0}}', (0.0, 0.0, 0.0)),
        (b'{"lights-solid":{"r":1},"drive-values":{"z":1}}', None),
        (b'{"drive-values":{"z":1},"drive-values":{"z":0.5}}', None),
        (b'{"\\u0064rive-values":{"z":1}}', None),
        (b'{"drive-values":{"z":NaN}}', None),
        (b'{"drive-values":[{"z":1}]}', None),
        (b"{}", None),
    ):
        assert parse(group, True) == axes, group


# -- the emergency stop, and requests for control: what the histories of tests/motion do not have


A, B, C = "00000000000000aa", "00000000000000bb", "00000000000000cc"


def stopped(*names: str) -> Latch:
    latch = Latch("0badcafe", 2, diff)
    for name in names:
        latch.stop(name, "ann", "test", 5)
    return latch


def test_a_sender_that_was_not_checked_gives_way_to_one_that_was() -> None:
    latch = stopped(B)
    for by, shown in (("otto?", "otto?"), ("", "otto?"), ("ann?", "otto?"), ("ann", "ann"), ("vera", "ann")):
        assert latch.stop(A, by, "", 9) == (by == "otto?")
        assert (latch.by, latch.count) == (shown, 2)
    latch.stop(C, "otto?", "", 9)
    latch.stop(A, "vera", "", 9)  # of an older stop
    assert latch.by == "otto?"


def test_the_name_of_a_stop_stays_while_another_sender_floods() -> None:
    """Else a state, of which there are four a second, might never have it, and the stop would not be confirmed."""
    latch = Latch("0badcafe", 4, diff)
    latch.restore({"latched": False, "recent": [B, C]})
    latch.stop(A, "otto?", "", 5)
    latch.stop(A, "otto", "", 5)
    for number in range(1000):
        latch.stop(f"e{number:015x}", ("vera", "vera/pad", "vera/desk")[number % 3], "", 5)
        latch.stop(f"f{number:015x}", f"p{number}?", "", 5)
    vera, claimed = "e0000000000003e7", ["f0000000000003e7", "f0000000000003e6"]
    assert latch.recent == [claimed[0], vera, claimed[1], A]
    assert latch.count == 2001


def test_odd_fields_in_a_saved_state_are_left_out() -> None:
    latch = stopped()
    latch.restore({"latched": False, "recent": [A, 5, "x", B, C], "by": 7, "why": 'a"b\\c\n', "since": "now"})
    assert (latch.latched, latch.recent, latch.by, latch.why, latch.since) == (False, [A, B], "", "a?b?c?", 0)


def test_what_a_request_is() -> None:
    for fields, request in (
        ({"id": "3f2a91c0"}, ("3f2a91c0", "", "", 3000)),
        ({"id": "3F2A91C0", "want": "hold", "by": "Ann", "device": "x" * 30}, ("3F2A91C0", "ann", "x" * 20, 3000)),
        ({"id": "3f2a91c0", "want": "release"}, ("3f2a91c0", "", "", 0)),
        ({"id": "3f2a91c0", "for_ms": 0}, ("3f2a91c0", "", "", 1)),
        ({"id": "3f2a91c0", "for_ms": 1e30}, ("3f2a91c0", "", "", 10_000)),
        ({}, None), ({"id": 7}, None), ({"id": "3f2a91c"}, None), ({"id": "3f2a91cg"}, None),
        ({"id": "3f2a91c0", "want": "drive"}, None), ({"id": "3f2a91c0", "for_ms": True}, None),
        ({"id": "3f2a91c0", "by": 1}, None), ({"id": "3f2a91c0", "device": None}, None),
    ):  # fmt: skip
        assert request_of(fields) == request, fields


def lease() -> Lease:
    """Ann has control."""
    own = Lease(0, diff, lambda count: "a" * (2 * count), 0)
    own.hold(("", "aaaaaaaa", "ann", "phone"), 3000, False, 0)
    return own


def test_the_first_client_that_asks_is_published() -> None:
    own, otto = lease(), ("", "00000001", "otto", "")
    for client, published in ((otto, True), (otto, False), (("", "00000002", "mia", ""), False)):
        own.changed = False
        own.hold(client, 3000, False, 9)
        assert (own.asker, own.changed) == (otto, published)


def test_keys_of_several_owners_are_shorter_than_80_letters() -> None:
    own = lease()
    for others, holds in ((0, True), (70, True), (71, False), (700, False)):
        assert own.holds(("x" * others + " " if others else "") + own.key, "") is holds
