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

from pebble.extensions.media.packets import Codec, Picture, PictureKind, Sound
from pebble.extensions.media.speech import Speech
from pebble.extensions.recordings.recorder.intake import EVENTS
from tests.ext.page import states
from tests.ext.page.states import GAP, START
from tests.ext.recordings import playing
from tests.support import ROOT

ROBOT: Final = "pebble/robots/goob"
DAY: Final = "2026-11-22"
END: Final = START + 380_000
STRETCHES: Final = [(START, GAP[0]), (GAP[1], END)]
BEFORE: Final = (START - 86_400_000, START - 86_390_000)
DRIVEN: Final = range(START + 20_000, START + 50_000)
PICTURE_MS, SOUND_MS = 100, 20
PICTURE_LATE_MS, SOUND_LATE_MS = 40, 30  # from its capture to its reception
SPEECH: Final = 160_000  # samples
SQUARE: Final = [[0.25, 0.25], [0.6, 0.25], [0.6, 0.7], [0.25, 0.7]]
CAMERA, MICROPHONE = f"{ROBOT}/outgoing/front-camera", f"{ROBOT}/outgoing/audio"


class Recorded(NamedTuple):
    """One message of a recording."""

    at: int
    topic: str
    payload: bytes

    @property
    def log_ns(self) -> int:
        return self.at * 10**6

    @property
    def metadata(self) -> dict[str, str]:
        return {"qos": "0", "retain": "0"}


def _json(value: Any) -> bytes:
    return json.dumps(value).encode()


def _log(at: int) -> dict[str, Any]:
    level = "WARNING" if at // 3000 % 9 == 0 else "INFO"
    return {"t": at, "level": level, "service": "mqtt_bridge", "message": f"line {(at - START) // 3000}"}


#: Metric, ms between two messages, what they hold.
STREAMS: Final[list[tuple[str, int, Callable[[int], Any]]]] = [
    ("online", 250, lambda at: {"t": at - 42}),
    ("capabilities", 60_000, lambda _at: states.capabilities("zenoh")),
    ("control/base", 60_000, lambda _at: {"by": "ann", "id": "1", "key": "k"}),
    ("charging-level", 5000, lambda at: {"value": 7.92 - (at - START) / 4e6, "unit": "v"}),
    ("charging-status", 20_000, lambda _at: {"value": False}),
    ("sensors/imu", 200, states.attitude),
    ("touch-sensors", 200, lambda at: {"value": {"a0": at // 200 % 900, "a1": 498, "a2": 730}, "unit": "adc"}),
    ("wheel-odometry", 200, lambda at: states.odometry((at - START) / 1000)),
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


def write(root: Path) -> Path:
    """A folder as a recorder leaves it: files of state and of media."""
    names = ("20261122T100000Z", "20261122T100450Z")
    day, before = root / "2026/11/22", root / "2026/11/21"
    for folder in (day, before):
        folder.mkdir(parents=True)
    for number, (name, (since, until)) in enumerate(zip(names, STRETCHES, strict=True)):
        playing.write(day / f"{name}-{2 * number + 2:06}.state.mcap", _state(since, until), chunk_ns=10**9)
        media = f"{name}-{2 * number + 3:06}.media.{ROBOT.replace('/', '.')}.mcap"
        playing.write(day / media, _media(since, until), chunk_ns=10**9)
    playing.write(before / "20261121T100000Z-000001.state.mcap", _state(*BEFORE), chunk_ns=10**9)
    return root


@cache
def folder() -> Path:
    """One for all tests of this process."""
    made = tempfile.TemporaryDirectory(prefix="pebble-recorded-")
    _folders.append(made)  # it is removed with the process
    return write(Path(made.name))


_folders: list[tempfile.TemporaryDirectory[str]] = []
