"""Makes recordings, and plays them in virtual time."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from pebble.extensions.media.packets import Codec, Sound
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.replay.player import BusOutput, Player
from pebble.extensions.recordings.replay.rules import Options, Rules
from pebble.extensions.recordings.replay.source import ReplaySource
from pebble.extensions.recordings.stamps import stamp_ns
from pebble.transports import Message

GOOB, FRED = "pebble/robots/goob", "pebble/robots/fred"
THEN_NS = 1_700_000_000 * 10**9  # when recordings of tests begin
NOW_NS = 1_800_000_000 * 10**9  # when they are replayed


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


class Sent(NamedTuple):
    at: float
    message: Message


class Stage:
    """A player in virtual time, and all that it publishes."""

    def __init__(self, path: Path | Sequence[Path], options: Options | None = None, **playing: Any) -> None:
        self.seconds = 0.0  # which only waiting moves on
        self.sent: list[Sent] = []
        self.refuses = 0  # so many of the next messages
        self.takes_s = 0.0  # for each message
        self.waits = 0
        self.actions: list[tuple[float, Any]] = []  # what to do at a time, in order
        source = ReplaySource([path] if isinstance(path, Path) else path)
        self.rules = Rules(options or Options(), source.channels)
        output = BusOutput(self.rules, self._publish, lambda: NOW_NS + round(self.seconds * 1e9))
        clocks = {"now": lambda: self.seconds, "wait": self._wait}
        self.player = Player(source, self.rules.publishes, output, **clocks, **playing)

    def run(self) -> Stage:
        self.player.run()
        return self

    def at(self, seconds: float, action: Any) -> Stage:
        self.actions.append((seconds, action))
        return self

    def payloads(self, topic: str) -> list[bytes]:
        return [sent.message.payload for sent in self.sent if sent.message.topic == topic]

    def _publish(self, message: Message) -> bool:
        if self.refuses:
            self.refuses -= 1
            return False
        self.seconds += self.takes_s
        self.sent.append(Sent(self.seconds, message))
        return True

    def _wait(self, seconds: float) -> None:
        self.waits += 1
        self.seconds += seconds
        while self.actions and self.seconds >= self.actions[0][0]:
            self.actions.pop(0)[1]()


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
