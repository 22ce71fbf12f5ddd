"""Names to addresses, and answers that lie."""

import random

from wifi.dns import answer, query

HOST = "Broker.Example.org"
ASKED = query(HOST, b"\x12\x34")
NAME = b"\xc0\x0c"  # where the question has it


def reply(*records: bytes, flags: bytes = b"\x81\x80", count: int = -1) -> bytes:
    count = len(records) if count < 0 else count
    return ASKED[:2] + flags + b"\0\1" + bytes((count >> 8, count & 255)) + bytes(4) + ASKED[12:] + b"".join(records)


def record(kind: int, data: bytes, name: bytes = NAME, group: bytes = b"\0\1") -> bytes:
    return name + bytes((0, kind)) + group + b"\0\0\0\x3c" + bytes((len(data) >> 8, len(data) & 255)) + data


def test_the_question() -> None:
    assert ASKED == b"\x12\x34\1\0\0\1\0\0\0\0\0\0\6broker\7example\3org\0\0\1\0\1"
    assert query("a.local.", b"ab")[12:] == b"\1a\5local\0\0\1\0\1"


def test_what_is_no_name() -> None:
    for host in ("", ".", "a..b", "x" * 64 + ".org"):
        try:
            query(host, b"ab")
        except ValueError:
            continue
        raise AssertionError(host)


GOOD = reply(record(1, b"\x0a\0\0\2"))
#: Replies and the address in them; "": there is none; None: they are no answer to what was asked.
REPLIES = (
    (reply(record(5, b"\5other\xc0\x13"), record(1, b"\xc0\xa8\1\xfe", b"\5other\7example\3org\0")), "192.168.1.254"),
    (reply(record(1, b"\1\2\3\4", group=b"\x80\1"), flags=b"\x84\0"), "1.2.3.4"),  # of mDNS
    (reply(record(1, b"\1\2\3\4", b"\xc0\xff")), "1.2.3.4"),  # where its name is is not looked at
    (reply(record(1, b"\1\2\3\4", b"\x3f")), ""),
    (reply(count=65535), ""),
    (b"", None),
    (b"\0\0" + GOOD[2:], None),
    (ASKED, None),  # a question
    (GOOD[:13] + b"x" + GOOD[14:], None),
    (GOOD[:5] + b"\2" + GOOD[6:], None),
)


def test_the_address_in_a_reply() -> None:
    for data, address in REPLIES:
        assert answer(data, ASKED) == address, data


def test_cut_short_anywhere() -> None:
    whole = reply(record(5, b"\5other\xc0\x13"), record(1, b"\x0a\0\0\2"))
    for length in range(len(whole)):
        assert answer(whole[:length], ASKED) in (None, ""), length
    assert answer(whole, ASKED) == "10.0.0.2"


def test_noise_does_no_harm() -> None:
    random.seed(3)
    for _ in range(300):
        tail = bytes([random.getrandbits(8) for _ in range(random.getrandbits(6))])
        found = answer(reply(tail, count=random.getrandbits(16)), ASKED)
        assert found is not None
        assert found == "" or found.count(".") == 3


def test_of_several_each_has_its_turn_in_whatever_order_they_come() -> None:
    one, two, ten = (record(1, bytes((10, 0, 0, last))) for last in (1, 2, 10))
    assert answer(reply(two, ten, one), ASKED) == "10.0.0.2"  # as it came
    for records in ((one, two, ten), (ten, one, two), (two, ten, one, two)):
        found = [answer(reply(*records), ASKED, skip) for skip in range(1, 7)]
        assert found == ["10.0.0.2", "10.0.0.10", "10.0.0.1"] * 2
    rotating = ((one, two), (two, one)) * 2
    assert {answer(reply(*records), ASKED, skip) for skip, records in enumerate(rotating, 1)} == {
        "10.0.0.1",
        "10.0.0.2",
    }
    assert answer(reply(one, two)[:-1], ASKED, 1) == "10.0.0.1"  # the second one is cut off
