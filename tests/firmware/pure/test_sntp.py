"""Requests to a time server, which answers are valid, and the clock they set."""

import struct

from common.ticks import add
from wifi.sntp import WallClock, epoch_ms, request

NONCE = b"abcdefgh"
LAST = (1 << 30) - 1  # the highest tick


def answer(
    first: int = 0x24, stratum: int = 2, nonce: bytes = NONCE, seconds: int = 3908988800, fraction: int = 0
) -> bytes:
    return bytes((first, stratum)) + bytes(22) + nonce + bytes(8) + struct.pack(">II", seconds, fraction)


def test_the_request_is_of_a_client_and_carries_the_nonce() -> None:
    data = request(NONCE)
    assert len(data) == 48
    assert data[0] & 7 == 3
    assert data[40:] == NONCE


#: What comes, and the milliseconds that it says; None: it is no answer.
ANSWERS = (
    (answer(), 1700000000000),
    (answer(fraction=1 << 31), 1700000000500),
    (answer(fraction=(1 << 32) - 1), 1700000000999),
    (answer(seconds=1), 2085978497000),  # after 2036
    (b"", None),
    (answer()[:47], None),
    (answer(nonce=b"abcdefgX"), None),
    (answer(first=0x23), None),  # a client
    (answer(first=0xE4), None),  # clock not set
    (answer(stratum=0), None),  # kiss of death
    (answer(stratum=16), None),
    (answer(seconds=0), None),
)


def test_answers() -> None:
    for data, ms in ANSWERS:
        assert epoch_ms(data, NONCE) == ms, data


def test_before_any_answer_it_counts_from_the_start() -> None:
    wall = WallClock(500)
    assert wall.read(500) == 0
    assert wall.read(750) == 250


def test_ticks_may_wrap_as_often_as_they_like() -> None:
    wall = WallClock(LAST - 1000)
    wall.set(1700000000000, LAST - 1000)
    now, day = LAST - 1000, 86400000
    for days in range(1, 40):
        now = add(now, day)
        assert wall.read(now) == 1700000000000 + days * day
