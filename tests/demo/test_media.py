"""What the demo's ears take for one stretch of sound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from pebble.demo.media import Watched
from pebble.media.sound import Heard
from pebble.transports import create
from pebble.transports.memory import MemoryHub

RATE, CHUNK = 16_000, 320  # 20 ms


@pytest.fixture
def watched() -> Iterator[Watched]:
    with create("memory", "ears", MemoryHub()) as transport:
        yield Watched(transport, "pebble/robots/goob")


def chunk(sequence: int, captured_ms: int, encoding: str = "pcm") -> Heard:
    samples = np.full((CHUNK, 1), sequence, np.int16)
    return Heard(samples, RATE, 1, captured_ms, sequence, encoding)


def test_what_follows_is_one_stretch(watched: Watched) -> None:
    for number in range(10):
        watched.on_sound(chunk(number, 20 * number + number % 2))  # stamps are whole milliseconds
    assert len(watched.take_heard("pcm")) == 10 * CHUNK
    assert len(watched.take_heard("pcm")) == 0


@pytest.mark.parametrize(
    ("sequence", "late_ms"), [(1, 0), (0, 40)], ids=["a packet is missing", "the microphone missed"]
)
def test_after_a_gap_another_one_begins(watched: Watched, sequence: int, late_ms: int) -> None:
    for number in range(10):
        gone = number >= 4
        watched.on_sound(chunk(number + sequence * gone, 20 * number + late_ms * gone))
    heard = watched.take_heard("pcm")
    assert len(heard) == 6 * CHUNK
    assert heard[0] == 4 + sequence


def test_each_encoding_is_for_itself(watched: Watched) -> None:
    for number in range(4):
        watched.on_sound(chunk(number, 20 * number, "pcm" if number < 3 else "opus"))
    assert len(watched.take_heard("pcm")) == 3 * CHUNK
