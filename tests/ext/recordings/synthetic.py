"""Synthetic traffic, as recordings for small tests."""

from __future__ import annotations

import json
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pebble.contract.packets import KEY_FRAME, Codec, Picture, PictureKind, Sound
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.stamps import stamp_ns

START_NS = 1_763_600_400 * 10**9  # 2025-11-20 01:00 UTC
_S, _MS = 10**9, 10**6


@dataclass(frozen=True)
class Sent:
    """One message as a recorder received it."""

    ns: int
    topic: str
    payload: bytes
    retained: bool = False


@dataclass(frozen=True)
class Robot:
    """What a synthetic robot is like. ``outages``: begin and length in seconds from the start."""

    id: str
    linux: bool = True
    whole_seconds: bool = False  # its stamps are cut to seconds
    ahead_ms: float = 0.0  # its clock
    delay_ms: float = 30.0
    outages: tuple[tuple[float, float], ...] = ()
    session: tuple[float, float] | None = None  # driven, with video and sound if it is a Linux robot

    @property
    def base(self) -> str:
        return f"pebble/robots/{self.id}"


#: The robots of the paper. All but BenJr lose their heartbeats at 20 s: that is no robot's fault.
SHARED_OUTAGE = (20.0, 1.2)
FLEET = (
    Robot("goob", outages=(SHARED_OUTAGE, (42.0, 0.8)), session=(10.0, 40.0)),
    Robot("fred", ahead_ms=250.0, outages=(SHARED_OUTAGE,), session=(5.0, 25.0)),
    Robot("minilamp", linux=False, whole_seconds=True, outages=(SHARED_OUTAGE,), session=(30.0, 35.0)),
    Robot("benjr", linux=False, whole_seconds=True, outages=((50.0, 2.0),)),
)


def traffic(robots: Sequence[Robot] = FLEET, seconds: float = 60.0, seed: int = 1) -> list[Sent]:
    """What a recorder receives, in order."""
    found: list[Sent] = []
    for number, robot in enumerate(robots):
        making = _Making(robot, random.Random(seed + number))
        found += making.heartbeats(seconds)
        found += making.telemetry(seconds)
        if robot.session is not None:
            since, until = (min(at, seconds) for at in robot.session)
            found += making.driving(since, until)
            if robot.linux:
                found += [*making.sound(since, until), *making.pictures(since, until)]
    found.sort(key=lambda sent: sent.ns)
    return found


class _Making:
    """The messages of one robot."""

    def __init__(self, robot: Robot, chance: random.Random) -> None:
        self._robot, self._chance = robot, chance

    def heartbeats(self, seconds: float) -> Iterator[Sent]:
        yield self._sent(0.0, "outgoing/online", self._json({"online": True}, -3600.0), retained=True)
        for at in self._times(0.0, seconds, 4.0):
            if not any(begin < at < begin + length for begin, length in self._robot.outages):
                yield self._sent(at, "outgoing/online", self._json({"online": True}, at))

    def telemetry(self, seconds: float) -> Iterator[Sent]:
        yield self._sent(0.5, "outgoing/capabilities", self._json({"value": {"drive": True}}, 0.5), retained=True)
        for at in self._times(1.0, seconds, 0.2):
            yield self._sent(at, "outgoing/charging-level", self._json({"value": 7.5, "unit": "v"}, at))
            if self._robot.linux:
                yield self._sent(at, "outgoing/logs", self._json({"level": "INFO", "message": "at work"}, at))

    def driving(self, since: float, until: float) -> Iterator[Sent]:
        for at in self._times(since, until, 20.0):
            yield self._sent(at, "incoming/drive-values", b'{"x":0.1,"z":0.5}')
        yield self._sent(until, "incoming/drive-values", b'{"x":0,"z":0}')

    def sound(self, since: float, until: float) -> Iterator[Sent]:
        for number, at in enumerate(self._times(since, until, 50.0, jitter_ms=0.0), start=1):
            packet = Sound(Codec.PCM16LE, 1, 16000, 320, number, self._ms(at), bytes(640))
            yield self._sent(at, "outgoing/audio", packet.pack(), jitter_ms=1.0)

    def pictures(self, since: float, until: float) -> Iterator[Sent]:
        for number, at in enumerate(self._times(since, until, 15.0)):
            keyframe = number % 30 == 0
            size = 6000 if keyframe else self._chance.randrange(500, 2000)
            kind, flags = PictureKind.H264, KEY_FRAME if keyframe else 0
            yield self._sent(
                at, "outgoing/front-camera", Picture(kind, number, self._ms(at), bytes(size), flags).pack()
            )

    def _times(self, since: float, until: float, rate_hz: float, jitter_ms: float = 5.0) -> Iterator[float]:
        for number in range(int((until - since) * rate_hz)):
            yield since + number / rate_hz + self._chance.uniform(0, jitter_ms) / 1000

    def _ms(self, at: float) -> int:
        """What the robot's clock shows, as it writes it."""
        ms = START_NS // _MS + round(at * 1000 + self._robot.ahead_ms)
        return ms // 1000 * 1000 if self._robot.whole_seconds else ms

    def _json(self, fields: dict[str, Any], at: float) -> bytes:
        return json.dumps({"t": self._ms(at), **fields}).encode()

    def _sent(self, at: float, suffix: str, payload: bytes, *, retained: bool = False, jitter_ms: float = 20.0) -> Sent:
        delay_ms = 0.0 if suffix.startswith("incoming") else self._robot.delay_ms + self._chance.uniform(0, jitter_ms)
        return Sent(START_NS + round((at + delay_ms / 1000) * _S), f"{self._robot.base}/{suffix}", payload, retained)


def write_recording(path: Path, messages: Iterable[Sent], *, finished: bool = True) -> Path:
    """A recording as the recorder writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels: dict[tuple[str, bool], int] = {}
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file, library="pebble test")
        for sent in messages:
            number = channels.get((sent.topic, sent.retained))
            if number is None:
                about = {"qos": "1", "retain": "1" if sent.retained else "0"} | (
                    {"retained": "1"} if sent.retained else {}
                )
                number = channels[sent.topic, sent.retained] = writer.channel(sent.topic, "json", about)
            writer.add(number, sent.ns, sent.payload, stamp_ns(sent.payload))
        writer.flush()
        if finished:
            writer.finish()
    return path


def event(ns: int, name: str, **about: Any) -> Sent:
    """What the recorder notes about itself."""
    return Sent(ns, "$recorder/events", json.dumps({"t": ns // _MS, "event": name, **about}).encode())
