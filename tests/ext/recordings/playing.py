"""Makes recordings; and two of the demo's robots.

``DRIVE``: four robots that are driven and stopped, from their start on, without pictures and sound.
``MEDIA``: Fred's pictures in json, pbvd, pbvz and h264, and its sound in PCM and Opus, a part of each.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.recordings.files.reader import RecordingFile
from pebble.extensions.recordings.files.recorded import Damage
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.stamps import stamp_ns

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"
THEN_NS = 1_700_000_000 * 10**9  # when recordings of tests begin
STEP_NS = 10_000_000  # between messages of `write_random`
DRIVE, MEDIA = (Path(__file__).parents[2] / "data" / "recordings" / f"{name}.mcap" for name in ("drive", "media"))


class Line(NamedTuple):
    """One message of a recording, at a time in seconds from its begin."""

    at: float
    topic: str
    payload: bytes
    qos: int = 0
    retain: bool = False  # published so
    retained: bool = False  # an old one that came after subscribing

    @property
    def log_ns(self) -> int:
        return THEN_NS + round(self.at * 1e9)

    @property
    def metadata(self) -> dict[str, str]:
        flags = {"qos": str(self.qos), "retain": str(int(self.retain))}
        return flags | ({"retained": "1"} if self.retained else {})


def js(**fields: Any) -> bytes:
    return json.dumps(fields).encode()


def ms(at: float) -> int:
    """Epoch milliseconds of a time in seconds from the begin of a recording."""
    return THEN_NS // 10**6 + round(at * 1000)


def write(path: Path, lines: Iterable[Any], *, finished: bool = True, chunk_ns: int = 1 << 63) -> Path:
    """A recording of these lines, in chunks of this length."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file, library="pebble test")
        numbers: dict[tuple[str, str], int] = {}
        ends_ns = 0
        for line in lines:
            if ends_ns <= line.log_ns:
                writer.flush()
                ends_ns = line.log_ns // chunk_ns * chunk_ns + chunk_ns
            key = line.topic, str(line.metadata)
            if key not in numbers:
                numbers[key] = writer.channel(line.topic, "json", line.metadata)
            writer.add(numbers[key], line.log_ns, line.payload, stamp_ns(line.payload))
        writer.flush()
        if finished:
            writer.finish()
    return path


def write_random(
    path: Path, messages: int = 2000, *, finish: bool = True, channels: int = 20, each: int = 100
) -> list[tuple[str, bytes]]:
    """A file with random payloads, one chunk for every ``each`` of them; returns topics and payloads."""
    rng = random.Random(messages)
    topics = [f"pebble/robots/r{number}/outgoing/t{number}" for number in range(channels)]
    lines = [
        Line(number * STEP_NS / 1e9, rng.choice(topics), rng.randbytes(rng.randrange(200)))
        for number in range(messages)
    ]
    write(path, lines, finished=finish, chunk_ns=each * STEP_NS)
    return [(line.topic, line.payload) for line in lines]


def contents(path: Path, **options: Any) -> list[tuple[str, bytes]]:
    """Topics and payloads of what can be read."""
    return read(path, **options)[0]


def read(path: Path, **options: Any) -> tuple[list[tuple[str, bytes]], Damage]:
    """Topics and payloads of what can be read, and what cannot."""
    with RecordingFile(path) as file:
        return [(message.channel.topic, message.payload) for message in file.read(**options)], file.damage


def demo(seconds: float, robots: Sequence[str] = (GOOB, FRED)) -> Iterator[Line]:
    """Heartbeats, sound, telemetry, commands, one retained value that changes, and lines of the log."""
    for number, base in product(range(int(seconds * 50)), robots):
        at = number / 50
        sound = Sound(Codec.PCM16LE, 1, 16000, 320, number + 1, ms(at), b"\1\2" * 320)
        yield Line(at, f"{base}/outgoing/audio", sound.pack())
        if number % 12 == 0:
            yield Line(at, f"{base}/outgoing/online", js(t=ms(at)), 1, retain=True)
        if number % 5 == 0:
            yield Line(at, f"{base}/outgoing/sensors/imu", js(t=ms(at), n=number), 1)
            yield Line(at, f"{base}/incoming/drive-values", js(x=0.0, z=0.5 * (number % 500 < 250)), 1)
        if number % 500 == 250:
            yield Line(at, f"{base}/outgoing/charging-level", js(t=ms(at), value=100 - number // 500), 1, retain=True)
            yield Line(at, f"{base}/outgoing/logs", js(t=ms(at), level="INFO", message=f"line {number}"), 1)
