"""The lines of Goob's and Fred's boards, byte for byte.

A golden file is a transcript: milliseconds since the firmware was loaded, a sign, and what happened.
``=`` volts at a pin, or high or low; ``>`` a line from the host; ``<`` a line from the board; ``!`` what the motors do
from then on, left and right, + = forward; ``*`` how often the line before comes again, each 20 ms later; ``.`` the end.
What the world did is played again, and all of it must come out as it stands there. ``python -m
tests.firmware.test_golden`` writes the files anew.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock

pytestmark = pytest.mark.computing

GOLDEN = Path(__file__).parent / "golden"
ROBOTS = ("goob", "fred")
_REPORT_MS = 20  # between two of Goob's reports


@dataclass(frozen=True)
class Entry:
    ms: int
    sign: str
    what: str

    def __str__(self) -> str:
        return f"{self.ms:5d} {self.sign} {self.what}".rstrip()


def entries(robot: str) -> list[Entry]:
    found: list[Entry] = []
    for line in (GOLDEN / f"{robot}.txt").read_text().splitlines():
        entry = Entry(int(line[:5]), line[6], line[8:])
        more = range(found[-1].ms + _REPORT_MS, entry.ms + 1, _REPORT_MS) if entry.sign == "*" else ()
        found += [replace(found[-1], ms=ms) for ms in more] or [entry]
    return found


def play(robot: str, script: list[Entry]) -> list[Entry]:
    """Everything that happens, if that is what the world does. The board has a turn every millisecond."""
    transcript: list[Entry] = []
    clock = VirtualClock()
    board = Board(clock)
    body = body_of(robot, board)
    body.on_motors = lambda now, motors: transcript.append(
        Entry(round(now * 1000), "!", f"{motors[0]:.3f} {motors[1]:.3f}")
    )
    for entry in script:
        if entry.ms == 0 and entry.sign == "=":
            wire(board, entry.what)  # before it is switched on
    firmware = board.load(robot, {})
    due: dict[int, list[Entry]] = defaultdict(list)
    for entry in script:
        due[entry.ms].append(entry)
    for now in range(script[-1].ms + 1):
        clock.until(now / 1000)
        for entry in due[now]:
            transcript.append(entry)
            act(board, entry)
        firmware.step()
        body.end_turn()
        transcript += [Entry(now, "<", line.decode()) for line in board.console.take_output().split(b"\r\n")[:-1]]
    return transcript


def act(board: Board, entry: Entry) -> None:
    if entry.sign == "=":
        wire(board, entry.what)
    elif entry.sign == ">":
        board.console.type(entry.what.encode() + b"\n")


def wire(board: Board, what: str) -> None:
    pin, value = what.split()
    if value in ("high", "low"):
        board.set_pin(pin, value == "high")
    else:
        board.set_volts(pin, float(value))


def text(transcript: list[Entry]) -> str:
    lines: list[Entry] = []
    for before, entry in pairwise([Entry(0, "", ""), *transcript]):
        if entry == replace(before, ms=before.ms + _REPORT_MS):
            times = int(lines.pop().what) if lines[-1].sign == "*" else 0
            entry = Entry(entry.ms, "*", str(times + 1))
        lines.append(entry)
    return "".join(f"{entry}\n" for entry in lines)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_boards_output_is_exactly_this(robot: str) -> None:
    script = [entry for entry in entries(robot) if entry.sign in "=>."]
    assert text(play(robot, script)) == (GOLDEN / f"{robot}.txt").read_text()


def main() -> None:
    for robot in ROBOTS:
        script = [entry for entry in entries(robot) if entry.sign in "=>."]
        (GOLDEN / f"{robot}.txt").write_text(text(play(robot, script)))


if __name__ == "__main__":
    sys.exit(main())
