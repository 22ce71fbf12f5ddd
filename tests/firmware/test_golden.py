"""The lines of Goob's and Fred's boards, byte for byte.

A golden file is a transcript: milliseconds since the firmware was loaded, a sign, and what happened.
``=`` volts at a pin, or high or low; ``>`` a line from the host; ``<`` a line from the board; ``!`` what the motors do
from then on, left and right, + = forward; ``.`` the end. A report that says the same as the one before is left out.
What the world did is played again, and all of it must come out as it stands there.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import pytest

from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock

pytestmark = pytest.mark.computing

Entry = tuple[int, str, str]  # milliseconds, sign, what


def act(board: Board, sign: str, what: str) -> None:
    if sign == ">":
        board.console.type(what.encode() + b"\n")
    elif sign == "=":
        pin, value = what.split()
        if value in ("high", "low"):
            board.set_pin(pin, value == "high")
        else:
            board.set_volts(pin, float(value))


def play(robot: str, script: list[Entry]) -> list[Entry]:
    """Return everything that happens, if that is what the world does. The board has a turn every millisecond."""
    transcript: list[Entry] = []
    clock = VirtualClock()
    board = Board(clock)
    body = body_of(robot, board)
    body.on_motors = lambda now, motors: transcript.append((round(now * 1000), "!", f"{motors[0]:.3f} {motors[1]:.3f}"))
    due: defaultdict[int, list[Entry]] = defaultdict(list)
    for entry in script:
        due[entry[0]].append(entry)
        if entry[0] == 0:
            act(board, *entry[1:])  # before it is switched on
    firmware = board.load(robot, {})
    for now in range(script[-1][0] + 1):
        clock.until(now / 1000)
        for entry in due[now]:
            transcript.append(entry)
            act(board, *entry[1:])
        firmware.step()
        body.end_turn()
        transcript += [(now, "<", line.decode()) for line in board.console.take_output().split(b"\r\n")[:-1]]
    return transcript


@pytest.mark.parametrize(("robot", "period_ms"), [("goob", 20), ("fred", 500)])
def test_the_boards_output_is_exactly_this(robot: str, period_ms: int) -> None:
    golden = (Path(__file__).parent / "golden" / f"{robot}.txt").read_text()
    entries = [(int(line[:5]), line[6], line[8:]) for line in golden.splitlines()]
    transcript = play(robot, [entry for entry in entries if entry[1] in "=>."])
    reports = [entry for entry in transcript if entry[2].startswith("T ")]
    assert {later[0] - one[0] for one, later in pairwise(reports)} == {period_ms}
    for one, later in pairwise(reports):
        if one[2] == later[2]:
            transcript.remove(later)
    assert "".join(f"{ms:5d} {sign} {what}".rstrip() + "\n" for ms, sign, what in transcript) == golden
