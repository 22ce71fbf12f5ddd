"""Lines of a script: bounded in length and number, and none of those dropped goes unmentioned."""

from __future__ import annotations

import pytest

from pebble.services.autonomy_manager.output import LINES_PER_S, LONGEST_LINE, Output


class Log:
    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.warnings: list[str] = []
        self.output = Output(self.lines.append, self.warnings.append, now=0.0)


@pytest.fixture
def log() -> Log:
    return Log()


def test_chunks_become_lines_and_long_ones_are_cut(log: Log) -> None:
    for chunk in (b"one\r\ntw", b"o\n\n  \nth", b"ree\n", b"x" * 1_000_000 + b"\nnext"):
        log.output.feed(chunk, 0.0)
    log.output.end()
    assert log.lines == [b"one", b"two", b"three", b"x" * LONGEST_LINE, b"next"]
    assert log.warnings == []


def test_a_flood_is_cut_and_counted_and_ends_with_its_second(log: Log) -> None:
    log.output.feed(b"y\n" * 10_000, 0.1)
    log.output.feed(b"y\n" * 5_000 + b"half", 0.2)
    assert len(log.lines) == LINES_PER_S
    assert log.output.flooded
    assert log.warnings == []
    log.output.feed(b" a line\nafter\n", 1.0)
    assert log.warnings == [f"{15_000 - LINES_PER_S} lines dropped: only {LINES_PER_S} lines per second are logged"]
    assert log.lines[LINES_PER_S:] == [b"half a line", b"after"]


def test_a_flood_is_reported_when_the_script_falls_silent_or_ends(log: Log) -> None:
    log.output.feed(b"y\n" * 201, 0.0)
    log.output.tick(1.5)
    log.output.feed(b"y\n" * 203, 1.6)
    log.output.end()
    assert [warning.split()[0] for warning in log.warnings] == ["1", "3"]
