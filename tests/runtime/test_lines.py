"""Splitting a stream into lines."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from pebble.runtime.lines import LineSplitter


@settings(max_examples=200)
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


def test_a_line_without_end_costs_no_memory_and_is_counted() -> None:
    splitter = LineSplitter(10)
    assert splitter.feed(b"good\n" + b"x" * 8) == [b"good"]
    for _ in range(1000):
        assert splitter.feed(b"x" * 8) == []
    assert splitter.feed(b"end\nT a0=1\n") == [b"T a0=1"]
    assert splitter.discarded_lines == 1


def test_a_long_line_within_one_chunk_takes_only_itself_along() -> None:
    splitter = LineSplitter(10)
    assert splitter.feed(b"a\n" + b"x" * 11 + b"\nb\n") == [b"a", b"b"]
    assert splitter.discarded_lines == 1


def test_a_reset_forgets_half_a_line() -> None:
    splitter = LineSplitter()
    splitter.feed(b"C chg=1 v=")
    splitter.reset()
    assert splitter.feed(b"7.4\n") == [b"7.4"]


def test_lines_arrive_in_pieces_and_the_unfinished_one_at_the_end() -> None:
    splitter = LineSplitter()
    assert splitter.feed(b"one\ntw") == [b"one"]
    assert splitter.feed(b"o\r\n\n  three  \nfo") == [b"two\r", b"", b"  three  "]
    assert splitter.rest() == b"fo"
    assert splitter.rest() == b""


def test_a_truncated_line_is_returned_once_and_its_rest_is_discarded() -> None:
    splitter = LineSplitter(100, truncate=True)
    assert [line for _ in range(100) for line in splitter.feed(b"x" * 10)] == [b"x" * 100]
    assert splitter.feed(b"xx\nnext\n") == [b"next"]
    assert splitter.feed(b"y" * 200 + b"\nnext\n") == [b"y" * 100, b"next"]


def test_exactly_the_limit_is_not_too_long() -> None:
    splitter = LineSplitter(100, truncate=True)
    assert splitter.feed(b"x" * 100) == []
    assert splitter.feed(b"\nnext\n") == [b"x" * 100, b"next"]
    assert splitter.discarded_lines == 0
