"""Runs of scripts have numbers that only grow."""

from __future__ import annotations

import fcntl
import subprocess
import sys
from pathlib import Path

import pytest

from pebble.contract.payloads import LAST_RUN
from pebble.errors import PebbleError
from pebble.runtime import runs
from pebble.runtime.runs import _next
from tests.support import ROOT

NOW = 1_790_000_000.0  # September 2026
TAKE = """
import sys; from pathlib import Path; from pebble.runtime.runs import _next
for _ in range(50): print(_next(Path(sys.argv[1]), 0, lambda: 1_790_000_000.0))
"""


def clock() -> float:
    return NOW


def test_each_run_is_above_the_one_before_and_above_what_is_barred(tmp_path: Path) -> None:
    path = tmp_path / "state" / "autonomy-run.json"
    first = _next(path, 0, clock)
    assert first == NOW - 1_735_689_600 + 1
    assert _next(path, 0, clock) == first + 1
    assert _next(path, first + 100, clock) == first + 101
    assert _next(path, 5, lambda: 0.0) == first + 102  # the clock does not matter any more


def test_processes_that_start_at_once_get_different_numbers(tmp_path: Path) -> None:
    path = tmp_path / "autonomy-run.json"
    takers = [
        subprocess.Popen([sys.executable, "-c", TAKE, str(path)], stdout=subprocess.PIPE, text=True, cwd=ROOT)
        for _ in range(3)
    ]
    taken = [[int(line) for line in taker.communicate(timeout=60)[0].split()] for taker in takers]
    assert len({number for numbers in taken for number in numbers}) == 150
    assert all(numbers == sorted(numbers) for numbers in taken)


@pytest.mark.parametrize("damage", [b"\0" * 11, b"12", b"9" * 10, b"-000000012", b"x" * 5000])
def test_a_damaged_file_is_replaced_by_the_clock(
    tmp_path: Path, damage: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "autonomy-run.json"
    path.write_bytes(damage)
    assert _next(path, 0, clock) == NOW - 1_735_689_600 + 1
    assert "damaged" in caplog.text


@pytest.mark.parametrize(("wall", "expected"), [(0.0, 8), (9e9, 8), (1_735_689_605.0, 8), (1_735_689_700.0, 101)])
def test_a_wrong_clock_is_not_believed(tmp_path: Path, wall: float, expected: int) -> None:
    assert _next(tmp_path / "autonomy-run.json", 7, lambda: wall) == expected


def test_where_nothing_can_be_saved_the_clock_counts(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    assert _next(tmp_path / "state" / "autonomy-run.json", 0, clock) == NOW - 1_735_689_600 + 1
    assert "cannot be opened" in caplog.text


def test_after_the_last_number_in_the_file_the_clock_counts_again(tmp_path: Path) -> None:
    """Else one command of another program, with the last number, would end scripts for good."""
    path = tmp_path / "autonomy-run.json"
    assert _next(path, LAST_RUN - 1, clock) == LAST_RUN
    assert _next(path, 0, clock) == NOW - 1_735_689_600 + 1


def test_a_file_that_stays_locked_is_an_error_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else who stops a script would wait for a process that is frozen."""
    monkeypatch.setattr(runs, "_LOCKED_S", 0.05)
    path = tmp_path / "autonomy-run.json"
    with path.open("w") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        with pytest.raises(PebbleError, match=r"autonomy-run\.json"):
            _next(path, 0, clock)
    assert _next(path, 0, clock) > 0


def test_numbers_end(tmp_path: Path) -> None:
    with pytest.raises(PebbleError, match="run numbers end"):
        _next(tmp_path / "autonomy-run.json", LAST_RUN, clock)
