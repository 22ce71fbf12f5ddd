"""Cells from readings of robots."""

import pytest

from pebble.extensions.lab.bench.clients import encoding_of
from pebble.extensions.lab.bench.cost import ALL, CPU, IDLE, MEMORY, THREADS, cells_of
from pebble.extensions.lab.bench.results import Results
from pebble.extensions.lab.bench.rounds import add_round
from pebble.extensions.media.packets import Codec, Picture, PictureKind, Sound


def measured(*scales: float) -> Results:
    """One robot of three processes in each round."""
    results = Results(bench="cost")
    for scale in scales:
        each = {MEMORY: 10.0 * scale, CPU: 1.0 * scale, THREADS: 2.0}
        used = {name: dict.fromkeys(("launcher", "mqtt_bridge", "mosquitto"), value) for name, value in each.items()}
        add_round(results, cells_of("mqtt", IDLE, used))
    return results


def rounds_of(results: Results, measure: str, process: str = ALL) -> list[list[float]]:
    cell = results.find("mqtt", measure, phase=IDLE, process=process)
    assert cell is not None
    return cell.rounds


def test_each_round_is_one_figure_of_one_robot_and_the_sum_is_over_its_processes() -> None:
    results = measured(1.0, 1.1)
    assert rounds_of(results, MEMORY, "launcher") == [[10.0], [11.0]]
    assert rounds_of(results, MEMORY) == [[30.0], [pytest.approx(33.0)]]
    assert rounds_of(results, THREADS) == [[6], [6]]


def test_encodings_are_distinguished() -> None:
    pcm = Sound(Codec.PCM16LE, 1, 16_000, 320, 1, 0, b"\0" * 640).pack()
    opus = Sound(Codec.OPUS, 1, 16_000, 320, 1, 0, b"\0").pack()
    h264, jpeg = (Picture(kind, 0, 0, b"").pack() for kind in (PictureKind.H264, PictureKind.JPEG))
    assert [encoding_of(raw) for raw in (pcm, opus, h264, jpeg, b'{"a": 1}')] == ["pcm", "opus", "h264", "pbvd", "json"]
