"""What counts of synthetic recordings."""

from __future__ import annotations

import math

import pytest

from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.impair.metrics import Arrival, Command, Heard, Report, Seen, Window, value_of
from pebble.extensions.lab.simulation.trace import Entry

S, MS = 1_000_000_000, 1_000_000
WINDOW = Window(10 * S, 20 * S)


def packet(number: int, late_ms: float = 50, at_ms: float | None = None) -> Arrival:
    """Packet ``number`` of the window, 40 ms long."""
    captured = 10 * S + round((40 * number if at_ms is None else at_ms) * MS)
    return Arrival(captured, captured + round(late_ms * MS), 0.04, number)


def line(ns: int, left: float, right: float) -> Entry:
    return Entry(ns, "line", f"M {left:.3f} {right:.3f}")


@pytest.mark.parametrize(
    ("sounds", "percent", "in_time"),
    [
        ([packet(number) for number in range(-5, 300)], 100, 100),
        ([packet(number, late_ms=1500 if number % 2 else 50) for number in range(250)], 100, 50),
        ([packet(number) for number in range(0, 250, 4)], 25.2, 25.2),
        ([], 0, 0),
        ([packet(1), packet(1), packet(2)], 0.8, 0.8),  # one came twice
        ([packet(1, at_ms=-30), packet(2, at_ms=9990)], 0.2, 0.2),  # at the edges, a part of each counts
        ([packet(3, at_ms=-40), packet(4, at_ms=10_000)], 0, 0),
    ],
)
def test_sound_of_the_window(sounds: list[Arrival], percent: float, in_time: float) -> None:
    heard = metrics.heard(sounds, WINDOW)
    assert (heard.delivered_percent, heard.on_time_percent) == pytest.approx((percent, in_time))


@pytest.mark.parametrize(
    ("at_s", "fps", "frozen_s"),
    [([9, 12, 12.5, 13, 21], 0.3, 9), ([], 0, 10), ([10 + n / 10 for n in range(100)], 10, 0)],
)
def test_pictures_of_the_window_stand_still_from_edge_to_edge(at_s: list[float], fps: float, frozen_s: float) -> None:
    seen = metrics.seen([Arrival(0, round(s * S)) for s in at_s], WINDOW)
    assert (seen.fps, seen.frozen_s) == pytest.approx((fps, frozen_s))


COMMANDS = [Command(round(0.2 + number / 1000, 3), 0.3, (10 + number) * S) for number in range(5)]


@pytest.mark.parametrize(
    ("entries", "took_ms"),
    [
        ([line(10 * S + 5 * MS, 0.2, 0.3), line(11 * S + 9 * MS, 0.2, 0.3)], [5]),  # to the first one
        ([line(10 * S + 5 * MS, 0.2, 0.3), line(13 * S + 7 * MS, 0.203, 0.3)], [5, 2007, 1007, 7]),  # overtaken
    ],
)
def test_latency_is_to_the_line_that_sets_the_wheels_or_overtakes(entries: list[Entry], took_ms: list[float]) -> None:
    assert metrics.driven_ms(COMMANDS, entries) == took_ms


@pytest.mark.parametrize(("reached", "p95_ms"), [(slice(None), 0), (slice(None, None, 4), 3000), (slice(1), math.inf)])
def test_the_cells_of_a_trial(reached: slice, p95_ms: float) -> None:
    report = Report(commands=COMMANDS, heard=Heard([50.0], 99.0, 98.0), seen=Seen([70.0], 15.0, 0.5))
    entries = [line(command.sent_ns, command.left, command.right) for command in COMMANDS[reached]]
    *others, drive = metrics.cells_of("zenoh h264 opus", "256k", report, entries)
    assert [cell.samples for cell in others] == [[99.0], [98.0], [50.0], [15.0], [0.5], [70.0]]
    assert value_of(drive, 95) == p95_ms
