"""Rounds become rows, rows become JSON, tables and ratios."""

import json
from typing import Any

from pebble.bench.frames_report import Round, as_json, legend, ratios, row_of, tables
from pebble.bench.frames_variants import VARIANTS, Case, Size

HD = Size(1920, 1080)


def a_round(*latencies_us: float, **more: Any) -> Round:
    figures: dict[str, Any] = {
        "sent": len(latencies_us),
        "torn": 0,
        "fallbacks": 0,
        "cpu_writer": 2.0,
        "cpu_reader": 1.0,
    }
    figures |= {"cpu_broker": None, "memory_writer_mb": 30.0, "memory_reader_mb": 20.0}
    return Round(latencies_us=latencies_us, **{**figures, **more})


def test_figures_are_medians_over_the_rounds_and_the_worst_of_all() -> None:
    row = row_of(Case("zenoh-shm", HD, 1), [a_round(1, 2, 3), a_round(10, 20, 30), a_round(4, 5, 600)])
    assert (row.n, row.p50_us, row.p99_us, row.max_us) == (9, 5, 30, 600)


def test_json_has_the_shape_that_others_read() -> None:
    row = row_of(Case("zenoh-shm", HD, 3), [a_round(100.04, 200, sent=1)])
    assert as_json([row]) == {
        "rows": [
            {
                "variant": "zenoh-shm",
                "params": {"size": "1920x1080", "readers": 3},
                "n": 2,
                "p50_us": 100.0,
                "p99_us": 200,
                "max_us": 200,
                "cpu_writer": 2.0,
                "cpu_reader": 1.0,
                "cpu_broker": None,
                "memory_writer_mb": 30.0,
                "memory_reader_mb": 20.0,
                "lost_percent": 33.33,
                "torn": 0,
                "fallbacks": 0,
                "rounds": 1,
            }
        ]
    }


def test_a_case_in_which_nothing_arrived_is_told_as_such() -> None:
    row = row_of(Case("mqtt", HD, 1), [a_round(sent=30)])
    said = json.loads(json.dumps(as_json([row])))["rows"][0]
    assert (said["n"], said["p50_us"], said["lost_percent"]) == (0, None, 100.0)


def test_rounds_in_which_something_arrived_are_not_spoiled_by_one_without() -> None:
    assert row_of(Case("mqtt", HD, 1), [a_round(sent=30), a_round(7.0)]).p50_us == 7.0


def test_ratios_compare_like_with_like() -> None:
    rows = [
        row_of(Case("zenoh-shm", HD, 1), [a_round(50, cpu_reader=0.5)]),
        row_of(Case("gstreamer-shm", HD, 1), [a_round(100)]),
        row_of(Case("gstreamer-shm", HD, 3), [a_round(1)]),
    ]
    assert ratios(rows) == ["zenoh-shm / gstreamer-shm, 1920x1080, readers: 1: p50 0.50, reader's CPU 0.50"]


def test_one_table_for_each_size_and_number_of_readers() -> None:
    small = Size(64, 48)
    rows = [row_of(Case(name, size, n), [a_round(1)]) for name in VARIANTS for size in (HD, small) for n in (3, 1)]
    titles = [str(table.title) for table in tables(rows)]
    assert titles == [f"{size} BGR at 30 Hz, {who}" for size in (small, HD) for who in ("one reader", "3 readers")]
    assert [table.row_count for table in tables(rows)] == [len(VARIANTS)] * 4


def test_every_variant_is_explained() -> None:
    assert len(legend(VARIANTS)) > len(VARIANTS)
