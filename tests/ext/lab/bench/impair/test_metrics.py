"""Metrics and cells of synthetic recordings."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pebble.extensions.lab.bench.impair import metrics
from pebble.extensions.lab.bench.impair.metrics import (
    Arrival,
    Command,
    Heartbeat,
    Record,
    Sound,
    Trial,
    Window,
    with_lost,
)
from pebble.extensions.lab.bench.results import Cell
from pebble.extensions.lab.simulation.loudspeaker import Playback
from pebble.extensions.lab.simulation.trace import Entry, motors_entry

S, MS = 1_000_000_000, 1_000_000
WINDOW = Window(10 * S, 20 * S)


def packet(number: int, late_ms: float = 50, at_ms: float | None = None) -> Sound:
    """Packet ``number`` of the window, 40 ms long."""
    captured = 10 * S + round((40 * number if at_ms is None else at_ms) * MS)
    return Sound(captured, captured + round(late_ms * MS), 0.04, number)


def heartbeat(at_s: float, delay_ms: float = 20, *, online: bool = True) -> Heartbeat:
    return Heartbeat(round(at_s * S) - round(delay_ms * MS), round(at_s * S), online)


def line(ns: int, left: float, right: float) -> Entry:
    return Entry(ns, "line", f"M {left:.3f} {right:.3f}")


LATE = [packet(number, late_ms=1500 if number % 2 else 50) for number in range(250)]


@pytest.mark.parametrize(
    ("sounds", "within", "percent"),
    [
        ([packet(number) for number in range(-5, 300)], (), 100),
        (LATE, (), 100),
        (LATE, (1.0,), 50),
        ([packet(number) for number in range(0, 250, 4)], (), 25.2),
        ([], (), 0),
        ([packet(1), packet(1), packet(2)], (), 0.8),  # one came twice
        ([packet(1, at_ms=-30), packet(2, at_ms=9990)], (), 0.2),  # at the edges, a part of each counts
        ([packet(3, at_ms=-40), packet(4, at_ms=10_000)], (), 0),
    ],
)
def test_sound_of_the_window(sounds: list[Sound], within: tuple[float, ...], percent: float) -> None:
    assert metrics.sound_percent(sounds, WINDOW, *within) == pytest.approx(percent)


@pytest.mark.parametrize(("pictures", "gaps"), [([9 * S, 12 * S, 13 * S, 21 * S], [2, 1, 7]), ([], [10])])
def test_gaps_of_pictures_reach_from_edge_to_edge(pictures: list[int], gaps: list[float]) -> None:
    assert metrics.gaps_s(pictures, WINDOW) == gaps


UNTIL_12 = [heartbeat(8 + number / 4) for number in range(17)]


@pytest.mark.parametrize(
    ("heartbeats", "offline"),
    [
        ([heartbeat(8 + number / 4) for number in range(48)], []),
        (UNTIL_12 + [heartbeat(15 + number / 4) for number in range(20)], [2.5]),  # less two intervals
        (UNTIL_12, [7.5]),
        ([*UNTIL_12, heartbeat(12.1, online=False), *(heartbeat(12.6 + n / 4) for n in range(30))], [0.5]),
    ],
    ids=["steady", "silent for a while", "silent to the end", "an offline message"],
)
def test_when_a_robot_is_offline(heartbeats: list[Heartbeat], offline: list[float]) -> None:
    assert metrics.offline_s(heartbeats, WINDOW) == pytest.approx(offline, abs=0.02)


# -- driving

COMMANDS = [Command(0.2 + number / 1000, 0.3, (10 + number) * S) for number in range(5)]


@pytest.mark.parametrize(
    ("entries", "took_ms"),
    [
        ([line(10 * S + 5 * MS, 0.2, 0.3), line(11 * S + 9 * MS, 0.2, 0.3)], [5]),  # to the first one
        ([line(10 * S + 5 * MS, 0.2, 0.3), line(13 * S + 7 * MS, 0.203, 0.3)], [5, 2007, 1007, 7]),  # overtaken
    ],
)
def test_latency_is_to_the_line_that_sets_the_wheels_or_overtakes(entries: list[Entry], took_ms: list[float]) -> None:
    assert metrics.driven_ms(COMMANDS, entries) == list(zip(COMMANDS, took_ms, strict=False))


@pytest.mark.parametrize(
    ("commands", "entries", "trips"),
    [
        (COMMANDS, [line(10 * S, 0.2, 0.3), line(11 * S, 0, 0), line(11 * S + 1, 0, 0), line(12 * S, 0.202, 0.3)], 1),
        (COMMANDS, [line(9 * S, 0, 0), line(10 * S, 0.2, 0.3), line(15 * S, 0, 0)], 0),
        ([], [line(9 * S, 0, 0), line(10 * S, 0.2, 0.3), line(15 * S, 0, 0)], 0),
    ],
)
def test_stops_between_commands_are_trips(commands: list[Command], entries: list[Entry], trips: int) -> None:
    assert metrics.trips(commands, entries) == trips


def test_wheels_are_at_rest_before_the_first_command_comes_and_after_each_stop() -> None:
    moves = [motors_entry(round(s * S), (speed, speed)) for s, speed in ((9, 0), (10.5, 0.2), (12, 0), (13, 0.2))]
    assert metrics.rest_s(COMMANDS, [*moves, motors_entry(15 * S, (0, 0))]) == pytest.approx(1.5)
    assert metrics.rest_s(COMMANDS, []) == 4
    assert metrics.rest_s([], moves) == 0


# -- cells


def trial(
    subject: str = "zenoh h264 opus",
    name: str = "256k",
    late_ms: float = 50,
    reached: slice | None = None,
    **more: object,
) -> Trial:
    """A window of video, one of audio, and three seconds before them; everything arrives after ``late_ms``.

    ``reached``: those of the 200 commands that reach the MCU.
    """
    commands = [Command(round(0.1 + number / 1000, 3), 0.5, number * S // 10) for number in range(200)]
    late = round(late_ms * MS)
    record = {
        "commands": commands,
        "heartbeats": [heartbeat(number / 4) for number in range(80)],
        "pictures": [Arrival(ns, ns + late) for ns in range(3 * S, 10 * S - late, S // 10)],
        "sounds": [packet(number, late_ms) for number in range(250)],
        "windows": {
            "alone": Window(0, 3 * S),
            "video": Window(3 * S, 10 * S),
            "audio": WINDOW,
            "video off": Window(8 * S, 10 * S),
            "audio off": Window(18 * S, 20 * S),
        },
        "clip_ns": 20 * S,
    }
    reached = commands if reached is None else commands[reached]
    entries = [line(command.sent_ns + 10 * MS, command.left, command.right) for command in reached]
    entries += [motors_entry(command.sent_ns + 10 * MS, (command.left, command.right)) for command in reached[:1]]
    phases = ("alone", "video", "video off", "audio", "audio off")
    traffic = dict.fromkeys(phases, (1000, 126_000))
    played = [playback(0, late_ms), playback(20, 70)]
    return Trial(subject, name, Record(**{**record, **more}), entries, traffic, played)


def playback(at_s: int, late_ms: float) -> Playback:
    """It began ``late_ms`` after ``at_s``."""
    began_ns = at_s * S + round(late_ms * MS)
    return Playback("clip.wav", began_ns, began_ns + S // 2, 0.5, False, 16_000, 1, Path("clip.wav"), 1)


def of(measure: str, *trials: Trial) -> Cell:
    """The only cell of this measure."""
    (cell,) = (cell for cell in metrics.cells_of(trials) if cell.measure == measure)
    return cell


def figures(cell: Cell, *names: str) -> list[float]:
    return [cell.middle(name) for name in names]


def test_a_good_trial_has_all_its_cells() -> None:
    good = trial()
    cells = list(metrics.cells_of([good]))
    assert len({cell.measure for cell in cells}) == len(cells) == 10
    sound, video, drive = (of(measure, good) for measure in (metrics.SOUND, metrics.PICTURES, metrics.DRIVE))
    assert figures(sound, "delivered_percent", "on_time_percent") == pytest.approx([100, 100])
    assert sound.percentile(95) == 50
    assert figures(sound, "kbit_up") == [100]
    assert video.middle("fps") == pytest.approx(10, abs=0.2)
    assert video.middle("frozen_s") == 0
    assert of(metrics.HEARTBEAT_GAP, good).middle("longest_offline_s") == 0
    assert figures(drive, "sent", "delivered_percent", "trips") == [200, 100, 0]
    alone, video_, audio = (metrics.DRIVE_ALONE, metrics.DRIVE_VIDEO, metrics.DRIVE_AUDIO)
    assert [len(of(measure, good).samples) for measure in (alone, video_, audio)] == [30, 70, 100]


def test_what_is_sent_without_media_is_counted() -> None:
    quiet = trial(heartbeats=[heartbeat(number / 4) for number in range(77)])
    after = of(metrics.AFTER_VIDEO, quiet)
    assert figures(after, "heartbeats", "longest_gap_s", "bytes_up") == [8, 0.25, 125_000]
    assert figures(of(metrics.AFTER_AUDIO, quiet), "heartbeats", "longest_gap_s") == [5, 1.0]


def test_a_clip_is_timed_from_its_command_to_its_first_sample() -> None:
    clip, never = of(metrics.CLIP, trial()), of(metrics.CLIP, trial(clip_ns=21 * S))
    assert (clip.samples, clip.lost) == ([70], 0)
    assert (never.samples, never.lost) == ([], 1)
    assert math.isinf(with_lost(100)(never))


def test_a_trial_in_which_nothing_arrived_has_metrics_too() -> None:
    nothing = trial(pictures=[], sounds=[], heartbeats=[])
    assert of(metrics.SOUND, nothing).middle("delivered_percent") == 0
    assert math.isnan(of(metrics.SOUND, nothing).percentile(95))
    assert of(metrics.PICTURES, nothing).middle("frozen_s") == 7
    assert of(metrics.HEARTBEAT_GAP, nothing).middle("longest_gap_s") == 20


@pytest.mark.parametrize(
    ("reached", "delivered", "p95_ms"), [(slice(None, None, 10), 10, 910), (slice(100), 50, math.inf)]
)
def test_commands_that_were_overtaken_or_lost_count(reached: slice, delivered: float, p95_ms: float) -> None:
    drive = of(metrics.DRIVE, trial(reached=reached))
    assert drive.middle("delivered_percent") == delivered
    assert with_lost(95)(drive) == p95_ms


def test_wheels_that_nothing_reached_are_at_rest() -> None:
    assert of(metrics.DRIVE, trial(reached=slice(0))).middle("rest_s") == pytest.approx(19.9)
