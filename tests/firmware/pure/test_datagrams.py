"""Names to addresses, answers of time servers and the clock they set; getting to the broker and noticing its loss."""

import struct

from common.ticks import add
from wifi.connection import Connection
from wifi.dns import answer, query
from wifi.sntp import WallClock, epoch_ms, request

ASKED = query("Broker.Example.org", b"\x12\x34")
NAME = b"\xc0\x0c"  # where the question has it


def reply(*records: bytes, flags: bytes = b"\x81\x80", count: int = -1) -> bytes:
    count = len(records) if count < 0 else count
    return ASKED[:2] + flags + b"\0\1" + bytes((count >> 8, count & 255)) + bytes(4) + ASKED[12:] + b"".join(records)


def record(kind: int, data: bytes, name: bytes = NAME, group: bytes = b"\0\1") -> bytes:
    return name + bytes((0, kind)) + group + b"\0\0\0\x3c" + bytes((len(data) >> 8, len(data) & 255)) + data


def test_the_question() -> None:
    assert ASKED == b"\x12\x34\1\0\0\1\0\0\0\0\0\0\6broker\7example\3org\0\0\1\0\1"
    assert query("a.local.", b"ab")[12:] == b"\1a\5local\0\0\1\0\1"
    for host in ("", "a..b", "x" * 64 + ".org"):
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


def test_of_several_each_has_its_turn_in_whatever_order_they_come() -> None:
    one, two, ten = (record(1, bytes((10, 0, 0, last))) for last in (1, 2, 10))
    assert answer(reply(two, ten, one), ASKED) == "10.0.0.2"  # as it came
    for records in ((one, two, ten), (ten, one, two), (two, ten, one, two)):
        found = [answer(reply(*records), ASKED, skip) for skip in range(1, 7)]
        assert found == ["10.0.0.2", "10.0.0.10", "10.0.0.1"] * 2
    assert answer(reply(one, two)[:-1], ASKED, 1) == "10.0.0.1"  # the second one is cut off


NONCE = b"abcdefgh"
LAST = (1 << 30) - 1  # the highest tick


def time_answer(
    first: int = 0x24, stratum: int = 2, nonce: bytes = NONCE, seconds: int = 3908988800, fraction: int = 0
) -> bytes:
    return bytes((first, stratum)) + bytes(22) + nonce + bytes(8) + struct.pack(">II", seconds, fraction)


#: What comes, and the milliseconds that it says; None: it is no answer.
ANSWERS = (
    (time_answer(), 1700000000000),
    (time_answer(fraction=1 << 31), 1700000000500),
    (time_answer(fraction=(1 << 32) - 1), 1700000000999),
    (time_answer(seconds=1), 2085978497000),  # after 2036
    (b"", None),
    (time_answer()[:47], None),
    (time_answer(nonce=b"abcdefgX"), None),
    (time_answer(first=0x23), None),  # a client
    (time_answer(first=0xE4), None),  # clock not set
    (time_answer(stratum=0), None),  # kiss of death
    (time_answer(stratum=16), None),
    (time_answer(seconds=0), None),
)


def test_request_and_answers() -> None:
    data = request(NONCE)
    assert (len(data), data[0] & 7, data[40:]) == (48, 3, NONCE)
    for data, ms in ANSWERS:
        assert epoch_ms(data, NONCE) == ms, data


def test_it_counts_from_the_start_and_ticks_may_wrap_as_often_as_they_like() -> None:
    wall = WallClock(500)
    assert (wall.read(500), wall.read(750)) == (0, 250)
    wall = WallClock(LAST - 1000)
    wall.set(1700000000000, LAST - 1000)
    now, day = LAST - 1000, 86400000
    for days in range(1, 40):
        now = add(now, day)
        assert wall.read(now) == 1700000000000 + days * day


# -- getting to the broker, noticing its loss, and waiting before the next attempt


def online(now: int = 0) -> Connection:
    connection = Connection()
    assert connection.step(now, True) == "resolve"
    connection.move("connecting", now)
    connection.move("online", now)
    return connection


def test_each_step_of_the_way_may_take_so_long_and_no_longer() -> None:
    connection = Connection()
    connection.step(0, True)
    assert connection.step(3499, True) == ""
    assert connection.step(3500, True) == "drop"
    assert connection.reason == "resolving took too long"
    connection.move("connecting", 0)
    assert connection.step(7999, True) == ""
    assert connection.step(8000, True) == "drop"
    assert connection.reason == "connecting took too long"
    connection.move("subscribing", 0)
    assert connection.step(1999, True) == ""
    assert connection.step(2000, True) == "drop"  # the first command may be as old as this


def test_answers_hold_the_connection() -> None:
    connection = online()
    connection.received(1100)
    assert connection.step(3099, True) == ""
    assert connection.step(3100, True) == "drop"


def test_the_loss_of_the_wifi_drops_at_once() -> None:
    connection = online()
    assert connection.step(10, False) == "drop"
    assert connection.state == "offline"
    connection.lost(10, 0)
    assert connection.state == "offline"
    assert connection.step(20, False) == ""
    assert connection.step(30, True) == "resolve"


def test_only_what_fails_passes_the_turn_to_the_next_address() -> None:
    connection = online()
    connection.step(5000, True)
    connection.lost(5000, 0)  # it has worked
    assert connection.failures == 0
    connection.step(9000, True)
    connection.lost(9000, 0)
    assert connection.failures == 1
    connection.move("connecting", 20_000)
    connection.step(20_010, False)
    connection.lost(20_010, 0)  # without Wi-Fi
    assert connection.failures == 1
    connection.step(30_000, True)
    connection.move("online", 30_000)
    connection.lost(30_100, 0)  # accepted, and thrown out
    assert connection.failures == 2


def waits(connection: Connection, now: int, noise: int) -> int:
    """How long until the next attempt, after one that failed at ``now``."""
    connection.lost(now, noise)
    ms = 0
    while connection.step(now + ms, True) != "resolve":
        ms += 1
    return ms


def test_waiting_doubles_up_to_eight_seconds() -> None:
    connection = Connection()
    connection.step(0, True)
    now, seen = 0, []
    for _ in range(6):
        ms = waits(connection, now, 128)
        seen.append(ms)
        now += ms
    assert seen == [500, 1000, 2000, 4000, 8000, 8000]
    assert connection.losses == 6


def test_a_connection_that_held_makes_the_next_wait_short() -> None:
    connection = Connection()
    connection.step(0, True)
    assert waits(connection, 0, 128) == 500
    connection.move("online", 0)
    connection.step(4999, True)
    assert waits(connection, 4999, 128) == 1000  # it did not hold
    connection.move("online", 0)
    connection.received(5000)
    connection.step(5000, True)
    assert waits(connection, 5000, 128) == 500
