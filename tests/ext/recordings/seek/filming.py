"""A recording with real pictures of every encoding, whose numbers can be read from them, as a recorder's folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pebble.extensions.media.scene import Scene
from pebble.extensions.media.video import make_encoder
from tests.ext.recordings.playing import GOOB, Line, demo, js, ms, write

FPS = 15
SIZE = (320, 240)
SCENES = 60  # after which pictures repeat: drawing takes longer than all else
CAMERA = f"{GOOB}/outgoing/front-camera"


def pictures(encoding: str, seconds: float) -> Iterator[Line]:
    """The number in a picture is its own modulo SCENES."""
    encoder = make_encoder(encoding, fps=FPS, quality=60, keyframe_interval=2 * FPS)
    scene, made = Scene(*SIZE), list[np.ndarray]()
    for number in range(SCENES):
        made.append(np.empty((SIZE[1], SIZE[0], 3), np.uint8))
        scene.render(number, made[-1])
    for number in range(int(seconds * FPS)):
        at = number / FPS
        payload = encoder.encode(made[number % SCENES], ms(at))
        if payload is not None:
            yield Line(at, CAMERA, payload)


<<<<<<< HEAD
def rest(seconds: float) -> Iterator[Line]:
    """Heartbeats, sound, telemetry, commands, one retained value that changes, and lines of the log."""
    yield Line(0.0, f"{GOOB}/outgoing/capabilities", js(t=ms(0), value={"video": {"available": True}}), 1, retain=True)
    for number in range(int(seconds * 50)):
        at = number / 50
        sound = Sound(Codec.PCM16LE, 1, 16000, 320, number + 1, ms(at), b"\1\2" * 320)
        yield Line(at, f"{GOOB}/outgoing/audio", sound.pack())
        if number % 12 == 0:
            yield Line(at, f"{GOOB}/outgoing/online", js(t=ms(at)), 1, retain=True)
        if number % 5 == 0:
            yield Line(at, f"{GOOB}/outgoing/sensors/imu", js(t=ms(at), n=number), 1)
            yield Line(at, f"{GOOB}/incoming/drive-values", js(x=0.0, z=0.5 * (number % 500 < 250)), 1)
        if number % 500 == 250:
            yield Line(at, f"{GOOB}/outgoing/charging-level", js(t=ms(at), value=100 - number // 500), 1, retain=True)
            yield Line(at, f"{GOOB}/outgoing/logs", js(t=ms(at), level="INFO", message=f"line {number}"), 1)


def film(root: Path, encoding: str, seconds: float, *, finished: bool = True) -> Path:
    """A folder as a recorder leaves it: one file of state, one of media, a chunk each second."""
    day = root / "2023/11/14"
    day.mkdir(parents=True)
    lines = sorted([*rest(seconds), *pictures(encoding, seconds)], key=lambda line: line.at)
=======
def film(
    root: Path,
    encoding: str,
    seconds: float,
    size: tuple[int, int] = SIZE,
    *,
    finished: bool = True,
    times: int = 1,
    interval: int | None = 2 * FPS,
) -> Path:
    """A folder as a recorder leaves it: one file of state, one of media, a chunk each second.

    ``times``: so often the pictures are repeated, because encoding an hour takes long. ``interval``: of key frames, in
    pictures; None: as robots have it.
    """
    day = root / "2023/11/14"
    day.mkdir(parents=True)
    once = list(pictures(encoding, seconds / times, size, interval))
    shown = [line._replace(at=line.at + seconds / times * turn) for turn in range(times) for line in once]
    capabilities = js(t=ms(0), value={"video": {"available": True}})
    offered = Line(0.0, f"{GOOB}/outgoing/capabilities", capabilities, 1, retain=True)
    lines = sorted([offered, *demo(seconds, [GOOB]), *shown], key=lambda line: line.at)
>>>>>>> wt-t5
    media = [line for line in lines if line.topic in (CAMERA, f"{GOOB}/outgoing/audio")]
    state = [line for line in lines if line.topic not in (CAMERA, f"{GOOB}/outgoing/audio")]
    suffix = ".mcap" if finished else ".mcap.active"
    write(day / f"20231114T221320Z-000001.state{suffix}", state, finished=finished, chunk_ns=10**9)
    name = f"20231114T221320Z-000002.media.{GOOB.replace('/', '.')}{suffix}"
    write(day / name, media, finished=finished, chunk_ns=10**9)
    return root
