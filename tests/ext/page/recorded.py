"""Recordings of one robot on two days, as a recorder leaves them, for what a person sees of them.

Goob is recorded on 22 November 2026 from 10:00 to 10:01:30 and from 10:04:50 to 10:06:20 UTC. Between the two there was
no connection to the broker. The day before there are ten seconds without pictures.
"""

from __future__ import annotations

import io
import json
import math
import tempfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

from pebble.contract.packets import Codec, Picture, PictureKind, Sound
from pebble.extensions.media.speech import Speech
from pebble.extensions.recordings.files.writer import RecordingWriter
from pebble.extensions.recordings.recorder.intake import EVENTS
from tests.support import ROOT

ROBOT: Final = "pebble/robots/goob"
DAY: Final = "2026-11-22"
START: Final = 1_795_305_600_000 + 36_000_000  # 10:00 UTC
GAP: Final = (START + 90_000, START + 290_000)
END: Final = START + 380_000
STRETCHES: Final = [(START, GAP[0]), (GAP[1], END)]
BEFORE: Final = (START - 86_400_000, START - 86_390_000)
DRIVEN: Final = range(START + 20_000, START + 50_000)
PICTURE_MS, SOUND_MS = 100, 20
PICTURE_LATE_MS, SOUND_LATE_MS = 40, 30  # from its capture to its reception
SPEECH: Final = 160_000  # samples
CAMERA, MICROPHONE = f"{ROBOT}/outgoing/front-camera", f"{ROBOT}/outgoing/audio"

SQUARE = [[0.25, 0.25], [0.6, 0.25], [0.6, 0.7], [0.25, 0.7]]


class Recorded(NamedTuple):
    """One message."""

    at: int
    topic: str
    payload: bytes


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _imu(at: int) -> dict[str, Any]:
    seconds = at / 1000
    value = {
        "gyro_dps": {"x": 2 * math.sin(seconds), "y": math.cos(2 * seconds), "z": 20 * math.sin(seconds / 5)},
        "orientation_deg": {"roll": 3 * math.sin(seconds / 7), "pitch": -2 * math.cos(seconds / 9)},
        "accel_norm_g": 1 + 0.05 * math.sin(3 * seconds),
    }
    return {"t": at, "seq": at // 200, "mcu_ms": at % 1_000_000, "value": value}


def _odometry(at: int) -> dict[str, Any]:
    angle = (at - START) / 8000
    value = {
        "x_mm": 800 * math.sin(angle),
        "y_mm": 500 * math.sin(2 * angle),
        "heading_rad": math.atan2(1000 * math.cos(2 * angle), 800 * math.cos(angle)),
        "distance_mm": abs(at - START) / 10,
    }
    return {"value": value, "unit": "mm", "source": "wheel-odometry", "timestamp": at / 1000}


def _log(at: int) -> dict[str, Any]:
    level = "WARNING" if at // 3000 % 9 == 0 else "INFO"
    return {"t": at, "level": level, "service": "mqtt_bridge", "message": f"line {(at - START) // 3000}"}


def _capabilities(_at: int) -> dict[str, Any]:
    value = {
        "transport": {"kind": "zenoh"},
        "video": {"available": True, "controls": True, "encodings": ["pbvd"]},
        "audio": {"available": True, "controls": True, "encodings": ["pcm"]},
        "drive": {"available": True, "controls": True},
    }
    return {"t": 0, "schema": "pebble-capabilities/v1", "value": value}


#: Metric, ms between two messages, what they hold.
STREAMS: Final[list[tuple[str, int, Callable[[int], Any]]]] = [
    ("online", 250, lambda at: {"t": at - 42}),
    ("capabilities", 60_000, _capabilities),
    ("charging-level", 5000, lambda at: {"value": 7.92 - (at - START) / 4e6, "unit": "v"}),
    ("charging-status", 20_000, lambda _at: {"value": False}),
    ("sensors/imu", 200, _imu),
    ("touch-sensors", 200, lambda at: {"value": {"a0": at // 200 % 900, "a1": 498, "a2": 730}, "unit": "adc"}),
    ("wheel-odometry", 200, _odometry),
    ("video-overlays", 100, lambda _at: {"source": "tags", "shapes": [SQUARE], "labels": []}),
    ("logs", 3000, _log),
]


@cache
def _seen(number: int) -> bytes:
    """The simulated world as a camera sees it that turns, compressed."""
    whole = Image.open(ROOT / "docs" / "simulated-world.jpg")
    target = io.BytesIO()
    whole.crop((3 * number, 60, 3 * number + 480, 330)).save(target, "JPEG", quality=60)
    return zlib.compress(target.getvalue())


def _picture(at: int) -> bytes:
    number = (at - START) // PICTURE_MS
    return Picture(PictureKind.ZLIB_JPEG, number + 1, at - PICTURE_LATE_MS, _seen(number % 50)).pack()


def _sound(at: int) -> bytes:
    number = (at - START) // SOUND_MS
    first = 320 * number % SPEECH
    return Sound(
        Codec.PCM16LE, 1, 16_000, 320, number + 1, at - SOUND_LATE_MS, speech()[first : first + 320].tobytes()
    ).pack()


@cache
def speech() -> npt.NDArray[np.int16]:
    """Ten seconds that are said again and again."""
    return Speech(16_000).samples(0, SPEECH).ravel()


def _times(every: int, since: int, until: int) -> Iterator[int]:
    """Multiples of ``every`` in [since, until)."""
    yield from range(-(-since // every) * every, until, every)


def _state(since: int, until: int) -> list[Recorded]:
    out, into = f"{ROBOT}/outgoing", f"{ROBOT}/incoming"
    found = [
        Recorded(at, f"{out}/{metric}", _json(make(at)))
        for metric, every, make in STREAMS
        for at in _times(every, since, until)
    ]
    for at in _times(100, max(since, DRIVEN.start), min(until, DRIVEN.stop)):
        found.append(Recorded(at, f"{into}/drive-values", _json({"x": 0.25, "z": 0.5 + 0.3 * math.sin(at / 1500)})))
    found += [Recorded(at, f"{into}/lights", _json({"r": 0, "g": 1, "b": 0})) for at in _times(30_000, since, until)]
    if since == GAP[1]:
        gap = {"t": since, "event": "gap", "since": GAP[0], "until": GAP[1], "why": "no connection to the broker"}
        found.append(Recorded(since, EVENTS, _json(gap)))
    return sorted(found)


def _media(since: int, until: int) -> list[Recorded]:
    found = [Recorded(at, CAMERA, _picture(at)) for at in _times(PICTURE_MS, since, until)]
    return sorted(found + [Recorded(at, MICROPHONE, _sound(at)) for at in _times(SOUND_MS, since, until)])


def _write(path: Path, messages: list[Recorded]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb", buffering=0) as file:
        writer = RecordingWriter(file, library="pebble test")
        channels: dict[str, int] = {}
        second = 0
        for at, topic, payload in messages:
            if at // 1000 != second:  # a chunk for each second
                second = at // 1000
                writer.flush()
            if topic not in channels:
                channels[topic] = writer.channel(topic, "json", {"qos": "0", "retain": "0"})
            writer.add(channels[topic], at * 10**6, payload)
        writer.flush()
        writer.finish()


def write(root: Path) -> Path:
    """A folder as a recorder leaves it: files of state and of media."""
    names = ("20261122T100000Z", "20261122T100450Z")
    for number, (name, (since, until)) in enumerate(zip(names, STRETCHES, strict=True)):
        _write(root / f"2026/11/22/{name}-{2 * number + 2:06}.state.mcap", _state(since, until))
        media = f"{name}-{2 * number + 3:06}.media.{ROBOT.replace('/', '.')}.mcap"
        _write(root / "2026/11/22" / media, _media(since, until))
    _write(root / "2026/11/21/20261121T100000Z-000001.state.mcap", _state(*BEFORE))
    return root


@cache
def folder() -> Path:
    """One for all tests of this process."""
    made = tempfile.TemporaryDirectory(prefix="pebble-recorded-")
    _folders.append(made)  # it is removed with the process
    return write(Path(made.name))


_folders: list[tempfile.TemporaryDirectory[str]] = []
