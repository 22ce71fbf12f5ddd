"""Synthetic traffic: as recordings for small tests, and as the index of a whole day of many robots.

``python -m tests.recordings.synthetic --robots 10 --hours 24 DIR`` writes the second.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pebble.contract.packets import KEY_FRAME, Codec, Picture, PictureKind, Sound
from pebble.recordings.files.writer import RecordingWriter
from pebble.recordings.stamps import stamp_ns
from pebble.recordings.traffic.activity import Activity
from pebble.recordings.traffic.duck import connected, quoted
from pebble.recordings.traffic.index import COLUMNS, PICTURE, SOUND

START_NS = 1_763_600_400 * 10**9  # 2025-11-20 01:00 UTC
_S, _MS = 10**9, 10**6
_DAY_S = 86_400
_NO_ROWS = f"SELECT {', '.join(f'NULL::{kind} AS {name}' for name, kind in COLUMNS.items())} WHERE false"


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


# -- a day of many robots, as its index


@dataclass(frozen=True)
class _Column:
    """Messages of one kind of one robot: times in seconds from the start of the day, sizes, and what is the same."""

    metric: str
    at: Any
    size: Any
    direction: str = "outgoing"
    activity: Activity = Activity.NONE
    medium: int = 0
    delay_s: float = 0.03
    whole_seconds: bool = False
    stamped: bool = True

    @property
    def is_media(self) -> bool:
        return self.medium != 0


def write_day(archive: Path, *, robots: Iterable[int], hours: int) -> int:
    """The indexes of ``hours`` of some robots, by their numbers, one for each hour; returns their rows.

    Each robot is used for two of 24 hours; eight of ten have video and sound. Two of ten cut their stamps to seconds.
    """
    chance, rows = np.random.default_rng(1), 0
    archive.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, connected(Path(scratch), memory_mb=256) as connection:
        for hour in range(hours):
            columns = {f"pebble/robots/robot{robot:02}": list(_hour(chance, robot, hour)) for robot in robots}
            for lane, is_media in (("state", False), ("media", True)):
                chosen = [(base, one) for base, each in columns.items() for one in each if one.is_media == is_media]
                _write_index(connection, archive / f"synthetic-{hour:04}.{lane}.parquet", chosen)
                rows += sum(len(column.at) for _, column in chosen)
    return rows


def _hour(chance: np.random.Generator, robot: int, hour: int) -> Iterator[_Column]:
    begin, whole = hour * 3600.0, robot % 10 in (8, 9)
    heartbeats = _regular(chance, begin, 3600.0, 4.0)
    lost = chance.random(len(heartbeats)) < 0.0005
    together = (heartbeats > begin + 1800.0) & (heartbeats < begin + 1802.0)  # an outage of all robots
    yield _Column("online", heartbeats[~lost & ~together], 42, whole_seconds=whole)
    yield _Column("charging-level", _regular(chance, begin, 3600.0, 0.2), 30)
    yield _Column("logs" if not whole else "charging-status", _regular(chance, begin, 3600.0, 0.3), 120)
    if hour % 12 == robot % 12:
        yield _Column(
            "drive-values", _regular(chance, begin, 3600.0, 20.0), 24, "incoming", Activity.DRIVE, stamped=False
        )
        if not whole:
            yield _Column(
                "audio", _regular(chance, begin, 3600.0, 50.0, 0.0), 664, activity=Activity.MEDIA, medium=SOUND
            )
            pictures = _regular(chance, begin, 3600.0, 15.0)
            sizes = chance.integers(800, 2500, len(pictures))
            yield _Column("front-camera", pictures, sizes, activity=Activity.MEDIA, medium=PICTURE)


def _regular(chance: np.random.Generator, begin: float, seconds: float, rate_hz: float, jitter_s: float = 0.005) -> Any:
    count = int(seconds * rate_hz)
    return begin + np.arange(count) / rate_hz + (chance.random(count) * jitter_s if jitter_s else 0.0)


def _write_index(connection: Any, path: Path, columns: Sequence[tuple[str, _Column]]) -> None:
    queries = []
    for number, (robot, column) in enumerate(columns):
        connection.register(f"c{number}", _arrays(column))
        queries.append(f"SELECT {_select(robot, column)} FROM c{number}")
    about = "{recording: 'synthetic.mcap', size: '0', changed_ns: '0', missing: '0', unread: ''}"
    query = f"{' UNION ALL '.join(queries)} ORDER BY robot, ts" if queries else _NO_ROWS
    connection.execute(f"COPY ({query}) TO {quoted(path)} (FORMAT parquet, COMPRESSION zstd, KV_METADATA {about})")


def _arrays(column: _Column) -> dict[str, Any]:
    day_ns = START_NS // _S // _DAY_S * _DAY_S * _S
    stamp = day_ns + (column.at * 1000).astype("i8") * _MS
    delays = np.abs(np.random.default_rng(len(column.at)).normal(column.delay_s, 0.008, len(column.at)))
    received = np.maximum.accumulate(day_ns + ((column.at + delays) * 1e9).astype("i8"))  # TCP keeps the order
    return {
        "ts": received,
        "stamp": stamp // _S * _S if column.whole_seconds else stamp,
        "size": np.broadcast_to(np.asarray(column.size, "u4"), stamp.shape).copy(),
    }


def _select(robot: str, column: _Column) -> str:
    media = column.is_media
    values = {
        "ts": "make_timestamp_ns(ts)",
        "stamp": "make_timestamp_ns(stamp)" if column.stamped else "NULL",
        "robot": f"'{robot}'",
        "direction": f"'{column.direction}'",
        "metric": f"'{column.metric}'",
        "size": "size",
        "qos": "0" if media else "1",
        "retain": str(column.metric == "online").lower(),
        "retained": "false",
        "medium": str(column.medium) if media else "NULL",
        "activity": str(int(column.activity)),
        "online": "true" if column.metric == "online" else "NULL",
        "event": "NULL",
    }
    return ", ".join(f"{values[name]}::{type_} AS {name}" for name, type_ in COLUMNS.items())


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes the index of a synthetic day.")
    parser.add_argument("archive", type=Path, metavar="DIR")
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--hours", type=int, default=24)
    given = parser.parse_args()
    rows = write_day(given.archive, robots=range(given.robots), hours=given.hours)
    size = sum(path.stat().st_size for path in given.archive.rglob("*.parquet"))
    print(f"{rows} rows, {size / 1e6:.0f} MB of Parquet in {given.archive}")  # noqa: T201


if __name__ == "__main__":
    main()
