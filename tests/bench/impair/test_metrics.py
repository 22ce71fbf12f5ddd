"""Metrics, cells and assessments of synthetic recordings."""

from __future__ import annotations

import io
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from pebble.bench.impair import metrics
from pebble.bench.impair.metrics import Arrival, Command, Heartbeat, Record, Sound, Trial, Window, cells_of, over_time
from pebble.bench.impair.network import Traffic
from pebble.bench.impair.trials import IMPAIR, QUICK, SUBJECTS, ImpairedRobot, conditions, groups
from pebble.bench.results import Cell
from pebble.errors import PebbleError
from pebble.simulation.loudspeaker import Playback
from pebble.simulation.trace import Entry, motors_entry

S, MS = 1_000_000_000, 1_000_000
WINDOW = Window(10 * S, 20 * S)


def lines_of(cells: list[Cell]) -> list[str]:
    return [str(one) for one in IMPAIR.report.assessed(cells)]


def packet(number: int, late_ms: float = 50, at_ms: float | None = None) -> Sound:
    """Packet ``number`` of the window, 40 ms long."""
    captured = 10 * S + round((40 * number if at_ms is None else at_ms) * MS)
    return Sound(captured, captured + round(late_ms * MS), 0.04, number)


def heartbeat(at_s: float, delay_ms: float = 20, *, online: bool = True) -> Heartbeat:
    return Heartbeat(round(at_s * S) - round(delay_ms * MS), round(at_s * S), online)


def line(ns: int, left: float, right: float) -> Entry:
    return Entry(ns, "line", f"M {left:.3f} {right:.3f}")


# -- sound


def test_all_sound_of_the_window_is_a_hundred_per_cent() -> None:
    assert metrics.sound_percent(map(packet, range(-5, 300)), WINDOW) == pytest.approx(100)


def test_late_sound_is_delivered_and_not_on_time() -> None:
    sounds = [packet(number, late_ms=1500 if number % 2 else 50) for number in range(250)]
    assert metrics.sound_percent(sounds, WINDOW) == pytest.approx(100)
    assert metrics.sound_percent(sounds, WINDOW, 1.0) == pytest.approx(50)


def test_lost_sound_is_not_delivered() -> None:
    assert metrics.sound_percent(map(packet, range(0, 250, 4)), WINDOW) == pytest.approx(25, abs=0.5)
    assert metrics.sound_percent([], WINDOW) == 0


def test_a_packet_that_comes_twice_counts_once() -> None:
    assert metrics.sound_percent([packet(1), packet(1), packet(2)], WINDOW) == pytest.approx(0.8)


def test_packets_at_the_edges_count_for_their_part_in_the_window() -> None:
    edges = [packet(1, at_ms=-30), packet(2, at_ms=9990)]
    assert [metrics.overlap_s(sound, WINDOW) for sound in edges] == [pytest.approx(0.01), pytest.approx(0.01)]
    assert metrics.received([packet(3, at_ms=-40), packet(4, at_ms=10_000)], WINDOW) == []


def test_packets_sent_are_as_many_as_the_windows_sound_would_be() -> None:
    half = of(cells_of([trial(sounds=[packet(number) for number in range(0, 250, 2)])]), metrics.SOUND)
    assert (half.figures["sent"], half.lost) == (250, 125)
    nothing = of(cells_of([trial(sounds=[])]), metrics.SOUND)
    assert nothing.figures["sent"] is None


# -- pictures


def test_gaps_reach_from_edge_to_edge() -> None:
    assert metrics.gaps_s([9 * S, 12 * S, 13 * S, 21 * S], WINDOW) == [2, 1, 7]


def test_without_any_picture_the_window_is_one_gap() -> None:
    assert metrics.gaps_s([], WINDOW) == [10]


# -- heartbeats


def test_a_steady_heartbeat_is_never_offline() -> None:
    assert metrics.offline_s([heartbeat(8 + number / 4) for number in range(48)], WINDOW) == []


def test_silence_is_offline_after_the_operators_timeout() -> None:
    heartbeats = [heartbeat(8 + number / 4) for number in range(17)] + [
        heartbeat(15 + number / 4) for number in range(20)
    ]
    (spell,) = metrics.offline_s(heartbeats, WINDOW)  # from 12 to 15, less two intervals
    assert spell == pytest.approx(2.5, abs=0.02)


def test_silence_until_the_end_counts_until_the_end() -> None:
    (spell,) = metrics.offline_s([heartbeat(8 + number / 4) for number in range(17)], WINDOW)
    assert spell == pytest.approx(7.5, abs=0.02)


def test_an_offline_message_is_offline_at_once() -> None:
    heartbeats = [heartbeat(8 + number / 4) for number in range(17)]
    goodbye, back = heartbeat(12.1, online=False), [heartbeat(12.6 + number / 4) for number in range(30)]
    (spell,) = metrics.offline_s([*heartbeats, goodbye, *back], WINDOW)
    assert spell == pytest.approx(0.5, abs=0.02)


# -- driving

COMMANDS = [Command(0.2 + number / 1000, 0.3, (10 + number) * S) for number in range(5)]


def test_latency_is_to_the_first_line_that_sets_the_wheels() -> None:
    entries = [line(10 * S + 5 * MS, 0.2, 0.3), line(11 * S + 9 * MS, 0.2, 0.3)]
    assert metrics.driven_ms(COMMANDS, entries) == [(COMMANDS[0], 5)]


def test_an_overtaken_command_has_waited_for_the_one_that_overtook_it() -> None:
    entries = [line(10 * S + 5 * MS, 0.2, 0.3), line(13 * S + 7 * MS, 0.203, 0.3)]
    took = [(COMMANDS[0], 5), (COMMANDS[1], 2007), (COMMANDS[2], 1007), (COMMANDS[3], 7)]
    assert metrics.driven_ms(COMMANDS, entries) == took


def test_a_repeated_stop_between_commands_counts_once() -> None:
    entries = [line(10 * S, 0.2, 0.3), line(11 * S, 0, 0), line(11 * S + 1, 0, 0), line(12 * S, 0.202, 0.3)]
    assert metrics.trips(COMMANDS, entries) == 1


def test_the_stops_before_the_first_and_after_the_last_command_are_no_trips() -> None:
    entries = [line(9 * S, 0, 0), line(10 * S, 0.2, 0.3), line(15 * S, 0, 0)]
    assert metrics.trips(COMMANDS, entries) == 0
    assert metrics.trips([], entries) == 0


def test_wheels_are_at_rest_before_the_first_command_comes_and_after_each_stop() -> None:
    moves = [motors_entry(round(s * S), (speed, speed)) for s, speed in ((9, 0), (10.5, 0.2), (12, 0), (13, 0.2))]
    assert metrics.rest_s(COMMANDS, [*moves, motors_entry(15 * S, (0, 0))]) == pytest.approx(1.5)
    assert metrics.rest_s(COMMANDS, []) == 4
    assert metrics.rest_s([], moves) == 0


# -- cells, tables, assessment


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
    traffic = dict.fromkeys(phases, (Traffic(1000), Traffic(126_000, dropped_up=3)))
    played = [playback(0, late_ms), playback(20, 70)]
    return Trial(subject, name, Record(**{**record, **more}), entries, traffic, played)


def playback(at_s: int, late_ms: float) -> Playback:
    """It began ``late_ms`` after ``at_s``."""
    began_ns = at_s * S + round(late_ms * MS)
    return Playback("clip.wav", began_ns, began_ns + S // 2, 0.5, False, 16_000, 1, Path("clip.wav"), 1)


def of(found: list[Cell], measure: str) -> Cell:
    (cell,) = (cell for cell in found if cell.measure == measure)
    return cell


def test_a_good_trial_has_all_its_cells() -> None:
    found = cells_of([trial()])
    assert len({cell.measure for cell in found}) == len(found) == 12
    sound, video = of(found, metrics.SOUND), of(found, metrics.PICTURES)
    assert sound.figures["delivered_percent"] == sound.figures["on_time_percent"] == 100
    assert (sound.lost, sound.percentile(95), sound.figures["window_s"]) == (0, 50, 10)
    assert (sound.figures["kbit_up"], sound.figures["dropped_up"]) == (100, 3)
    assert video.figures["fps"] == pytest.approx(10, abs=0.2)
    assert (video.figures["frozen_s"], of(found, metrics.PICTURE_GAP).unit) == (0, "s")
    assert of(found, metrics.HEARTBEAT_GAP).figures["longest_offline_s"] == 0
    drive = of(found, metrics.DRIVE)
    assert (drive.figures["sent"], drive.figures["delivered_percent"], drive.figures["trips"]) == (200, 100, 0)
    assert [
        len(of(found, name).samples) for name in (metrics.DRIVE_ALONE, metrics.DRIVE_VIDEO, metrics.DRIVE_AUDIO)
    ] == [*(30, 70, 100)]


def test_what_is_sent_without_media_is_counted() -> None:
    found = cells_of([trial(heartbeats=[heartbeat(number / 4) for number in range(77)])])
    video, audio = of(found, metrics.AFTER_VIDEO), of(found, metrics.AFTER_AUDIO)
    assert (video.figures["heartbeats"], video.figures["longest_gap_s"], video.figures["bytes_up"]) == (
        8,
        0.25,
        125_000,
    )
    assert (audio.figures["heartbeats"], audio.figures["longest_gap_s"]) == (5, 1.0)


def test_a_clip_is_timed_from_its_command_to_its_first_sample() -> None:
    clip = of(cells_of([trial()]), metrics.CLIP)
    assert (clip.samples, clip.lost) == ([70], 0)
    never = trial(name="64k", clip_ns=21 * S)
    found = cells_of([trial(), never])
    (silent,) = (cell for cell in found if cell.measure == metrics.CLIP and cell.params["trial"] == "64k")
    assert (silent.samples, silent.lost) == ([], 1)


def test_a_trial_in_which_nothing_arrived_has_metrics_too() -> None:
    nothing = trial(pictures=[], sounds=[], heartbeats=[])
    found = cells_of([nothing])
    assert of(found, metrics.SOUND).figures["delivered_percent"] == 0
    assert math.isnan(of(found, metrics.SOUND).percentile(95))
    assert of(found, metrics.PICTURES).figures["frozen_s"] == 7
    assert of(found, metrics.HEARTBEAT_GAP).figures["longest_gap_s"] == 20
    assert any("nothing arrived" in sentence and "missed" in sentence for sentence in lines_of(found))


def test_series_over_time_are_ordered_and_begin_with_the_run() -> None:
    sound, drive = over_time([trial(), trial(name="64k+5%")], began_ns=-5 * S)
    assert (sound.measure, drive.measure) == (metrics.SOUND_OVER_TIME, metrics.DRIVE_OVER_TIME)
    times, latencies = sound.rounds
    assert len(times) == len(latencies) == 500
    assert times == sorted(times)
    assert times[0] == pytest.approx(15.05)


def test_the_aims_are_met_or_missed_by_so_much() -> None:
    good, bad = trial("mqtt h264 opus"), trial("zenoh h264 opus", late_ms=500)
    lines = lines_of(cells_of([good, bad]))
    aim, window = "h264 opus at 256k, sound p95 at most 400 ms", "window of 10 s"
    assert f"aim: mqtt {aim}: met (50.0 ms, {window})" in lines
    assert f"aim: zenoh {aim}: missed (500 ms, {window})" in lines
    assert not any("64k+5%" in sentence for sentence in lines)


def test_lost_messages_are_infinitely_late() -> None:
    few = lines_of(cells_of([trial(sounds=[packet(number) for number in range(250) if number % 50])]))
    many = lines_of(cells_of([trial(sounds=[packet(number) for number in range(250) if number % 10])]))
    aim = "aim: zenoh h264 opus at 256k, sound p95 at most 400 ms"
    assert f"{aim}: met (50.0 ms, 2.00 % lost, window of 10 s)" in few
    assert f"{aim}: missed (too much was lost, 10.0 % lost, window of 10 s)" in many


def test_commands_that_were_overtaken_or_lost_count_for_the_aim() -> None:
    cells = cells_of([trial(name="64k+5%", reached=slice(None, None, 10))])
    assert of(cells, metrics.DRIVE).figures["delivered_percent"] == 10
    lines = lines_of(cells + cells_of([trial("mqtt h264 opus", "64k+5%", reached=slice(100))]))
    aim = "h264 opus at 64k+5%, drive p95 at most 500 ms"
    assert f"aim: zenoh {aim}: missed (910 ms, 4.50 % lost, window of 20 s)" in lines
    assert f"aim: mqtt {aim}: missed (too much was lost, 50.0 % lost, window of 20 s)" in lines


def test_rest_times_show_a_robot_that_nothing_reached() -> None:
    (line,) = (line for line in lines_of(cells_of([trial(reached=slice(0))])) if line.startswith("Stops"))
    assert "zenoh h264 opus 0 (wheels at rest for 19.9 of 20.0 s)" in line


def test_transports_are_compared_where_both_were_tried() -> None:
    both = [trial(f"{kind} original", name, late_ms=50) for name in QUICK for kind in ("mqtt", "zenoh")]
    lines = lines_of(cells_of(both))
    assert any("original, sound p50 over 4 trials: zenoh / mqtt = 1.00" in sentence for sentence in lines)
    assert not any(sentence.startswith("aim:") for sentence in lines)
    assert not any("zenoh and mqtt" in sentence for sentence in lines_of(cells_of(both[::2])))


def test_the_tables_fit_a_terminal() -> None:
    tried = [trial(name, condition) for condition in ("wifi-power-save", "64k+5%") for name in SUBJECTS]
    console = Console(file=io.StringIO(), width=80)
    shown = IMPAIR.report.shown(cells_of(tried))
    assert len(shown) == 4
    for table in shown:
        assert console.measure(table).maximum <= 80
        assert table.row_count == 8


# -- options


@pytest.mark.parametrize(
    "given",
    [
        {"trials": ["512"]},
        {"variants": ["pigeon"]},
        {"variants": []},
        {"window_s": 0.1},
        {"window_s": math.nan},
    ],
)
def test_invalid_options_are_refused_before_anything_starts(given: dict[str, Any]) -> None:
    with pytest.raises(PebbleError):
        IMPAIR.run_of(**given)


def test_a_full_run_groups_transports_and_a_quick_one_all_subjects() -> None:
    full, quick = IMPAIR.run_of(), IMPAIR.run_of(quick=True)
    robots = [cast(ImpairedRobot, SimpleNamespace(subject=subject)) for subject in SUBJECTS]
    assert [[one.subject for one in group] for group in groups(full, robots)] == [
        SUBJECTS[:2],
        SUBJECTS[2:],
    ]
    assert [len(group) for group in groups(quick, robots)] == [4]
    assert tuple(condition.name for condition in conditions(quick)) == QUICK
    assert len(conditions(full)) == 16


def test_the_command_line_repeats_the_run() -> None:
    assert IMPAIR.run_of().command == ["pebble", "impair", "--window", "8"]
    run = IMPAIR.run_of(trials=["256k", "1%"], variants=[SUBJECTS[3]], quick=True)
    assert run.command == [
        *("pebble", "impair", "--trials", "256k,1%", "--subjects", "zenoh h264 opus"),
        *("--window", "4", "--quick"),
    ]
