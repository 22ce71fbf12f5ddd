"""A stream becomes lines: bounded in length and number, none left out goes unmentioned, and last words are kept."""

from __future__ import annotations

import random
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pebble.runtime.bounded_output import KEPT, BoundedOutput
from pebble.runtime.lines import LineSplitter


@given(st.lists(st.binary(max_size=20).filter(lambda line: b"\n" not in line)), st.randoms(use_true_random=False))
def test_lines_come_out_however_the_stream_is_cut(lines: list[bytes], cuts: random.Random) -> None:
    stream = b"".join(line + b"\n" for line in lines)
    splitter, out = LineSplitter(20), list[bytes]()
    while stream:
        size = cuts.randint(1, 30)
        out += splitter.feed(stream[:size])
        stream = stream[size:]
    assert out == lines
    assert splitter.discarded_lines == 0


def test_half_a_line_is_the_rest_and_is_forgotten_by_a_reset() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"one\ntw") == [b"one"]
    assert (splitter.rest(), splitter.rest()) == (b"tw", b"")
    splitter.feed(b"C chg=1 v=")
    splitter.reset()
    assert splitter.feed(b"7.4\n") == [b"7.4"]


#: Whether long lines are truncated, what is fed to a splitter of 10 bytes, its lines, and how many it has discarded.
STREAMS: dict[str, tuple[bool, list[bytes], list[bytes], int]] = {
    "in pieces": (False, [b"one\ntw", b"o\r\n\n  three  \n"], [b"one", b"two\r", b"", b"  three  "], 0),
    "exactly the limit": (True, [b"x" * 10, b"\nnext\n"], [b"x" * 10, b"next"], 0),
    "without end": (False, [b"good\n" + b"x" * 8, *[b"x" * 8] * 1000, b"end\nnext\n"], [b"good", b"next"], 1),
    "too long within a chunk": (False, [b"a\n" + b"x" * 11 + b"\nb\n"], [b"a", b"b"], 1),
    "without end, truncated": (True, [*[b"x" * 7] * 100, b"xx\nnext\n"], [b"x" * 10, b"next"], 1),
    "too long within a chunk, truncated": (True, [b"y" * 20 + b"\nnext\n"], [b"y" * 10, b"next"], 1),
}


@pytest.mark.parametrize(("truncate", "chunks", "lines", "discarded"), STREAMS.values(), ids=STREAMS)
def test_long_lines_cost_no_memory(truncate: bool, chunks: list[bytes], lines: list[bytes], discarded: int) -> None:
    splitter = LineSplitter(10, truncate=truncate)
    assert [line for chunk in chunks for line in splitter.feed(chunk)] == lines
    assert splitter.discarded_lines == discarded


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
