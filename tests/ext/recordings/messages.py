"""Recordings for tests of what reads them: those that the writer makes here, and two of the demo's robots.

``DRIVE``: four robots that are driven and stopped, from their start on, without pictures and sound.
``MEDIA``: Fred's pictures in json, pbvd, pbvz and h264, and its sound in PCM and Opus, a part of each.
"""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import Damage
from pebble.extensions.recordings.files.writer import RecordingWriter

START_NS = 1_790_000_000_000_000_000
STEP_NS = 10_000_000
DRIVE, MEDIA = (Path(__file__).parents[2] / "data" / "recordings" / f"{name}.mcap" for name in ("drive", "media"))


def write(
    path: Path, messages: int = 2000, *, finish: bool = True, channels: int = 20, each: int = 100
) -> list[tuple[str, bytes]]:
    """A file with random payloads, one chunk for every ``each`` of them; returns topics and payloads."""
    rng = random.Random(messages)
    written = []
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file, library="pebble test")
        writer.metadata("pebble.recording", {"format": "1"})
        topics = [f"pebble/robots/r{number}/outgoing/t{number}" for number in range(channels)]
        numbers = [writer.channel(topic, "json", {"qos": "0"}) for topic in topics]
        for number in range(messages):
            channel, payload = rng.randrange(channels), rng.randbytes(rng.randrange(200))
            writer.add(numbers[channel], START_NS + number * STEP_NS, payload, 5)
            written.append((topics[channel], payload))
            if number % each == each - 1:
                writer.flush()
        writer.finish() if finish else writer.flush()
    return written


def contents(path: Path, **options: Any) -> list[tuple[str, bytes]]:
    """Topics and payloads of what can be read."""
    return read(path, **options)[0]


def read(path: Path, **options: Any) -> tuple[list[tuple[str, bytes]], Damage]:
    """Topics and payloads of what can be read, and what cannot."""
    with RecordingFile(path) as file:
        return [(message.channel.topic, message.payload) for message in file.read(**options)], file.damage
