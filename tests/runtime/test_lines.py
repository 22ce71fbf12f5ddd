"""Splitting a stream into lines."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

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
