"""Lines of a program: bounded in length and number, none left out goes unmentioned, and its last words are kept."""

from __future__ import annotations

import re

import pytest

from pebble.runtime.bounded_output import KEPT, BoundedOutput

LONGEST, RATE = 3500, 10.0  # 20 at once
_own = re.compile(rb"\d\d:\d\d:\d\d \[(WARNING|INFO)\] (.*)").fullmatch


class Log(BoundedOutput):
    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.said: list[str] = []
        super().__init__(self._take, LONGEST, 0.0, rate=RATE)

    def _take(self, line: bytes) -> None:
        own = _own(line)
        if own:
            self.said.append(own[2].decode())
        else:
            self.lines.append(line)


@pytest.fixture
def log() -> Log:
    return Log()


def numbers(count: int, begin: int = 0) -> bytes:
    return b"".join(b"line %d\n" % number for number in range(begin, begin + count))


def left_out(count: int) -> str:
    return f"{count} lines are left out: 10 a second are logged"


def test_chunks_become_lines_and_long_ones_are_cut(log: Log) -> None:
    for chunk in (b"one\r\ntw", b"o\n\n  \nth", b"ree\n", b"x" * 1_000_000 + b"\nnext"):
        log.feed(chunk, 0.0)
    log.end()
    assert log.lines == [b"one", b"two", b"three", b"x" * LONGEST, b"next"]
    assert log.said == []


def test_a_flood_is_cut_and_counted_and_its_last_words_are_kept(log: Log) -> None:
    log.feed(numbers(500), 0.1)
    assert (len(log.lines), log.flooded, log.said) == (20, True, [])
    log.feed(numbers(9_500, 500), 0.2)  # of which most is counted only
    log.tick(0.5)
    assert log.said == []
    log.tick(1.2)
    assert log.said == [left_out(10_000 - 20 - KEPT)]
    assert log.lines[-2:] == [b"line 9998", b"line 9999"]
    log.feed(b"after\n", 3.0)
    assert (log.lines[-1], log.flooded, log.waits) == (b"after", False, False)


@pytest.mark.parametrize("at", [0.2, 7.0], ids=["at once", "after a report of a flood that goes on"])
def test_the_last_words_of_a_program_that_ends_are_kept(log: Log, at: float) -> None:
    log.feed(numbers(100), 0.1)
    log.feed(numbers(900, 100), at)
    log.tick(at + 0.1)
    log.feed(b"fatal: no encoder", at + 0.1)
    log.end()
    assert log.lines[-1] == b"fatal: no encoder"
    missing = sum(int(said.split()[0]) for said in log.said)
    assert missing + len(log.lines) == 1_001


def test_repeated_lines_are_one_line_and_a_number_whatever_their_clocks_say(log: Log) -> None:
    log.feed(b"10:00:00 [ERROR] slow\n10:00:00 [ERROR] slow\n10:00:01 [ERROR] slow\nother\n", 0.0)
    log.feed(b"other\n", 2.0)  # no repetition after so long
    assert log.lines == [b"10:00:00 [ERROR] slow", b"other", b"other"]
    assert log.said == ["the line before came 2 more times"]
