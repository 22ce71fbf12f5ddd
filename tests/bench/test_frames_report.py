"""Rounds become cells, cells become tables and an assessment."""

from collections.abc import Sequence
from typing import Any

import pytest

from pebble.bench.comparison import Case
from pebble.bench.engine import Collected
from pebble.bench.frames import FRAMES, VARIANTS, complete
from pebble.bench.results import Cell

HD, SMALL = "1920x1080", "64x48"
Measured = dict[str, Any]  # the samples and the single values of one round


def a_round(*latencies_us: float, **more: Any) -> Measured:
    figures = {"cpu_writer": 2.0, "cpu_reader": 1.0, "cpu_broker": None, "memory_writer_mb": 30.0}
    figures |= {"memory_reader_mb": 20.0, "torn": 0, "fallbacks": 0, "sent": len(latencies_us)}
    return {"measure": "frame", "unit": "us", "samples": latencies_us, **figures, **more}


FAILED: Measured = {"measure": "frame", "unit": "", "samples": []}


def cell_of(variant: str, rounds: Sequence[Measured], *, size: str = HD, readers: int = 1) -> Cell:
    collected, condition = Collected(FRAMES, [variant]), {"size": size, "readers": readers}
    for number, one in enumerate(rounds):
        case = Case(run=FRAMES.run_of(), number=number, variant=variant, role=variant, condition=condition)
        collected.add([case.cell(**one)])
    (cell,) = collected.cells()
    return cell


def eight_rounds(variant: str, latency_us: float, **more: Any) -> Cell:
    return cell_of(variant, [a_round(latency_us + number, **more) for number in range(8)])


def assessment(cells: Sequence[Cell]) -> list[str]:
    return [str(line) for line in FRAMES.report.assessed(cells)]


def test_every_round_keeps_its_place_and_its_samples() -> None:
    cell = cell_of("zenoh-shm", [a_round(1, 2), FAILED, a_round(30)], readers=3)
    assert (cell.variant, cell.params, cell.unit) == ("zenoh-shm", {"size": "1920x1080", "readers": 3}, "us")
    assert cell.rounds == [[1, 2], [], [30]]


def test_cpu_and_memory_are_medians_and_faults_are_counted() -> None:
    rounds = [
        a_round(1, cpu_writer=1.0, cpu_broker=7.0, torn=1),
        a_round(1, cpu_writer=9.0, fallbacks=2),
        a_round(1, cpu_writer=2.0, cpu_broker=9.0, torn=1),
    ]
    cell = cell_of("mqtt", rounds)
    names = ("cpu_writer", "cpu_broker", "memory_reader_mb", "torn", "fallbacks")
    assert [cell.figures[name] for name in names] == [2.0, 8.0, 20.0, 2, 2]


def test_each_reader_is_to_read_each_frame() -> None:
    cell = cell_of("mqtt", [a_round(1, 1, 1, 1, sent=6), a_round(sent=3)], readers=3)
    assert cell.lost == 5


def test_a_case_that_never_ran_is_there_and_empty() -> None:
    cell = cell_of("mqtt", [FAILED] * 8)
    assert (cell.samples, cell.figures, cell.lost) == ([], {}, None)
    [table] = FRAMES.report.shown([cell])
    assert table.row_count == 1
    assert assessment([eight_rounds("zenoh-shm", 5.0), cell])[0].endswith("nothing was measured")


def test_a_cell_has_the_name_of_its_role() -> None:
    cell = cell_of("mqtt again", [a_round(1)])
    assert cell.variant == "mqtt again"
    assert len(FRAMES.report.shown([cell])) == 1


def test_words_compare_like_with_like() -> None:
    cells = [
        eight_rounds("zenoh-shm", 500),
        eight_rounds("gstreamer-shm", 1000),
        eight_rounds("memcpy", 500),
        cell_of("gstreamer-shm", [a_round(1)] * 8, readers=3),
    ]
    against, memcpy = assessment(cells)
    assert against.startswith("1920x1080, one reader: zenoh-shm takes 0.50× the time of gstreamer-shm (")
    assert memcpy.startswith("1920x1080, one reader: zenoh-shm and memcpy are equal within noise: 1.00× the time (")


@pytest.mark.parametrize(("rounds", "expected"), [(7, "too few to judge"), (8, "equal within noise")])
def test_few_rounds_are_shown_and_not_judged(rounds: int, expected: str) -> None:
    cells = [cell_of(name, [a_round(5.0)] * rounds) for name in ("zenoh-shm", "mqtt")]
    [line] = assessment(cells)
    assert expected in line


@pytest.mark.parametrize(
    ("gone", "asked", "enough"), [(0, 8, True), (2, 10, True), (3, 10, False), (1, 2, True), (2, 2, False)]
)
def test_failed_rounds_are_reported_and_too_few_are_not_enough(gone: int, asked: int, enough: bool) -> None:
    cell = cell_of("mqtt", [FAILED] * gone + [a_round(1.0)] * (asked - gone))
    assert complete([cell]) == enough
    lines = [f"1920x1080, one reader, mqtt: {gone} rounds failed and are left out"]
    assert assessment([cell]) == (lines if gone else [])


def test_torn_frames_and_fallbacks_are_reported() -> None:
    cell = cell_of("zenoh-copy", [a_round(1, torn=2), a_round(1, fallbacks=5)], readers=3)
    assert assessment([cell]) == [
        "1920x1080, 3 readers, zenoh-copy: 2 frames arrived torn",
        "1920x1080, 3 readers, zenoh-copy: 5 frames could not go through shared memory",
    ]


def test_one_table_for_each_size_and_number_of_readers() -> None:
    cells = [
        cell_of(name, [a_round(1)], size=size, readers=count)
        for size in (SMALL, HD)
        for count in (1, 3)
        for name in VARIANTS
    ]
    tables = FRAMES.report.shown(cells)
    assert [table.title for table in tables] == [
        f"{size} BGR at 30 Hz, readers: {count}" for size in (SMALL, HD) for count in (1, 3)
    ]
    assert [table.row_count for table in tables] == [len(VARIANTS)] * 4
