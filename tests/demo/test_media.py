"""Which packets the demo joins to one stretch of sound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from pebble.demo.media import MediaRecorder
from pebble.media.sound import ReceivedSound
from pebble.transports import create
from pebble.transports.memory import MemoryHub

RATE, CHUNK = 16_000, 320  # 20 ms


@pytest.fixture
def recorder() -> Iterator[MediaRecorder]:
    with create("memory", "recorder", MemoryHub()) as transport:
        yield MediaRecorder(transport, "pebble/robots/goob")


def chunk(sequence: int, captured_ms: int, encoding: str = "pcm") -> ReceivedSound:
    samples = np.full((CHUNK, 1), sequence, np.int16)
    return ReceivedSound(samples, RATE, 1, captured_ms, sequence, encoding)


def test_what_follows_is_one_stretch(recorder: MediaRecorder) -> None:
    for number in range(10):
        recorder.on_sound(chunk(number, 20 * number + number % 2))  # stamps are whole milliseconds
    assert len(recorder.take_sound("pcm")) == 10 * CHUNK
    assert len(recorder.take_sound("pcm")) == 0


@pytest.mark.parametrize(
    ("sequence", "late_ms"), [(1, 0), (0, 40)], ids=["a packet is missing", "the microphone missed"]
)
def test_after_a_gap_another_one_begins(recorder: MediaRecorder, sequence: int, late_ms: int) -> None:
    for number in range(10):
        gone = number >= 4
        recorder.on_sound(chunk(number + sequence * gone, 20 * number + late_ms * gone))
    received = recorder.take_sound("pcm")
    assert len(received) == 6 * CHUNK
    assert received[0] == 4 + sequence


def test_each_encoding_is_for_itself(recorder: MediaRecorder) -> None:
    for number in range(4):
        recorder.on_sound(chunk(number, 20 * number, "pcm" if number < 3 else "opus"))
    assert len(recorder.take_sound("pcm")) == 3 * CHUNK
