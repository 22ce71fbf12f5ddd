"""Runs of scripts have numbers that only grow, and no end: whatever a stranger sends, the next run moves."""

from __future__ import annotations

import fcntl
import operator
import random
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest

from pebble.contract.payloads import LAST_RUN
from pebble.errors import PebbleError
from pebble.extensions.scripts import runs
from pebble.extensions.scripts.runs import _next
from pebble.motion.arbiter import PERSON, REFUSED, Arbiter
from pebble.motion.latch import Latch
from pebble.motion.lease import Lease
from tests.support import ROOT

NOW = 1_790_000_000.0  # September 2026
TAKE = """
import sys; from pathlib import Path; from pebble.extensions.scripts.runs import _next
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


@pytest.mark.parametrize("damage", [b"\0" * 11, b"12", b"-000000012"])
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


def test_after_the_last_number_comes_1(tmp_path: Path) -> None:
    path = tmp_path / "autonomy-run.json"
    path.write_text(f"{LAST_RUN - 1}\n")
    assert [_next(path, 0, clock) for _ in range(3)] == [LAST_RUN, 1, 2]


def test_a_file_that_stays_locked_is_an_error_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else who stops a script would wait for a process that is frozen."""
    monkeypatch.setattr(runs, "_LOCKED_S", 0.05)
    path = tmp_path / "autonomy-run.json"
    with path.open("w") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        with pytest.raises(PebbleError, match=r"autonomy-run\.json"):
            _next(path, 0, clock)
    assert _next(path, 0, clock) > 0


HALF = 1 << 29
#: Numbers that a stranger sends one after the other, as seen from the run that drives (0) or from none yet.
HOSTILE = [
    *([one] for one in (1, 2, HALF - 2, HALF - 1, HALF, HALF + 1, LAST_RUN - 1, LAST_RUN)),
    *([HALF - 1, 1], [HALF - 1, LAST_RUN], [1, HALF, LAST_RUN], [LAST_RUN, HALF, 1], [HALF - 2, LAST_RUN - 2, HALF]),
    *([HALF - 1, LAST_RUN - 1, HALF - 2, LAST_RUN - 2], [1, HALF - 1, HALF + 1], [HALF - 3, HALF + 3, LAST_RUN - 3]),
    [random.Random(7).randint(1, LAST_RUN) for _ in range(2000)],
]


class Owner:
    """A motor owner, after the first seconds in which it refuses scripts; ``barred`` is from an earlier life."""

    def __init__(self, barred: int = 0) -> None:
        self.arbiter = Arbiter(Latch("00c0ffee", 8, operator.sub), Lease(0, operator.sub, str, 0), 0, operator.sub, 750)
        self.arbiter.bar(barred)

    def moves(self, run: int) -> bool:
        return bool(self.arbiter.judge(True, run, -1, 5000) > 0)

    def end(self) -> None:
        """A person ends the run that moves, and the hold is over."""
        self.arbiter.judge(False, PERSON, 0, 5000)
        self.arbiter.tick(7000)


@pytest.mark.parametrize("restarted", ["", "manager", "owner"])
@pytest.mark.parametrize("first", [0, 54_000_000, HALF, LAST_RUN])
def test_whatever_a_stranger_has_sent_the_next_run_moves_and_no_earlier_one(
    tmp_path: Path, restarted: str, first: int
) -> None:
    path = tmp_path / "autonomy-run.json"
    for numbers, zero, during in product(HOSTILE, (False, True), (False, True)):
        path.write_text(f"{first:010d}\n")
        owner, own = Owner(), _next(path, 0, clock)
        if during:
            assert owner.moves(own)
        for number in numbers:
            owner.arbiter.judge(not zero, (own + number) & LAST_RUN or LAST_RUN, -1, 5000)
        received = numbers[-1] if restarted != "manager" else 0
        if restarted == "owner":
            owner = Owner(owner.arbiter.barred)
        following = _next(path, owner.arbiter.barred, clock, received)
        assert owner.moves(following)
        if during and len(numbers) < 3:  # with three a stranger may have gone round all numbers
            assert owner.arbiter.judge(True, own, -1, 5000) == REFUSED
        owner.end()
        assert not owner.moves(following), "a person's zero ends it, whatever came before"
        assert owner.moves(_next(path, owner.arbiter.barred, clock, following))
