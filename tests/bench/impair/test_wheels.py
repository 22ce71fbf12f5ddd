"""What counts of an operator's record and the trace of a simulated MCU: rest for good, queues, and the scene."""

from __future__ import annotations

import math
from itertools import product

import pytest

from pebble.bench.impair.metrics import Command, Heartbeat
from pebble.bench.impair.thin import IMPAIR_THIN, TRIALS, chosen
from pebble.bench.impair.trials import IMPAIR
from pebble.bench.impair.wheels import (
    COMMAND,
    COMMANDED,
    CONFIRMED,
    HEARTBEAT,
    QUEUE,
    RELEASE,
    STOP,
    STOPPED,
    WHEELS,
    Driven,
    LinkSeen,
    WheelRecord,
    WheelTrial,
    cells_of,
    hand,
    longest_above_s,
    rest_ms,
)
from pebble.bench.results import Cell
from pebble.errors import PebbleError
from pebble.simulation.trace import Entry, motors_entry

MS = 1_000_000
S = 1000 * MS
ON, OFF = (0.5, 0.5), (0.0, 0.0)


@pytest.mark.parametrize(
    ("moves", "expected"),
    [
        ([], None),  # at rest, and it stays so
        ([(500, ON)], math.inf),  # it never stops
        ([(500, ON), (1200, OFF)], 200.0),
        ([(500, ON), (1200, OFF), (1500, ON), (1800, OFF)], 800.0),  # a late command moves it again
        ([(500, ON), (1200, OFF), (1500, ON)], math.inf),
        ([(1500, ON), (1800, OFF)], 800.0),  # it was at rest, and is moved by a late command
        ([(500, ON), (1200, (0.4, 0.4)), (1300, OFF), (3500, ON)], 300.0),  # the next gesture does not count
        ([(500, ON), (700, OFF)], None),
    ],
)
def test_wheels_are_at_rest_for_good(moves: list[tuple[int, tuple[float, float]]], expected: float | None) -> None:
    driven = Driven("release", 0, 1000 * MS, 3000 * MS)
    assert rest_ms([(ms * MS, motors) for ms, motors in moves], driven) == expected


def test_the_longest_time_with_a_long_queue() -> None:
    seen = [LinkSeen(at * S, "thin", queue) for at, queue in ((0, 600), (1, 700), (3, 100), (10, 501), (12, 900))]
    assert longest_above_s(seen, 20 * S) == 10
    assert longest_above_s(seen[:3], 20 * S) == 3
    assert longest_above_s([], 20 * S) == 0


def test_no_two_commands_of_a_hand_are_equal() -> None:
    assert len({hand(number, number / 20) for number in range(8000)}) == 8000
    assert all(min(hand(number, number / 20)) > 0 and max(hand(number, number / 20)) < 1 for number in range(8000))


def line(ms: int, wheels: tuple[float, float]) -> list[Entry]:
    return [Entry(ms * MS, "line", f"M {wheels[0]:.3f} {wheels[1]:.3f}"), motors_entry(ms * MS, wheels)]


def trial() -> WheelTrial:
    """Three gestures: the second command of the first one is lost, the stop is never confirmed."""
    sent = {ms: hand(number, 0) for number, ms in enumerate((0, 250, 500, 3000, 6000))}
    arrived = [(100, sent[0]), (600, sent[500]), (1300, OFF), (3100, sent[3000]), (3900, OFF), (6100, sent[6000])]
    record = WheelRecord(
        began_ns=0,
        ended_ns=10 * S,
        commands=[Command(*wheels, ms * MS) for ms, wheels in sent.items()],
        gestures=[
            Driven("release", 0, 1000 * MS, 2500 * MS),
            Driven("release", 3000 * MS, 3800 * MS, 5500 * MS),
            Driven("stop", 6000 * MS, 6500 * MS, 9000 * MS),
        ],
        heartbeats=[Heartbeat(at * S, at * S + 300 * MS) for at in (1, 2, 6, 9)],
        links=[LinkSeen(0, "wide", 0), LinkSeen(S, "thin", 800), LinkSeen(2 * S, "thin", 0)],
        takes=[],
        pictures=3,
        controlled=True,
    )
    entries = [entry for ms, wheels in arrived for entry in line(ms, wheels)]
    return WheelTrial(
        subject="thin", trial="thin-9.6k", record=record, entries=entries, ready_s=1.0, silences=2, scene=2
    )


def test_the_cells_of_a_trial() -> None:
    cells: dict[str, Cell] = {cell.measure: cell for cell in cells_of(trial())}
    command = cells[COMMAND]
    assert (command.samples, command.lost) == ([100.0, 350.0, 100.0], 0)  # the lost one was overtaken
    assert command.figures["delivered_percent"] == pytest.approx(66.667)
    assert command.figures["rest_percent"] == 10.0
    assert (cells[RELEASE].samples, cells[RELEASE].lost) == ([300.0, 100.0], 0)
    assert (cells[STOP].samples, cells[STOP].lost) == ([], 1)
    assert (cells[CONFIRMED].samples, cells[CONFIRMED].lost) == ([], 1)
    assert (cells[HEARTBEAT].figures["longest_gap_s"], cells[HEARTBEAT].figures["silences"]) == (4.0, 2)
    assert (cells[QUEUE].figures["level"], cells[QUEUE].figures["longest_s"]) == ("wide/thin", 1.0)
    assert cells[STOPPED].rounds == [[4.0], [0.0]]  # seconds of the scene, which is of the last two gestures
    assert {len(set(map(len, cells[one].rounds))) for one in (COMMANDED, WHEELS)} == {1}


@pytest.mark.parametrize(
    ("trials", "name"),
    [(["thin"], "impair-thin"), (["thin-9.6k", "thin-sim"], "impair-thin"), (["64k"], "impair"), (None, "impair")],
)
def test_thin_trials_are_a_comparison_of_their_own(trials: list[str] | None, name: str) -> None:
    assert IMPAIR.mode({"trials": trials}).name == name


def test_all_thin_trials_or_some() -> None:
    assert chosen(IMPAIR_THIN.run_of()) == [*TRIALS]
    assert chosen(IMPAIR_THIN.run_of(trials=["thin-sim"])) == ["thin-sim"]
    for mode, wrong in product((IMPAIR, IMPAIR_THIN), (["thin", "64k"], ["thin-5k"])):
        with pytest.raises(PebbleError, match="--trials: unknown"):
            mode.run_of(trials=wrong)
