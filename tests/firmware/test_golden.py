"""The lines of Goob's and Fred's boards, byte for byte, and what the host reads out of them.

A golden file is a transcript: milliseconds since the firmware was loaded, a sign, and what happened.
``=`` volts at a pin, or high or low; ``>`` a line from the host; ``<`` a line from the board; ``!`` what the motors do
from then on, left and right, + = forward; ``*`` how often the line before comes again, each 20 ms later; ``.`` the end.
What the world did is played again, and all of it must come out as it stands there. ``python -m
tests.firmware.test_golden`` writes the files anew.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from pebble.extensions.lab.simulation.bodies import body_of
from pebble.extensions.lab.simulation.micropython.board import Board
from pebble.extensions.lab.simulation.micropython.clock import VirtualClock
from pebble.services.serial_mcu_bridge.text.goob_base import Charging, Level, Touch, parse

pytestmark = pytest.mark.computing

GOLDEN = Path(__file__).parent / "golden"
ROBOTS = ("goob", "fred")
_ADC_V = 1.65  # at 65535
_REPORT_MS = 20  # between two of Goob's reports
_BATTERY_V = 9.9  # where its pin has 1.65 V: goob/pins.py


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
        transcript += [Entry(now, "<", line.decode()) for line in board.take_output().split(b"\r\n")[:-1]]
    return transcript


def act(board: Board, entry: Entry) -> None:
    if entry.sign == "=":
        wire(board, entry.what)
    elif entry.sign == ">":
        board.type(entry.what.encode() + b"\n")


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


def reports(robot: str, start: str) -> Iterator[tuple[dict[str, str], str, list[Any]]]:
    """Each line of the board that begins so: the world then, the line, and what the host reads of it."""
    world: dict[str, str] = {}
    for entry in entries(robot):
        if entry.sign == "=":
            world.update([entry.what.split()])
        if entry.sign == "<" and entry.what.startswith(start):
            yield world, entry.what, list(parse(entry.what.encode() + b"\r\n"))


@pytest.mark.parametrize(
    ("robot", "names", "pins"), [("goob", "a0 a1 a2", "PA02 PB09 PA11"), ("fred", "t0 t1 t2", "PA02 PB08 PB09")]
)
def test_the_host_reads_the_sensors_that_there_are(robot: str, names: str, pins: str) -> None:
    compared = 0
    for world, line, read in reports(robot, "T "):
        wanted = [round(float(world[pin]) / _ADC_V * 65535) >> 6 for pin in pins.split()]
        assert line.startswith("T " + " ".join(map("{}={}".format, names.split(), wanted)))
        assert read[0] == Touch(*wanted)
        compared += 1
    assert compared > 5


def test_the_host_reads_goobs_battery_and_freds_charger() -> None:
    batteries = [(float(world["PB08"]), *read) for world, _, read in reports("goob", "C ")]
    assert [charging for _, charging, _ in batteries] == [Charging(None)] * 3
    for volts, _, level in batteries:
        assert level == Level(pytest.approx(volts / _ADC_V * _BATTERY_V, abs=0.0015))
    chargers = [(Charging(world["PA07"] == "high"), read[1]) for world, _, read in reports("fred", "T ")]
    assert all(wanted == read for wanted, read in chargers)
    assert {wanted.value for wanted, _ in chargers} == {True, False}


def main() -> None:
    for robot in ROBOTS:
        script = [entry for entry in entries(robot) if entry.sign in "=>."]
        (GOLDEN / f"{robot}.txt").write_text(text(play(robot, script)))


if __name__ == "__main__":
    sys.exit(main())
