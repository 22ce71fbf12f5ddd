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


def test_milliseconds() -> None:
    assert epoch_ms(answer(), NONCE) == 1700000000000
    assert epoch_ms(answer(fraction=1 << 31), NONCE) == 1700000000500
    assert epoch_ms(answer(fraction=(1 << 32) - 1), NONCE) == 1700000000999


def test_after_2036() -> None:
    assert epoch_ms(answer(seconds=1), NONCE) == 2085978497000


def test_what_is_no_answer() -> None:
    assert epoch_ms(b"", NONCE) is None
    assert epoch_ms(answer()[:47], NONCE) is None
    assert epoch_ms(answer(nonce=b"abcdefgX"), NONCE) is None
    assert epoch_ms(answer(first=0x23), NONCE) is None  # a client
    assert epoch_ms(answer(first=0xE4), NONCE) is None  # clock not set
    assert epoch_ms(answer(stratum=0), NONCE) is None  # kiss of death
    assert epoch_ms(answer(stratum=16), NONCE) is None
    assert epoch_ms(answer(seconds=0), NONCE) is None


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
